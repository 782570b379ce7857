//! Compares a journal over its drive: the schedule decides on the wakes, and each must be the next
//! in the journal.

use std::sync::Arc;

use gleaner_base::{Exit, Failure};
use gleaner_drives::{Replay, ReplayStep};
use gleaner_journal::{Difference, DriveDigest, JournalEnd, JournalEntry, WakeSource};
use gleaner_lambda::manifest::Manifest;

use super::{ReferenceJournal, Rerun, VerifyOutcome, counts_differ, different, seconds};
use crate::api::data::{Topic, Wake};
use crate::api::trace::offered;
use crate::replay::digests::Digests;
use crate::replay::drive_loop::{self, DriveHandler, DriveSpan};
use crate::replay::open::{DriveError, open_drives};
use crate::replay::options::ReplayOptions;
use crate::schedule::WakeSchedule;
use crate::session_setup::Load;

pub(super) fn verify(
    options: &ReplayOptions,
    manifest: &Manifest,
    reference: &mut ReferenceJournal,
    load: Load<'_>,
) -> Result<VerifyOutcome, Failure> {
    if let Some(difference) =
        counts_differ("wakes before the first one", reference.header().wakes_before, 0)
    {
        let failure = different("this journal does not begin with its lambda", &difference);
        return Err(failure.with_help(
            "name the journal of a whole replay; a clip: gleaner verify CLIP --lambda DIR",
        ));
    }
    let digests = Digests::start(options.drives.files.clone());
    let (drive, part) = open_drives(options)?;
    let span = DriveSpan::of(&drive, part);
    let start_ns = drive.start_ns().unwrap_or(0);
    let (rerun, mut drive, inputs) = Rerun::start(drive, options, manifest, reference, load)?;
    let schedule = WakeSchedule::new(manifest, &inputs);
    let mut verify_loop =
        VerifyLoop { rerun, schedule, reference, start_ns, wakes: 0, triggers: 0 };
    let outcome = drive_loop::run(&mut drive, span, &mut verify_loop).and_then(|reached| {
        match reached.broken {
            Some(error) => Err(damaged(error, verify_loop.wakes)),
            None if reached.stopped => Ok(()),
            None => verify_loop.end(&inputs),
        }
    });
    let VerifyLoop { wakes, triggers, reference, .. } = verify_loop;
    if let Err(failure) = outcome {
        return Err(with_drive(failure, reference, digests));
    }
    match reference.reader().end() {
        Some(end) => {
            if let Some(difference) = drives_differ(end, digests)? {
                return Err(different(
                    "every decision is the same, but the drive differs",
                    &difference,
                ));
            }
        }
        None if wakes == 0 => return Err(reference.empty()),
        None => {}
    }
    Ok(VerifyOutcome { wakes, triggers, uncovered: 0, uncovered_triggers: 0, notes: Vec::new() })
}

struct VerifyLoop<'a> {
    rerun: Rerun,
    schedule: WakeSchedule,
    reference: &'a mut ReferenceJournal,
    start_ns: i64,
    wakes: u64,
    triggers: u64,
}

impl DriveHandler for VerifyLoop<'_> {
    fn schedule(&mut self) -> &mut WakeSchedule {
        &mut self.schedule
    }

    fn wake(&mut self, wake: Wake) -> Result<bool, Failure> {
        let at_ns = wake.at_ns();
        if self.rerun.invoker.is_backing_off(&wake) {
            return Ok(true);
        }
        let Some(entry) = self.reference.next()? else {
            // The writer of the journal died: all of it was compared.
            if self.reference.reader().end().is_none() {
                return Ok(false);
            }
            let (what, now) = ("wake".to_owned(), at_seconds(at_ns, self.start_ns));
            return Err(self
                .differs(at_ns, &Difference { what, journal: "no further wake".to_owned(), now }));
        };
        let now = self.rerun.wake(wake);
        if let Some(difference) = entry.differs_from(now, &self.reference.header().inputs, true) {
            return Err(self.differs(at_ns, &difference));
        }
        self.wakes += 1;
        self.triggers += entry.triggers.len() as u64;
        Ok(true)
    }

    fn sample(&mut self, _: &Replay, _: &ReplayStep) -> Result<(), Failure> {
        Ok(())
    }
}

