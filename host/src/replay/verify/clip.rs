//! Compares a part of a journal over the clip that holds it: the journal decides on the wakes.

use std::path::Path;
use std::sync::Arc;

use gleaner_base::{Exit, Failure, excerpt};
use gleaner_drives::Replay;
use gleaner_journal::{Difference, InputView, JournalEntry, JournalHeader, WakeSource};
use gleaner_lambda::FaultKind;
use gleaner_lambda::manifest::Manifest;
use gleaner_messages::transport::{SampleMeta, Transport};
use gleaner_recorder::{ClipStatements, RecordError};

use super::lockstep::{LockstepDrive, LockstepError};
use super::reference::{contradiction, unreadable_clip};
use super::triggers::{JournalTriggers, restarts};
use super::{ReferenceJournal, Rerun, VerifyOutcome, counts_differ, different, seconds};
use crate::api::data::{Tick, Topic, Wake};
use crate::api::trace::offered;
use crate::replay::open::open;
use crate::replay::options::ReplayOptions;
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
    let drive = LockstepDrive::new(clip);
    let (rerun, clip, inputs) = Rerun::start(drive, options, manifest, reference, load)?;
    let mut verify_loop = ClipVerifyLoop {
        header: &header,
        start_ns: clip.start_ns(),
        rerun,
        clip,
        inputs,
        wakes: 0,
        uncovered: 0,
        uncovered_triggers: 0,
        interrupted: 0,
        is_live: reference.is_live(),
        losses: losses(&stated, reference.is_live()),
        triggers: JournalTriggers::of(&header.lambda),
    };
    while let Some(entry) = reference.next()? {
        verify_loop.wake(&entry)?;
    }
    let ClipVerifyLoop { wakes, uncovered, uncovered_triggers, interrupted, triggers, .. } =
        verify_loop;
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
    let interrupted_note = note_interrupted(interrupted);
    if uncovered + interrupted == wakes || triggers > 0 && uncovered_triggers == triggers {
        let uncovered = format!("{uncovered} of {wakes} wakes");
        return Err(unproven(&header.lambda, &uncovered, interrupted_note, reference.is_live()));
    }
    let later = restarts(&stated, &header.lambda);
    let notes = interrupted_note.into_iter().chain(note_restarts(later)).collect();
    Ok(VerifyOutcome { wakes, triggers, uncovered, uncovered_triggers, notes })
}

/// The failure of a clip over which no decision could be compared.
fn unproven(lambda: &str, uncovered: &str, note: Option<String>, is_live: bool) -> Failure {
    let message = format!("the clip alone proves no trigger of lambda `{lambda}`");
    let mut failure = Failure::new(Exit::Usage, message);
    let what =
        "in each wake that could prove one, the lambda had read samples from before the clip";
    failure.causes = vec![format!("{what} ({uncovered})")];
    failure.causes.extend(note);
    let help = "make `preroll` longer than the lambda looks back";
    match is_live {
        true => failure.with_help(help),
        false => failure
            .with_help(format!("{help}; this clip can be verified against its drive: {DRIVE}")),
    }
}

const CHANGED: &str = "the clip, or its journal, was changed after it was written";
/// The command that compares a whole journal.
const DRIVE: &str = "gleaner replay DIR DRIVE --verify JOURNAL";

/// The note on wakes that could not be repeated; `None` if there are none.
fn note_interrupted(wakes: u64) -> Option<String> {
    let wakes = match wakes {
        0 => return None,
        1 => "1 wake".to_owned(),
        wakes => format!("{wakes} wakes"),
    };
    Some(format!(
        "{wakes} that exceeded the deadline on the vehicle: not repeated, the lambda starts again \
         after each"
    ))
}

/// The note on later processes of the lambda, whose journals are not compared; `None` if there are
/// none.
fn note_restarts(times: usize) -> Option<String> {
    (times > 0).then(|| {
        format!("the lambda was started again in the clip ({times} times): compared until then")
    })
}

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

