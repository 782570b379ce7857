//! The part of a journal against the clip that holds it: the journal leads.

use std::path::Path;
use std::sync::Arc;

use gleaner_base::{Exit, Failure, excerpt};
use gleaner_drives::Replay;
use gleaner_journal::{Difference, Entry, Header, Woken};
use gleaner_lambda::manifest::Manifest;
use gleaner_recorder::{RecordError, Stated};
use gleaner_transport::{SampleMeta, Transport};

use super::claim::{unreadable_clip, untrue};
use super::paced::{PaceError, Paced};
use super::triggers::Triggers;
use super::{Claim, Proved, Remake, counts_differ, different, seconds};
use crate::api::data::{Tick, Topic, Wake};
use crate::api::trace::offered;
use crate::replay::Options;
use crate::replay::open::open;
use crate::stage::Load;

/// A sample may be newer than the one that caused a wake by so much, where each topic has a thread
/// of its own.
const SLACK_NS: i64 = 1_000_000_000;

pub(super) fn prove(
    options: &Options,
    manifest: &Manifest,
    claim: &mut Claim,
    load: Load<'_>,
) -> Result<Proved, Failure> {
    let clip = open(options).map_err(unreadable_clip)?;
    let header = claim.header().clone();
    holds_all_inputs(&clip, &header)?;
    let stated = claim.clip.take().expect("a part of a journal is in a clip");
    holds_what_it_states(claim.path(), &stated)?;
    let (remake, clip, inputs) = Remake::start(Paced::new(clip), options, manifest, load)?;
    let engine = remake.engine.clone();
    let mut proof = Proof {
        header: &header,
        start_ns: clip.start_ns(),
        remake,
        clip,
        inputs,
        wakes: 0,
        uncovered: 0,
        uncovered_triggers: 0,
        losses: losses(&stated),
        triggers: Triggers::of(&header.lambda),
    };
    while let Some(entry) = claim.next()? {
        proof.wake(&entry)?;
    }
    let Proof { wakes, uncovered, uncovered_triggers, triggers, .. } = proof;
    if wakes == 0 {
        return Err(claim.empty());
    }
    let Some(end) = claim.reader().end() else {
        let message = format!("the journal in clip `{}` has no end", claim.path().display());
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
            "in each wake that could show one, it had looked at samples from before the clip";
        failure.causes = vec![format!("{what} ({uncovered} of {wakes} wakes)")];
        return Err(failure.with_help(
            "make `preroll` longer than the lambda looks back; this clip can be verified against its drive: \
             gleaner replay DIR DRIVE --verify JOURNAL",
        ));
    }
    Ok(Proved { engine, wakes, triggers, uncovered, uncovered_triggers })
}

const CHANGED: &str = "the clip, or its journal, was changed since it was made";

/// A clip cannot prove a decision over a topic that it does not hold.
fn holds_all_inputs(clip: &Replay, header: &Header) -> Result<(), Failure> {
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
    let help = "add the topic to [record] for further clips; this one can be verified against its drive only: \
                gleaner replay DIR DRIVE --verify JOURNAL";
    Err(Failure::new(Exit::Usage, message).with_help(help))
}

/// Refuses a clip whose messages contradict its records.
fn holds_what_it_states(path: &Path, stated: &Stated) -> Result<(), Failure> {
    match stated.contradicted(path) {
        Ok(None) => Ok(()),
        Ok(Some(error)) => Err(untrue(path, &error)),
        Err(RecordError::Unreadable { source, .. }) => Err(unreadable_clip(*source)),
        Err(error) => Err(Failure { exit: Exit::Usage, ..error.into() }),
    }
}

/// Losses that the clip states, in words; none if there are none.
fn losses(stated: &Stated) -> Option<String> {
    let count = |count: Option<u64>| count.map_or("unknown".to_owned(), |count| count.to_string());
    let lost = stated.clip().topics.iter().flat_map(|topic| {
        let causes = [(topic.overwritten, "pushed out"), (topic.too_big, "too big")];
        let lost = causes.into_iter().filter(|(lost, _)| *lost != Some(0));
        lost.map(|(lost, why)| format!("{}: {} {why}", excerpt(&topic.topic), count(lost)))
    });
    let lost = lost.collect::<Vec<_>>();
    (!lost.is_empty()).then(|| lost.join(", "))
}

/// A lambda that runs again from the begin of a clip.
struct Proof<'a> {
    header: &'a Header,
    remake: Remake,
    clip: Paced,
    start_ns: i64,
    inputs: Vec<Arc<Topic>>,
    wakes: u64,
    /// Wakes in which the lambda had looked at samples from before the clip, and their triggers.
    uncovered: u64,
    uncovered_triggers: u64,
    /// Losses that the clip states.
    losses: Option<String>,
    /// The triggers of the journal.
    triggers: Triggers,
}