impl VerifyLoop<'_> {
    /// Checks that the drive ends like the journal.
    fn end(&mut self, inputs: &[Arc<Topic>]) -> Result<(), Failure> {
        if let Some(JournalEntry { at_ns, cause, .. }) = self.reference.next()? {
            let kind = if matches!(cause, WakeSource::Tick { .. }) { "a tick" } else { "a sample" };
            let journal = format!("{kind}, {}", at_seconds(at_ns, self.start_ns));
            let difference =
                Difference { what: "wake".to_owned(), journal, now: "no further wake".to_owned() };
            return Err(self.differs(at_ns, &difference));
        }
        let Some(end) = self.reference.reader().end() else { return Ok(()) };
        let samples = inputs.iter().enumerate().find_map(|(input, topic)| {
            let journal = end.samples.get(input).copied().unwrap_or(0);
            counts_differ(
                format!("samples of input `{}` in all", topic.name()),
                journal,
                offered(topic),
            )
        });
        match counts_differ("wakes", end.wakes, self.wakes).or(samples) {
            None => Ok(()),
            Some(difference) => {
                let name = &self.rerun.lambda;
                Err(different(
                    format!("the drive of lambda `{name}` does not end as in the journal"),
                    &difference,
                ))
            }
        }
    }

    fn differs(&self, at_ns: i64, difference: &Difference) -> Failure {
        let number = self.wakes + 1;
        let at = seconds(at_ns, self.start_ns);
        different(
            format!("wake {number} of lambda `{}`, at {at:.6} s, differs", self.rerun.lambda),
            difference,
        )
    }
}

fn at_seconds(at_ns: i64, start_ns: i64) -> String {
    format!("at {:.6} s", seconds(at_ns, start_ns))
}

fn damaged(error: gleaner_drives::ReplayError, wakes: u64) -> Failure {
    let why = error.help().map(|help| format!("; {help}")).unwrap_or_default();
    let help = format!("the {wakes} decisions before the damage are the same{why}");
    Failure::from(DriveError(error)).with_help(help)
}

/// Returns the difference of the drives as files: a byte that no lambda reads may have changed,
/// too.
fn drives_differ(end: &JournalEnd, digests: Digests) -> Result<Option<Difference>, Failure> {
    let now = digests.take()?;
    let mut pairs = end.drives.iter().zip(&now);
    let changed =
        pairs.find(|(journal, now)| (journal.bytes, journal.crc32) != (now.bytes, now.crc32));
    let changed = changed.map(|(journal, now)| {
        let side = |drive: &DriveDigest| {
            format!("`{}`, {} bytes, CRC-32 {:08x}", drive.name, drive.bytes, drive.crc32)
        };
        Difference { what: format!("drive `{}`", now.name), journal: side(journal), now: side(now) }
    });
    let number = || {
        let (journal, now) = (end.drives.len(), now.len());
        let what = "number of drives".to_owned();
        (journal != now).then(|| Difference {
            what,
            journal: journal.to_string(),
            now: now.to_string(),
        })
    };
    Ok(changed.or_else(number))
}

/// Adds the difference of the drives as files to the failure, if the journal has an end, which
/// names them.
fn with_drive(mut failure: Failure, reference: &mut ReferenceJournal, digests: Digests) -> Failure {
    if failure.exit != Exit::Differs {
        return failure;
    }
    while let Ok(Some(_)) = reference.next() {}
    if let Some(Ok(Some(difference))) =
        reference.reader().end().map(|end| drives_differ(end, digests))
    {
        failure.causes.extend(different("", &difference).causes);
    }
    failure
}
