//! Compares a part of a journal over the clip that holds it: the journal decides on the wakes.

use std::path::Path;
use std::sync::Arc;

use gleaner_base::{Exit, Failure, excerpt};
use gleaner_drives::Replay;
use gleaner_journal::{Difference, JournalEntry, JournalHeader, WakeSource};
use gleaner_lambda::manifest::Manifest;
use gleaner_recorder::{ClipStatements, RecordError};
use gleaner_transport::{SampleMeta, Transport};

use super::lockstep::{LockstepDrive, LockstepError};
use super::reference::{contradiction, unreadable_clip};
use super::triggers::JournalTriggers;
use super::{ReferenceJournal, Rerun, VerifyOutcome, counts_differ, different, seconds};
use crate::api::data::{Tick, Topic, Wake};
use crate::api::trace::offered;
use crate::replay::ReplayOptions;
use crate::replay::open::open;
use crate::session_setup::Load;

/// Time by which a visible sample may be newer than the one that caused the wake, where each topic
/// has a thread of its own.
const SLACK_NS: i64 = 1_000_000_000;

pub(super) fn verify(
    options: &ReplayOptions,
    manifest: &Manifest,
    reference: &mut ReferenceJournal,
    load: Load<'_>,
) -> Result<VerifyOutcome, Failure> {
    let clip = open(options).map_err(unreadable_clip)?;
    let header = reference.header().clone();
    check_inputs(&clip, &header)?;
    let stated = reference.clip.take().expect("a part of a journal is in a clip");
    check_statements(reference.path(), &stated)?;
    let (rerun, clip, inputs) = Rerun::start(LockstepDrive::new(clip), options, manifest, load)?;
    let engine = rerun.engine.clone();
    let mut verify_loop = ClipVerifyLoop {
        header: &header,
        start_ns: clip.start_ns(),
        rerun,
        clip,
        inputs,
        wakes: 0,
        uncovered: 0,
        uncovered_triggers: 0,
        losses: losses(&stated),
        triggers: JournalTriggers::of(&header.lambda),
    };
    while let Some(entry) = reference.next()? {
        verify_loop.wake(&entry)?;
    }
    let ClipVerifyLoop { wakes, uncovered, uncovered_triggers, triggers, .. } = verify_loop;
    if wakes == 0 {
        return Err(reference.empty());
    }
    let Some(end) = reference.reader().end() else {
        let message = format!("the journal in clip `{}` has no end", reference.path().display());
        return Err(Failure::new(Exit::Differs, message).with_help(CHANGED));
    };
    let wrong = counts_differ("wakes", end.wakes, wakes).or_else(|| triggers.differ(&stated));
    if let Some(difference) = wrong {
        return Err(different("the clip and its journal name different triggers", &difference)
            .with_help(CHANGED));
    }
    let triggers = triggers.count;
    if uncovered == wakes || triggers > 0 && uncovered_triggers == triggers {
        let message = format!("the clip alone proves no trigger of lambda `{}`", header.lambda);
        let mut failure = Failure::new(Exit::Usage, message);
        let what =
            "in each wake that could prove one, the lambda had read samples from before the clip";
        failure.causes = vec![format!("{what} ({uncovered} of {wakes} wakes)")];
        return Err(failure.with_help(
            "make `preroll` longer than the lambda looks back; this clip can be verified against \
             its drive: \
             gleaner replay DIR DRIVE --verify JOURNAL",
        ));
    }
    Ok(VerifyOutcome { engine, wakes, triggers, uncovered, uncovered_triggers })
}

const CHANGED: &str = "the clip, or its journal, was changed after it was written";

/// Refuses a clip that lacks the topic of an input.
fn check_inputs(clip: &Replay, header: &JournalHeader) -> Result<(), Failure> {
    let topics = clip.topics();
    let missing = header
        .inputs
        .iter()
        .find(|input| !topics.iter().any(|topic| topic.topic == input.wire_topic));
    let Some(input) = missing else { return Ok(()) };
    let message = format!(
        "the clip holds no `{}`, which input `{}` of the lambda reads",
        input.wire_topic, input.name
    );
    let help = "add the topic to [record] for further clips; this one can be verified against its \
                drive only: \
                gleaner replay DIR DRIVE --verify JOURNAL";
    Err(Failure::new(Exit::Usage, message).with_help(help))
}

