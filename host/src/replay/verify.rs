//! Makes every decision of a journal again, from the drive or from a clip, and ends at the first that differs.
//!
//! The journal leads: before a wake, as many samples of each input are delivered as it says, then it is looked whether they
//! are the same ones, then the lambda runs, then both decisions are compared bit for bit.

use std::sync::Arc;
use std::time::Instant;

use gleaner_protocol::journal::{Difference, DriveDigest, End, Entry, Woken};
use gleaner_protocol::manifest::Manifest;
use gleaner_protocol::{Exit, Failure, Verified};
use gleaner_transport::replay::Replay;
use gleaner_transport::{Transport, Verdict};

use super::claim::{Claim, different};
use super::digests::Digests;
use super::paced::{PaceError, Paced};
use super::stage::{DriveError, Stage};
use super::{Load, Options};
use crate::api::data::{Tick, Topic, Wake};
use crate::journal::Scribe;
use crate::judge::Judge;

/// A sample may be newer than the one that caused a wake by so much, where each topic has a thread of its own.
const SLACK_NS: i64 = 1_000_000_000;

pub(super) fn run(
    options: &Options,
    manifest: &Manifest,
    claim: &mut Claim,
    load: Load<'_>,
) -> Result<Verified, Failure> {
    let started = Instant::now();
    let name = manifest.lambda.name.as_str();
    let digests = Digests::start(if claim.is_part { Vec::new() } else { options.drives.clone() });
    let drive = Replay::open(&options.drives).map_err(|error| Failure::from(DriveError(error)))?;
    if claim.is_part {
        holds_all_inputs(&drive, claim)?;
    }
    let Stage { drive, inputs, session, mut guest } = Stage::set(Paced::new(drive), options, manifest, load)?;
    let engine = guest.engine();
    let initialised = guest.init();
    let mut remake = Remake {
        start_ns: drive.start_ns(),
        drive,
        scribe: Scribe::new(&inputs),
        judge: Judge::new(session.clone(), guest),
        session,
        inputs,
        wakes: 0,
        uncovered: 0,
    };
    if let Err(fault) = initialised {
        let mut failure = Failure::new(Exit::LambdaFaulted, format!("cannot start lambda `{name}`"));
        failure.causes = vec![fault.message];
        return Err(failure);
    }
    // What `init` says is no part of a wake.
    remake.session.take_log();
    while let Some(entry) = claim.next()? {
        remake.wake(&entry, claim)?;
    }
    let reader = claim.reader();
    if let Some(end) = reader.end().filter(|_| !claim.is_part) {
        remake.end(end, claim)?;
        same_drives(end, digests)?;
    }
    let header = claim.header();
    let noted = |what: &str, journal: &str, now: &str| {
        (journal != now).then(|| format!("{what}: {journal} in the journal, {now} now"))
    };
    Ok(Verified {
        lambda: name.to_owned(),
        wakes: remake.wakes,
        uncovered: remake.uncovered,
        cut_off: reader.cut_off(),
        wall_s: started.elapsed().as_secs_f64(),
        notes: [
            noted("runs on", &header.engine, &engine),
            noted("version of gleaner", &header.gleaner, env!("CARGO_PKG_VERSION")),
            noted("machine", &header.machine, std::env::consts::ARCH),
        ]
        .into_iter()
        .flatten()
        .collect(),
    })
}

/// A clip cannot prove a decision over a topic that it does not hold.
fn holds_all_inputs(clip: &Replay, claim: &Claim) -> Result<(), Failure> {
    let topics = clip.topics();
    let missing =
        claim.header().inputs.iter().find(|input| !topics.iter().any(|topic| topic.topic == input.wire_topic));
    let Some(input) = missing else { return Ok(()) };
    let message = format!("the clip holds no `{}`, which input `{}` of the lambda reads", input.wire_topic, input.name);
    let help = "add the topic to [record] for further clips; this one can be verified against its drive only: \
                gleaner replay DIR DRIVE --verify JOURNAL";
    Err(Failure::new(Exit::Usage, message).with_help(help))
}