/// Describes the losses that the clip states; `None` if there are none. In a live clip, messages
/// may also be lost before the recorder. The lambda may have received those.
fn losses(stated: &ClipStatements, is_live: bool) -> Option<String> {
    let count = |count: Option<u64>| count.map_or("unknown".to_owned(), |count| count.to_string());
    let lost = stated.clip().topics.iter().flat_map(|topic| {
        let before = if is_live { topic.lost } else { Some(0) };
        let causes =
            [(topic.overwritten, "overwritten"), (topic.too_big, "too big"), (before, "lost")];
        let lost = causes.into_iter().filter(|(lost, _)| *lost != Some(0));
        lost.map(|(lost, why)| format!("{}: {} {why}", excerpt(&topic.topic), count(lost)))
    });
    let lost = lost.collect::<Vec<_>>();
    (!lost.is_empty()).then(|| lost.join(", "))
}

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
    /// Wakes that ended because their time was over, which depends on the machine.
    interrupted: u64,
    /// Set if the journal was written live.
    is_live: bool,
    losses: Option<String>,
    triggers: JournalTriggers,
}

impl ClipVerifyLoop<'_> {
    fn wake(&mut self, entry: &JournalEntry) -> Result<(), Failure> {
        let before: Vec<_> = self.inputs.iter().map(|topic| offered(topic)).collect();
        if self.wakes == 0 {
            self.join(entry)?
        } else {
            let owed = self.owed(entry)?;
            self.deliver(owed.into_iter())?
        }
        let wake = self.cause(entry)?;
        let is_interrupted = self.is_live && was_interrupted(entry);
        let mut now = match is_interrupted {
            true => self.rerun.skip(wake, entry),
            false => self.rerun.wake(wake).clone(),
        };
        self.complete_views(&before, &mut now.seen, &entry.seen);
        let is_covered = self.covers(entry);
        if !is_covered {
            let JournalEntry { triggers, fault, log, .. } = entry.clone();
            now = JournalEntry { triggers, fault, log, ..now };
        }
        if !is_covered || self.unknown_state().is_some() {
            // State from before the clip may change the lambda's fuel and the samples that it
            // reads.
            now.fuel = entry.fuel;
            for (now, journal) in now.seen.iter_mut().zip(&entry.seen) {
                now.reach = journal.reach;
            }
        }
        if let Some(difference) = entry.differs_from(&now, &self.header.inputs, false) {
            let is_same =
                |(a, b): (&InputView, &InputView)| InputView { reach: b.reach, ..*a } == *b;
            let saw_the_same =
                entry.at_ns == now.at_ns && entry.seen.iter().zip(&now.seen).all(is_same);
            return Err(match self.too_late(entry, &now).or_else(|| self.unknown_state()) {
                Some(why) if saw_the_same => self.unsettled(entry, &difference, &why),
                _ => self.differs(entry, &difference),
            });
        }
        self.wakes += 1;
        self.interrupted += u64::from(is_interrupted);
        self.uncovered += u64::from(!is_covered && !is_interrupted);
        if is_interrupted || !is_covered {
            self.uncovered_triggers += entry.triggers.len() as u64;
        }
        self.triggers.add(entry);
        Ok(())
    }

    /// Adds to the views of now what the clip cannot contain. `before` are the numbers of samples
    /// before the wake.
    fn complete_views(&self, before: &[u64], now: &mut [InputView], journal: &[InputView]) {
        for ((topic, before), (now, journal)) in
            self.inputs.iter().zip(before).zip(now.iter_mut().zip(journal))
        {
            // Some samples before the first wake may lie before the clip. A live clip may have a
            // topic later than its wakes.
            let is_first = self.wakes == 0 || self.is_live && *before == 0;
            if is_first && offered(topic) - before < journal.new {
                (now.new, now.digest) = (journal.new, journal.digest);
                now.newest = now.newest.or(journal.newest);
            }
            if offered(topic) == 0 {
                // The newest sample lies before the clip.
                now.newest = journal.newest;
            }
            if self.is_live {
                self.without_refused(now, journal);
            }
        }
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
        if self.is_live && self.header.wakes_before == 0 {
            // The lambda was started after them: in its first wake, all that it received is new.
            self.clip.discard(earlier.into_iter());
        } else {
            self.deliver(earlier.into_iter())?;
        }
        self.rerun.entry_builder.skip();
        self.deliver(new.into_iter())
    }

    /// Returns how many samples each input receives before this wake. A live clip lacks samples
    /// that were refused before they reached a reader, so there the newest one decides. A sample
    /// that a writer keeps for later readers comes again after a restart of the ingress.
    fn owed(&mut self, entry: &JournalEntry) -> Result<Vec<u64>, Failure> {
        let until_ns = entry.at_ns.saturating_add(SLACK_NS);
        let mut owed = Vec::new();
        for (input, seen) in entry.seen.iter().enumerate() {
            owed.push(match seen.newest {
                _ if !self.is_live => seen.new,
                Some(newest) if seen.new > 0 => {
                    let found = self.clip.ahead(input, until_ns, |meta| is_sample(meta, newest));
                    let known = self.inputs[input].newest().ok().flatten();
                    let is_known = known.is_some_and(|known| is_sample(known.meta(), newest));
                    let is_later = offered(&self.inputs[input]) == 0;
                    let missing = if is_later || is_known { 0 } else { seen.new };
                    found.map_err(unreadable)?.unwrap_or(missing)
                }
                _ => 0,
            });
        }
        Ok(owed)
    }

    /// Adds samples that were refused on the vehicle, as larger than `max_size`, to the view of an
    /// input that is the same otherwise: the clip does not contain them. The first wake may also
    /// have the refused samples of earlier ones in the place of its own.
    fn without_refused(&self, now: &mut InputView, journal: &InputView) {
        let is_same = now.newest == journal.newest && now.digest == journal.digest;
        if is_same && now.new < journal.new {
            now.new = journal.new;
        } else if self.wakes == 0 && self.losses.is_some() && now.newest == journal.newest {
            (now.new, now.digest) = (journal.new, journal.digest);
        }
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
                topic.sample(leases.find(|lease| is_sample(&lease.meta().sample, (writer, seq)))?),
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
                let help = format!("the clip states that it lacks messages ({losses})");
                match self.is_live {
                    true => failure.with_help(help),
                    false => failure
                        .with_help(format!("{help}: raise `preroll_size`; {DRIVE} settles it")),
                }
            }
        }
    }

    /// The reason why the lambda may have seen less on the vehicle than now, if it did.
    fn too_late(&self, entry: &JournalEntry, now: &JournalEntry) -> Option<String> {
        let mut inputs = self.header.inputs.iter().zip(entry.seen.iter().zip(&now.seen));
        let (input, _) =
            inputs.find(|(_, (journal, now))| self.is_live && now.reach > journal.reach)?;
        Some(format!(
            "newer samples of input `{}` may have replaced older ones before the lambda read them: \
             raise its `depth`",
            input.name
        ))
    }

    /// The reason why the lambda may have state that is not in the clip, if any.
    fn unknown_state(&self) -> Option<String> {
        if self.header.wakes_before > 0 {
            let times = self.header.wakes_before;
            return Some(format!(
                "the lambda had run {times} times before the clip begins, and its variables from \
                 then are not in the clip"
            ));
        }
        if self.uncovered > 0 {
            return Some(
                "in earlier wakes the lambda had read samples from before the clip, and what it \
                 kept from them is not in the clip"
                    .to_owned(),
            );
        }
        (self.interrupted > 0).then(|| {
            "an earlier wake exceeded the deadline, and what the lambda kept from it is not in the \
             clip"
                .to_owned()
        })
    }

    /// The failure of a wake with the same inputs and another decision, which may depend on state
    /// that is not in the clip.
    fn unsettled(&self, entry: &JournalEntry, difference: &Difference, why: &str) -> Failure {
        let message = format!("the clip alone does not settle {}", self.describe_wake(entry));
        let failure = Failure { exit: Exit::Usage, ..different(message, difference) };
        match self.is_live {
            true => failure.with_help(why),
            false => failure.with_help(format!("{why}: {DRIVE} settles it")),
        }
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

/// Returns whether the wake ended because its time was over: another machine, or the same one with
/// less load, completes it.
fn was_interrupted(entry: &JournalEntry) -> bool {
    entry.fault.as_ref().is_some_and(|fault| fault.kind == FaultKind::Deadline)
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