/// Refuses a clip whose messages contradict its records.
fn check_statements(path: &Path, stated: &ClipStatements) -> Result<(), Failure> {
    match stated.contradicted(path) {
        Ok(None) => Ok(()),
        Ok(Some(error)) => Err(contradiction(path, &error)),
        Err(RecordError::Unreadable { source, .. }) => Err(unreadable_clip(*source)),
        Err(error) => Err(Failure { exit: Exit::Usage, ..error.into() }),
    }
}

/// Describes the losses that the clip states; `None` if there are none.
fn losses(stated: &ClipStatements) -> Option<String> {
    let count = |count: Option<u64>| count.map_or("unknown".to_owned(), |count| count.to_string());
    let lost = stated.clip().topics.iter().flat_map(|topic| {
        let causes = [(topic.overwritten, "overwritten"), (topic.too_big, "too big")];
        let lost = causes.into_iter().filter(|(lost, _)| *lost != Some(0));
        lost.map(|(lost, why)| format!("{}: {} {why}", excerpt(&topic.topic), count(lost)))
    });
    let lost = lost.collect::<Vec<_>>();
    (!lost.is_empty()).then(|| lost.join(", "))
}

/// The loop of a comparison over a clip.
struct ClipVerifyLoop<'a> {
    header: &'a JournalHeader,
    rerun: Rerun,
    clip: LockstepDrive,
    start_ns: i64,
    inputs: Vec<Arc<Topic>>,
    wakes: u64,
    /// Wakes in which the lambda had read samples from before the clip, and their triggers.
    uncovered: u64,
    uncovered_triggers: u64,
    /// Losses that the clip states.
    losses: Option<String>,
    /// The triggers of the journal.
    triggers: JournalTriggers,
}