/// A lambda that runs again.
struct Remake {
    drive: Paced,
    start_ns: i64,
    inputs: Vec<Arc<Topic>>,
    session: crate::api::Session,
    scribe: Scribe,
    judge: Judge,
    wakes: u64,
    /// Wakes in which the lambda had looked at samples from before the clip.
    uncovered: u64,
}

impl Remake {
    fn wake(&mut self, entry: &Entry, claim: &Claim) -> Result<(), Failure> {
        // Of a clip's first wake nobody knows how many of the samples before it are in the clip.
        let joins = claim.is_part && self.wakes == 0;
        for input in 0..self.inputs.len() {
            if joins { self.join(input, entry)? } else { self.feed(input, entry, claim)? }
        }
        let wake = self.cause(entry, claim)?;
        self.scribe.begin(&wake);
        let decision = self.judge.judge(wake);
        let log = self.session.take_log();
        let mut now = self.scribe.end(&decision, &log).clone();
        self.wakes += 1;
        if joins {
            for (now, journal) in now.seen.iter_mut().zip(&entry.seen) {
                (now.new, now.digest) = (journal.new, journal.digest);
                now.newest = now.newest.or(journal.newest);
            }
        }
        if claim.is_part && claim.header().wakes_before > 0 {
            // What the lambda keeps in its own variables since before the clip may cost it another step, or another look.
            now.fuel = entry.fuel;
            for (now, journal) in now.seen.iter_mut().zip(&entry.seen) {
                now.reach = journal.reach;
            }
        }
        if !self.covers(entry) {
            self.uncovered += 1;
            let (theirs, seen) = (entry.clone(), std::mem::take(&mut now.seen));
            now = Entry { seen, ..theirs };
        }
        match entry.differs_from(&now, &claim.header().inputs, !claim.is_part) {
            None => Ok(()),
            Some(difference) => Err(self.differs(entry, claim, &difference)),
        }
    }

    /// Delivers the samples that came since the wake before.
    fn feed(&mut self, input: usize, entry: &Entry, claim: &Claim) -> Result<(), Failure> {
        let topic = Arc::clone(&self.inputs[input]);
        let before = topic.reader().head();
        let wanted = before.saturating_add(entry.seen[input].new);
        while topic.reader().head() < wanted {
            if self.deliver(input)?.is_none() {
                let difference = Difference {
                    what: format!("samples of input `{}` ({}) before this wake", topic.name(), topic.ros_topic()),
                    journal: entry.seen[input].new.to_string(),
                    now: format!("{}, then the drive ends", topic.reader().head() - before),
                };
                return Err(self.differs(entry, claim, &difference));
            }
        }
        Ok(())
    }

    /// Delivers what a clip holds up to the sample that was newest in its first wake.
    fn join(&mut self, input: usize, entry: &Entry) -> Result<(), Failure> {
        let Some((writer, seq)) = entry.seen[input].newest else { return Ok(()) };
        let until_ns = entry.at_ns.saturating_add(SLACK_NS);
        // A clip keeps the lower 32 bits of a sequence number.
        let is_newest = |meta: &gleaner_transport::SampleMeta| meta.writer.0 == writer && meta.seq as u32 == seq as u32;
        let n = self.drive.ahead(input, until_ns, is_newest).map_err(unreadable)?;
        for _ in 0..n.unwrap_or(0) {
            self.deliver(input)?;
        }
        Ok(())
    }

    fn deliver(&mut self, input: usize) -> Result<Option<Verdict>, Failure> {
        self.drive.deliver(input).map_err(unreadable)
    }

