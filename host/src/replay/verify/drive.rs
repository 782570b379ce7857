//! A journal against its drive: the schedule leads, and each wake must be the next in the journal.

use std::sync::Arc;

use gleaner_base::{Exit, Failure};
use gleaner_drives::{Replay, Step};
use gleaner_journal::{Difference, DriveDigest, End, Entry, Woken};
use gleaner_lambda::manifest::Manifest;

use super::{Claim, Proved, Remake, counts_differ, different, seconds};
use crate::api::data::{Topic, Wake};
use crate::api::trace::offered;
use crate::replay::Options;
use crate::replay::course::{self, Course, Span};
use crate::replay::digests::Digests;
use crate::replay::open::{DriveError, open_drives};
use crate::schedule::Schedule;
use crate::stage::Load;

pub(super) fn prove(
    options: &Options,
    manifest: &Manifest,
    claim: &mut Claim,
    load: Load<'_>,
) -> Result<Proved, Failure> {
    if let Some(difference) =
        counts_differ("wakes before the first one", claim.header().wakes_before, 0)
    {
        let failure = different("this journal does not begin with its lambda", &difference);
        return Err(failure.with_help(
            "name the journal of a whole replay; a clip: gleaner verify CLIP --lambda DIR",
        ));
    }
    let digests = Digests::start(options.drives.files.clone());
    let (drive, part) = open_drives(options)?;
    let span = Span::of(&drive, part);
    let start_ns = drive.start_ns().unwrap_or(0);
    let (remake, mut drive, inputs) = Remake::start(drive, options, manifest, load)?;
    let schedule = Schedule::new(manifest, &inputs);
    let mut proof = Proof { remake, schedule, claim, start_ns, wakes: 0, triggers: 0 };
    let outcome =
        course::take(&mut drive, span, &mut proof).and_then(|reached| match reached.broken {
            Some(error) => Err(damaged(error, proof.wakes)),
            None if reached.stopped => Ok(()),
            None => proof.end(&inputs),
        });
    let Proof { remake, wakes, triggers, claim, .. } = proof;
    if let Err(failure) = outcome {
        return Err(with_drive(failure, claim, digests));
    }
    match claim.reader().end() {
        Some(end) => {
            if let Some(difference) = drives_differ(end, digests)? {
                return Err(different(
                    "every decision is the same, but not the drive",
                    &difference,
                ));
            }
        }
        None if wakes == 0 => return Err(claim.empty()),
        None => {}
    }
    Ok(Proved { engine: remake.engine, wakes, triggers, uncovered: 0, uncovered_triggers: 0 })
}

struct Proof<'a> {
    remake: Remake,
    schedule: Schedule,
    claim: &'a mut Claim,
    start_ns: i64,
    wakes: u64,
    triggers: u64,
}

impl Course for Proof<'_> {
    fn schedule(&mut self) -> &mut Schedule {
        &mut self.schedule
    }

    fn wake(&mut self, wake: Wake) -> Result<bool, Failure> {
        let at_ns = wake.at_ns();
        if self.remake.judge.is_backing_off(&wake) {
            return Ok(true);
        }
        let Some(entry) = self.claim.next()? else {
            // Its writer died: what it holds is proved.
            if self.claim.reader().end().is_none() {
                return Ok(false);
            }
            let (what, now) = ("wake".to_owned(), in_words(at_ns, self.start_ns));
            return Err(self
                .differs(at_ns, &Difference { what, journal: "no further one".to_owned(), now }));
        };
        let now = self.remake.wake(wake);
        if let Some(difference) = entry.differs_from(now, &self.claim.header().inputs, true) {
            return Err(self.differs(at_ns, &difference));
        }
        self.wakes += 1;
        self.triggers += entry.triggers.len() as u64;
        Ok(true)
    }

    fn sample(&mut self, _: &Replay, _: &Step) -> Result<(), Failure> {
        Ok(())
    }
}

impl Proof<'_> {
    /// The drive must end as the journal does.
    fn end(&mut self, inputs: &[Arc<Topic>]) -> Result<(), Failure> {
        if let Some(Entry { at_ns, cause, .. }) = self.claim.next()? {
            let kind = if matches!(cause, Woken::Tick { .. }) { "a tick" } else { "a sample" };
            let journal = format!("{kind}, {}", in_words(at_ns, self.start_ns));
            let difference =
                Difference { what: "wake".to_owned(), journal, now: "no further one".to_owned() };
            return Err(self.differs(at_ns, &difference));
        }
        let Some(end) = self.claim.reader().end() else { return Ok(()) };
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
                let name = &self.remake.lambda;
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
            format!("wake {number} of lambda `{}`, at {at:.6} s, differs", self.remake.lambda),
            difference,
        )
    }
}

fn in_words(at_ns: i64, start_ns: i64) -> String {
    format!("at {:.6} s", seconds(at_ns, start_ns))
}

fn damaged(error: gleaner_drives::ReplayError, wakes: u64) -> Failure {
    let help = format!(
        "the {wakes} decisions before the damage are the same; copy the file again if you can"
    );
    Failure::from(DriveError(error)).with_help(help)
}

/// What is different about the drives as files, byte for byte: a byte that no lambda reads may have
/// changed, too.
fn drives_differ(end: &End, digests: Digests) -> Result<Option<Difference>, Failure> {
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

/// The failure, with what is different about the drives as files, if the journal has an end to
/// tell.
fn with_drive(mut failure: Failure, claim: &mut Claim, digests: Digests) -> Failure {
    if failure.exit != Exit::Differs {
        return failure;
    }
    while let Ok(Some(_)) = claim.next() {}
    if let Some(Ok(Some(difference))) = claim.reader().end().map(|end| drives_differ(end, digests))
    {
        failure.causes.extend(different("", &difference).causes);
    }
    failure
}