impl ClipVerifyLoop<'_> {
    fn wake(&mut self, entry: &JournalEntry) -> Result<(), Failure> {
        let before: Vec<_> = self.inputs.iter().map(|topic| offered(topic)).collect();
        if self.wakes == 0 {
            self.join(entry)?
        } else {
            self.deliver(entry.seen.iter().map(|seen| seen.new))?
        }
        let wake = self.cause(entry)?;
        let mut now = self.rerun.wake(wake).clone();
        for ((topic, before), (now, journal)) in
            self.inputs.iter().zip(before).zip(now.seen.iter_mut().zip(&entry.seen))
        {
            // Some samples before the first wake may lie before the clip.
            if self.wakes == 0 && offered(topic) - before < journal.new {
                (now.new, now.digest) = (journal.new, journal.digest);
                now.newest = now.newest.or(journal.newest);
            }
        }
        let is_covered = self.covers(entry);
        if !is_covered {
            let JournalEntry { triggers, fault, log, .. } = entry.clone();
            now = JournalEntry { triggers, fault, log, ..now };
        }
        if !is_covered || self.header.wakes_before > 0 {
            // State from before the clip may change the lambda's fuel and the samples that it
            // reads.
            now.fuel = entry.fuel;
            for (now, journal) in now.seen.iter_mut().zip(&entry.seen) {
                now.reach = journal.reach;
            }
        }
        if let Some(difference) = entry.differs_from(&now, &self.header.inputs, false) {
            let saw_the_same = entry.at_ns == now.at_ns && entry.seen == now.seen;
            return Err(if saw_the_same && self.header.wakes_before > 0 {
                self.unsettled(entry, &difference)
            } else {
                self.differs(entry, &difference)
            });
        }
        self.wakes += 1;
        self.uncovered += u64::from(!is_covered);
        self.uncovered_triggers += if is_covered { 0 } else { entry.triggers.len() as u64 };
        self.triggers.add(entry);
        Ok(())
    }

    /// Delivers the samples up to those that were newest in the first wake. Samples since the wake
    /// before it are summed up separately.
    fn join(&mut self, entry: &JournalEntry) -> Result<(), Failure> {
        let until_ns = entry.at_ns.saturating_add(SLACK_NS);
        let (mut earlier, mut new) = (Vec::new(), Vec::new());
        for (input, seen) in entry.seen.iter().enumerate() {
            let is_newest =
                |meta: &SampleMeta| seen.newest.is_some_and(|newest| is_sample(meta, newest));
            let ahead = match seen.newest {
                Some(_) => {
                    self.clip.ahead(input, until_ns, is_newest).map_err(unreadable)?.unwrap_or(0)
                }
                None => 0,
            };
            earlier.push(ahead.saturating_sub(seen.new));
            new.push(ahead.min(seen.new));
        }
        self.deliver(earlier.into_iter())?;
        self.rerun.entry_builder.skip();
        self.deliver(new.into_iter())
    }

    fn deliver(&mut self, owed: impl Iterator<Item = u64>) -> Result<(), Failure> {
        self.clip.deliver(owed).map_err(unreadable)
    }

    fn cause(&self, entry: &JournalEntry) -> Result<Wake, Failure> {
        let (writer, seq) = match (entry.cause, self.header.event_input) {
            (WakeSource::Tick { missed }, None) => {
                return Ok(Wake::Tick(Tick { at_ns: entry.at_ns, missed }));
            }
            (WakeSource::Tick { .. }, Some(_)) => {
                let (journal, now) = ("a tick".to_owned(), "samples, by its manifest".to_owned());
                let what = "cause of the wake".to_owned();
                return Err(self.differs(entry, &Difference { what, journal, now }));
            }
            (WakeSource::Sample { writer, seq }, _) => (writer, seq),
        };
        let topic = self.header.event_input.and_then(|input| self.inputs.get(input));
        let found = topic.and_then(|topic| {
            let reader = topic.reader();
            let head = reader.head();
            let oldest = head.saturating_sub(reader.depth() as u64);
            let mut leases = (oldest..head).rev().filter_map(|position| reader.get(position));
            Some(Wake::Event(
                topic.sample(leases.find(|lease| is_sample(lease.meta(), (writer, seq)))?),
            ))
        });
        found.ok_or_else(|| {
            let difference = Difference {
                what: "the sample that woke the lambda".to_owned(),
                journal: format!("number {seq}"),
                now: "missing".to_owned(),
            };
            self.differs(entry, &difference)
        })
    }

    /// Returns whether the clip holds every sample that the lambda read in this wake. It cannot
    /// read further back than its ring.
    fn covers(&self, entry: &JournalEntry) -> bool {
        let mut inputs = self.inputs.iter().zip(&entry.seen);
        inputs.all(|(topic, seen)| {
            seen.reach.min(topic.reader().depth() as u64) <= topic.reader().head()
        })
    }

    fn differs(&self, entry: &JournalEntry, difference: &Difference) -> Failure {
        match &self.losses {
            None => different(format!("{} differs", self.describe_wake(entry)), difference)
                .with_help(CHANGED),
            Some(losses) => {
                let message =
                    format!("the clip alone does not settle {}", self.describe_wake(entry));
                let failure = Failure { exit: Exit::Usage, ..different(message, difference) };
                failure.with_help(format!(
                    "the clip states that it lacks messages ({losses}): raise `preroll_size`; \
                     gleaner replay DIR DRIVE --verify JOURNAL settles it"
                ))
            }
        }
    }

    /// The failure of a wake with the same inputs and another decision, which may depend on state
    /// from before the clip.
    fn unsettled(&self, entry: &JournalEntry, difference: &Difference) -> Failure {
        let message = format!("the clip alone does not settle {}", self.describe_wake(entry));
        let failure = Failure { exit: Exit::Usage, ..different(message, difference) };
        failure.with_help(format!(
            "the lambda had run {} times before the clip begins, and its variables from then are \
             not in the clip: \
             gleaner replay DIR DRIVE --verify JOURNAL settles it",
            self.header.wakes_before
        ))
    }

    fn describe_wake(&self, entry: &JournalEntry) -> String {
        let number = self.header.wakes_before.saturating_add(self.wakes).saturating_add(1);
        let at = seconds(entry.at_ns, self.start_ns);
        format!("wake {number} of lambda `{}`, at {at:.6} s of the clip,", self.header.lambda)
    }
}

/// Returns whether `meta` is of the sample of this writer and number, of which a clip keeps the
/// lower 32 bits.
fn is_sample(meta: &SampleMeta, (writer, seq): ([u8; 16], u64)) -> bool {
    meta.writer.0 == writer && meta.seq as u32 == seq as u32
}

fn unreadable(error: LockstepError) -> Failure {
    match error {
        LockstepError::Drive(error) => unreadable_clip(error),
        LockstepError::TooFarAhead => Failure::caused_by(
            Exit::Differs,
            "the samples of this clip are not in the order of the journal",
            &error,
        ),
    }
}
