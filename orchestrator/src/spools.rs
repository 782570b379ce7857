//! The spools of a vehicle: their streams, the records that wait in them, and what they lost. Those
//! of deployments that were removed can be read for a while, and do not fill the disk.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_protocol::vehicle_api::StreamLoss;
use gleaner_spool::{SpoolError, SpoolFolder, SpoolStorage};

use crate::store::{entries, remove};

/// The streams that each vehicle has, beside those of deployments.
pub(crate) const STREAMS: [&str; 2] = ["events", "orchestrator"];
/// Number of removed deployments whose records are kept: those that were removed last.
pub(crate) const KEPT: usize = 8;

/// The streams of a vehicle. Tests let each operation fail.
pub(crate) trait SpoolSource {
    type Storage: SpoolStorage;

    /// Returns the names of the streams, and the error of those that cannot be listed.
    fn streams(&self) -> (Vec<String>, io::Result<()>);

    fn open(&self, stream: &str) -> Result<Self::Storage, SpoolError>;
}

/// The streams in a folder.
#[derive(Debug, Clone)]
pub(crate) struct SpoolFolders(pub(crate) PathBuf);

/// The records of all streams that the cloud does not have, and those that are lost.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct SpoolCounts {
    pub(crate) unsent: u64,
    /// Number of streams that `unsent` does not count.
    pub(crate) uncounted: u64,
    pub(crate) lost: Vec<StreamLoss>,
}

impl SpoolSource for SpoolFolders {
    type Storage = SpoolFolder;

    fn streams(&self) -> (Vec<String>, io::Result<()>) {
        let mut names = Vec::new();
        let mut list = || {
            for name in STREAMS {
                if self.0.join(name).try_exists()? {
                    names.push(name.to_owned());
                }
            }
            let entries = match fs::read_dir(self.0.join("lambdas")) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
                entries => entries?,
            };
            for entry in entries {
                names.push(format!("lambdas/{}", entry?.file_name().display()));
            }
            Ok(())
        };
        let listed = list();
        (names, listed)
    }

    fn open(&self, stream: &str) -> Result<SpoolFolder, SpoolError> {
        SpoolFolder::readable(&self.0.join(stream))
    }
}