impl Proof<'_> {
    fn wake(&mut self, entry: &Entry) -> Result<(), Failure> {
        let before: Vec<_> = self.inputs.iter().map(|topic| offered(topic)).collect();
        if self.wakes == 0 {
            self.join(entry)?
        } else {
            self.deliver(entry.seen.iter().map(|seen| seen.new))?
        }
        let wake = self.cause(entry)?;
        let mut now = self.remake.wake(wake).clone();
        for ((topic, before), (now, journal)) in
            self.inputs.iter().zip(before).zip(now.seen.iter_mut().zip(&entry.seen))
        {
            // Of a clip's first wake, some of the samples before it may lie before the clip.
            if self.wakes == 0 && offered(topic) - before < journal.new {
                (now.new, now.digest) = (journal.new, journal.digest);
                now.newest = now.newest.or(journal.newest);
            }
        }
        let is_covered = self.covers(entry);
        if !is_covered {
            let Entry { triggers, fault, log, .. } = entry.clone();
            now = Entry { triggers, fault, log, ..now };
        }
        if !is_covered || self.header.wakes_before > 0 {
            // What the lambda keeps in its own variables since before the clip may cost it another
            // step, or another look.
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

    /// Delivers what the clip holds up to the samples that were newest in its first wake. What came
    /// since the wake before is summed up by itself.
    fn join(&mut self, entry: &Entry) -> Result<(), Failure> {
        let until_ns = entry.at_ns.saturating_add(SLACK_NS);
        let (mut earlier, mut new) = (Vec::new(), Vec::new());
        for (lane, seen) in entry.seen.iter().enumerate() {
            let is_newest =
                |meta: &SampleMeta| seen.newest.is_some_and(|newest| is_sample(meta, newest));
            let ahead = match seen.newest {
                Some(_) => {
                    self.clip.ahead(lane, until_ns, is_newest).map_err(unreadable)?.unwrap_or(0)
                }
                None => 0,
            };
            earlier.push(ahead.saturating_sub(seen.new));
            new.push(ahead.min(seen.new));
        }
        self.deliver(earlier.into_iter())?;
        self.remake.scribe.skip();
        self.deliver(new.into_iter())
    }

    fn deliver(&mut self, owed: impl Iterator<Item = u64>) -> Result<(), Failure> {
        self.clip.deliver(owed).map_err(unreadable)
    }

    fn cause(&self, entry: &Entry) -> Result<Wake, Failure> {
        let (writer, seq) = match (entry.cause, self.header.event_input) {
            (Woken::Tick { missed }, None) => {
                return Ok(Wake::Tick(Tick { at_ns: entry.at_ns, missed }));
            }
            (Woken::Tick { .. }, Some(_)) => {
                let (journal, now) = ("a tick".to_owned(), "samples, by its manifest".to_owned());
                let what = "what woke the lambda".to_owned();
                return Err(self.differs(entry, &Difference { what, journal, now }));
            }
            (Woken::Sample { writer, seq }, _) => (writer, seq),
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
                now: "it is not there".to_owned(),
            };
            self.differs(entry, &difference)
        })
    }

    /// Whether everything that the lambda looked at in this wake is there. It cannot look further
    /// back than its ring.
    fn covers(&self, entry: &Entry) -> bool {
        let mut inputs = self.inputs.iter().zip(&entry.seen);
        inputs.all(|(topic, seen)| {
            seen.reach.min(topic.reader().depth() as u64) <= topic.reader().head()
        })
    }

    fn differs(&self, entry: &Entry, difference: &Difference) -> Failure {
        match &self.losses {
            None => different(format!("{} differs", self.wake_in_words(entry)), difference)
                .with_help(CHANGED),
            Some(losses) => {
                let message =
                    format!("the clip alone does not settle {}", self.wake_in_words(entry));
                let failure = Failure { exit: Exit::Usage, ..different(message, difference) };
                failure.with_help(format!(
                    "the clip itself says that messages are missing in it ({losses}): raise `preroll_size`; \
                     gleaner replay DIR DRIVE --verify JOURNAL settles it"
                ))
            }
        }
    }

    /// The lambda saw the same and decided otherwise: that may be due to what it remembers from
    /// before the clip.
    fn unsettled(&self, entry: &Entry, difference: &Difference) -> Failure {
        let message = format!("the clip alone does not settle {}", self.wake_in_words(entry));
        let failure = Failure { exit: Exit::Usage, ..different(message, difference) };
        failure.with_help(format!(
            "the lambda had run {} times before the clip begins; what it kept in its own variables since then is not in the clip: \
             gleaner replay DIR DRIVE --verify JOURNAL settles it",
            self.header.wakes_before
        ))
    }

    fn wake_in_words(&self, entry: &Entry) -> String {
        let number = self.header.wakes_before.saturating_add(self.wakes).saturating_add(1);
        let at = seconds(entry.at_ns, self.start_ns);
        format!("wake {number} of lambda `{}`, at {at:.6} s of the clip,", self.header.lambda)
    }
}

/// Whether `meta` is of the sample of this writer and number. A clip keeps the lower 32 bits of a
/// number.
fn is_sample(meta: &SampleMeta, (writer, seq): ([u8; 16], u64)) -> bool {
    meta.writer.0 == writer && meta.seq as u32 == seq as u32
}

fn unreadable(error: PaceError) -> Failure {
    match error {
        PaceError::Drive(error) => unreadable_clip(error),
        PaceError::TooFarAhead => Failure::caused_by(
            Exit::Differs,
            "this clip does not have its samples in the order of the journal",
            &error,
        ),
    }
}
