//! `summary.json` of a run, where `gleaner-shim` cannot write all of it: what the recorder counted,
//! and what the processes of a lambda that was started again did together. Each counts for itself,
//! and only who started them has seen them all.

use std::path::Path;

use gleaner_base::{Exit, Failure, PlainFile, write_whole};
use gleaner_lambda::results::SUMMARY_MAX;
use gleaner_protocol::Live;
use gleaner_protocol::link::RecorderStatus;

/// What the processes of a run counted that have ended.
#[derive(Default)]
pub(super) struct Earlier {
    counted: Option<Live>,
    recorded: Option<Box<RecorderStatus>>,
    /// Wakes that ended with their process, which so did not count them.
    lost_wakes: u64,
}

impl Earlier {
    /// One more of each has ended. `last` and `recorded` are what they said last: of one that
    /// broke, up to a second of counts is missing.
    pub(super) fn add(
        &mut self,
        last: Option<Live>,
        recorded: Option<Box<RecorderStatus>>,
        has_lost_wake: bool,
    ) {
        self.lost_wakes += u64::from(has_lost_wake);
        self.add_recorded(recorded);
        self.counted = match (last, self.counted.take()) {
            (Some(last), Some(before)) => Some(last.after(&before)),
            (last, before) => last.or(before),
        };
    }

    fn add_recorded(&mut self, recorded: Option<Box<RecorderStatus>>) {
        self.recorded = match (recorded, self.recorded.take()) {
            (Some(last), Some(before)) => Some(Box::new(last.after(&before))),
            (last, before) => last.or(before),
        };
    }

    /// There will be no further one. Writes the counts of all, unless there are none but those of
    /// `last`, which ended well and for which the shim has written its own.
    ///
    /// # Errors
    ///
    /// A failure that names the file.
    pub(super) fn complete(
        mut self,
        last: Option<Live>,
        recorded: Option<Box<RecorderStatus>>,
        out: &Path,
    ) -> Result<(), Failure> {
        self.add_recorded(recorded);
        let Self { counted, mut recorded, lost_wakes } = self;
        // Sentences about writers of a thousand topics have no bound, and a summary has one.
        recorded
            .iter_mut()
            .flat_map(|status| &mut status.topics)
            .for_each(|topic| topic.qos_warnings.clear());
        // Not where the report says: it comes from the lambda's process.
        let path = out.join("summary.json");
        let last =
            last.map(|last| Live { unwritten: last.unwritten.max(unwritten(&path)), ..last });
        let sum = match (last, counted) {
            (Some(last), Some(before)) => last.after(&before),
            (None, Some(before)) => before,
            (Some(last), None) if lost_wakes > 0 || recorded.is_some() => last,
            _ => return Ok(()),
        };
        let sum =
            Live { faults: sum.faults.saturating_add(lost_wakes), recording: recorded, ..sum };
        let mut text = serde_json::to_vec_pretty(&sum).expect("counts are plain data");
        text.push(b'\n');
        if text.len() as u64 > SUMMARY_MAX.bytes() {
            let failure = Failure::new(
                Exit::Internal,
                format!("`{}` lacks what the recorder counted", path.display()),
            );
            return Err(
                failure.with_help("give fewer topics to one lambda: a summary has 4 MiB at most")
            );
        }
        write_whole(&path, &text).map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot write `{}`", path.display()), &error)
        })
    }
}

/// What the shim could not write of the last process: it alone knows what it met after the last
/// report.
fn unwritten(summary: &Path) -> u64 {
    let text = PlainFile::result(summary, SUMMARY_MAX).and_then(PlainFile::read_whole).ok();
    text.and_then(|text| serde_json::from_slice::<Live>(&text).ok())
        .map_or(0, |written| written.unwritten)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use gleaner_protocol::Recording;

    use super::*;

    fn live(wakes: u64, unwritten: u64) -> Live {
        let text = format!(
            r#"{{"lambda":"l","version":"1.0.0","kind":"wasm","out":"o","restarts":0,"up_s":1.0,"wakes":{wakes},"triggers":0,
            "faults":0,"skipped":0,"missed_ticks":0,"log_lines":0,"log_dropped":0,"triggers_refused":0,"backed_off":0,
            "unwritten":{unwritten},"topics":[],"network":{{"domain":0,"participants":0,"buffer_asked":0,"buffer_granted":0,
            "socket_drops":0}},"rss_bytes":0,"cpu_s":0.0}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    fn recorded(disk_suppressed: u64) -> Option<Box<RecorderStatus>> {
        let recording = Recording { disk_suppressed, ..Recording::default() };
        Some(Box::new(RecorderStatus { recording, ..RecorderStatus::default() }))
    }

    /// What is in `summary.json` after `complete`, where the shim has written `before`.
    fn completed(before: &Live, complete: impl FnOnce(&Path)) -> Live {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("summary.json");
        fs::write(&path, serde_json::to_vec(before).unwrap()).unwrap();
        complete(folder.path());
        serde_json::from_slice(&fs::read(&path).unwrap()).unwrap()
    }

    #[test]
    fn what_the_recorder_counted_is_added_to_what_the_shim_wrote() {
        let summary = completed(&live(5, 3), |out| {
            Earlier::default().complete(Some(live(5, 1)), recorded(7), out).unwrap();
        });
        assert_eq!((summary.wakes, summary.unwritten), (5, 3));
        assert_eq!(summary.recording.unwrap().recording.disk_suppressed, 7);
    }

    #[test]
    fn what_the_shim_wrote_stays_where_nobody_knows_more() {
        let summary = completed(&live(5, 3), |out| {
            Earlier::default().complete(Some(live(5, 1)), None, out).unwrap();
        });
        assert_eq!(summary, live(5, 3));
    }

    #[test]
    fn recorders_are_counted_together_also_those_whose_lambda_said_nothing() {
        let summary = completed(&live(5, 3), |out| {
            let mut earlier = Earlier::default();
            earlier.add(Some(live(10, 0)), recorded(1), false);
            earlier.add(None, recorded(20), true);
            earlier.complete(Some(live(5, 1)), recorded(300), out).unwrap();
        });
        assert_eq!((summary.wakes, summary.faults, summary.unwritten), (15, 1, 3));
        assert_eq!(summary.recording.unwrap().recording.disk_suppressed, 321);
    }
}