/// Returns the name of a stream in its segments: of a lambda's records, the id of its deployment.
pub(crate) fn last_part(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// Counts what the spools note: no record is read for it.
pub(crate) fn count(spools: &impl SpoolSource) -> SpoolCounts {
    let (names, listed) = spools.streams();
    // Of a folder that cannot be listed, not even the number of streams is known.
    let mut counts = SpoolCounts { uncounted: u64::from(listed.is_err()), ..Default::default() };
    for name in names {
        match waiting(spools, &name) {
            Ok((unsent, loss)) => {
                counts.unsent += unsent;
                counts.lost.extend(loss);
            }
            Err(_) => counts.uncounted += 1,
        }
    }
    counts
}

/// Returns the number of records that wait in a stream, and its losses.
fn waiting(
    spools: &impl SpoolSource,
    name: &str,
) -> Result<(u64, Option<StreamLoss>), Box<dyn std::error::Error>> {
    let storage = spools.open(name)?;
    let released = storage.released()?;
    let note = storage.noted()?.ok_or("its writer, of an earlier version, notes nothing")?;
    let waiting = if note.failing_ns == 0 { 0 } else { note.queued };
    let records = note.lost + note.pending + note.queued - waiting;
    let loss = (records > 0 || waiting > 0).then(|| StreamLoss {
        stream: name.to_owned(),
        records,
        reason: note.reason.map(|reason| format!("{reason:?}")).unwrap_or_default(),
        last_ns: note.lost_ns,
        waiting,
        failing_ns: note.failing_ns,
    });
    // Those that the budget has removed are lost, and in a gap.
    Ok((note.durable.saturating_sub(released.max(note.removed)), loss))
}

/// Removes the records of deployments other than `kept` in the folder `lambdas` of the spools.
/// Returns their ids.
pub(crate) fn collect(lambdas: &Path, kept: &BTreeSet<String>) -> Vec<String> {
    // What cannot be listed or removed is in the log, and tried again at the next removal.
    let listed = if lambdas.exists() { entries(lambdas) } else { Ok(Vec::new()) };
    let listed = listed.inspect_err(
        |failure| tracing::warn!(%failure, "cannot list the spools of lambdas; they are kept"),
    );
    let old = listed.into_iter().flatten().filter_map(|path| {
        let id = path.file_name()?.to_str().filter(|id| !kept.contains(*id))?.to_owned();
        remove(&path);
        (!path.exists()).then_some(id)
    });
    let mut old: Vec<_> = old.collect();
    old.sort();
    old
}

#[cfg(test)]
mod tests {
    use std::num::NonZeroU8;

    use gleaner_spool::{
        BUDGET_MIN, BootId, GapReason, SpoolConfig, SpoolNote, SpoolTime, SpoolWriter,
    };

    use super::*;

    #[test]
    fn records_are_counted_before_they_are_read_and_what_cannot_be_is_stated() {
        let folder = tempfile::tempdir().unwrap();
        let spools = SpoolFolders(folder.path().to_owned());
        assert_eq!(count(&spools), SpoolCounts::default());
        for (stream, records) in [("events", 5), ("lambdas/brake", 3)] {
            let (boot, of) = (BootId([1; 16]), last_part(stream).to_owned());
            let config = SpoolConfig { stream: of, boot, budget: BUDGET_MIN };
            let mut writer = SpoolWriter::open(&folder.path().join(stream), config).unwrap();
            for _ in 0..records {
                writer.append(NonZeroU8::MIN, SpoolTime::now(), b"x").unwrap();
            }
            writer.commit().unwrap();
        }
        spools.open("events").unwrap().release(2).unwrap();
        assert_eq!(count(&spools), SpoolCounts { unsent: 6, ..SpoolCounts::default() });
        // On a full disk, two were refused, and four wait.
        let (stream, reason) = ("lambdas/brake".to_owned(), Some(GapReason::DiskFull));
        let times = SpoolNote { queued: 4, failing_ns: 5, lost_ns: 8, ..SpoolNote::default() };
        let note = SpoolNote { durable: 3, next: 99, lost: 1, pending: 2, reason, ..times };
        spools.open(&stream).unwrap().note(&note).unwrap();
        let (reason, last_ns, failing_ns) = ("DiskFull".to_owned(), 8, 5);
        let loss = StreamLoss { stream, records: 3, reason, last_ns, waiting: 4, failing_ns };
        let lost = vec![loss.clone()];
        assert_eq!(count(&spools), SpoolCounts { unsent: 6, uncounted: 0, lost });
        // As the version before notes it, with numbers 3 to 8 and the CRC-32 of zlib.
        let numbers = [3_u64, 9, 0, 1, 2, 8].map(u64::to_le_bytes).concat();
        let note = [&numbers[..], &[2, 1, 225, 63, 40, 84]].concat();
        fs::write(folder.path().join("lambdas/brake/note"), note).unwrap();
        let loss = StreamLoss { failing_ns: 8, ..loss };
        assert_eq!(count(&spools).lost, std::slice::from_ref(&loss));
        fs::write(folder.path().join("lambdas/odd"), "no folder").unwrap();
        // Of changed bytes; then as an earlier version has left it.
        let file = folder.path().join("events/note");
        fs::write(&file, [1; 69]).unwrap();
        assert_eq!(count(&spools).uncounted, 2);
        fs::remove_file(file).unwrap();
        assert_eq!(count(&spools), SpoolCounts { unsent: 3, uncounted: 2, lost: vec![loss] });
    }

    #[test]
    fn only_records_that_are_kept_stay() {
        let folder = tempfile::tempdir().unwrap();
        for id in ["a", "b", "c"] {
            fs::create_dir(folder.path().join(id)).unwrap();
            fs::write(folder.path().join(id).join("segment"), "").unwrap();
        }
        let kept = BTreeSet::from(["b".to_owned()]);
        assert_eq!(collect(folder.path(), &kept), ["a", "c"]);
        assert!(folder.path().join("b/segment").is_file());
        assert!(collect(folder.path(), &kept).is_empty());
    }
}