    fn cause(&self, entry: &Entry, claim: &Claim) -> Result<Wake, Failure> {
        let (writer, seq) = match entry.cause {
            Woken::Tick { missed } => return Ok(Wake::Tick(Tick { at_ns: entry.at_ns, missed })),
            Woken::Sample { writer, seq } => (writer, seq),
        };
        let topic = claim.header().event_input.and_then(|input| self.inputs.get(input));
        let found = topic.and_then(|topic| {
            let reader = topic.reader();
            let head = reader.head();
            let oldest = head.saturating_sub(reader.depth() as u64);
            let mut leases = (oldest..head).rev().filter_map(|position| reader.get(position));
            let lease =
                leases.find(|lease| lease.meta().seq as u32 == seq as u32 && lease.meta().writer.0 == writer)?;
            Some(Wake::Event(topic.sample(lease)))
        });
        found.ok_or_else(|| {
            let difference = Difference {
                what: "the sample that woke the lambda".to_owned(),
                journal: format!("number {seq}, at {:.6} s", self.seconds(entry)),
                now: "it is not there".to_owned(),
            };
            self.differs(entry, claim, &difference)
        })
    }

    /// Whether everything that the lambda looked at in this wake is there.
    fn covers(&self, entry: &Entry) -> bool {
        self.inputs.iter().zip(&entry.seen).all(|(topic, seen)| seen.reach <= topic.reader().head())
    }

    /// The drive must end as the journal does.
    fn end(&mut self, end: &End, claim: &Claim) -> Result<(), Failure> {
        let mut counts = vec![("wakes".to_owned(), end.wakes, self.wakes)];
        for input in 0..self.inputs.len() {
            while self.deliver(input)?.is_some() {}
            let (topic, journal) = (&self.inputs[input], end.samples.get(input).copied().unwrap_or(0));
            counts.push((format!("samples of input `{}` in all", topic.name()), journal, topic.reader().head()));
        }
        match counts.into_iter().find(|(_, journal, now)| journal != now) {
            None => Ok(()),
            Some((what, journal, now)) => {
                let difference = Difference { what, journal: journal.to_string(), now: now.to_string() };
                let name = &claim.header().lambda;
                Err(different(format!("the drive of lambda `{name}` does not end as in the journal"), &difference))
            }
        }
    }

    fn differs(&self, entry: &Entry, claim: &Claim, difference: &Difference) -> Failure {
        let header = claim.header();
        let number = header.wakes_before.saturating_add(self.wakes.max(1));
        let message = format!("wake {number} of lambda `{}`, at {:.6} s, differs", header.lambda, self.seconds(entry));
        let failure = different(message, difference);
        if claim.is_part && header.wakes_before > 0 {
            return failure.with_help(format!(
                "the lambda had run {} times before this clip begins; what it kept in its own variables since then is not in \
                 the clip: gleaner replay DIR DRIVE --verify JOURNAL tells",
                header.wakes_before
            ));
        }
        failure
    }

    fn seconds(&self, entry: &Entry) -> f64 {
        entry.at_ns.saturating_sub(self.start_ns) as f64 / 1e9
    }
}

fn unreadable(error: PaceError) -> Failure {
    match error {
        PaceError::Drive(error) => Failure::from(DriveError(error)),
        PaceError::TooFarAhead => Failure::caused_by(
            Exit::Differs,
            "this drive does not have its samples in the order of the journal",
            &error,
        ),
    }
}

/// Every decision was the same, and still a byte that no lambda reads may have changed.
fn same_drives(end: &End, digests: Digests) -> Result<(), Failure> {
    let now = digests.take()?;
    let mut pairs = end.drives.iter().zip(&now);
    let changed =
        pairs.find(|(journal, now)| (journal.bytes, journal.crc32) != (now.bytes, now.crc32)).map(|(journal, now)| {
            let side = |drive: &DriveDigest| format!("{} bytes, CRC-32 {:08x}", drive.bytes, drive.crc32);
            Difference { what: format!("drive `{}`", now.name), journal: side(journal), now: side(now) }
        });
    let number = || {
        let (journal, now) = (end.drives.len(), now.len());
        let what = "number of drives".to_owned();
        (journal != now).then(|| Difference { what, journal: journal.to_string(), now: now.to_string() })
    };
    match changed.or_else(number) {
        None => Ok(()),
        Some(difference) => {
            Err(different("every decision is the same, but the drive is not the file that it was", &difference))
        }
    }
}
