//! Makes every decision of a journal again, from the drive or from a clip, and ends at the first that differs.
//!
//! The journal leads: before a wake, as many samples of each input are delivered as it says, then it is looked whether they
//! are the same ones, then the lambda runs, then both decisions are compared bit for bit.

use std::sync::Arc;
use std::time::Instant;

use gleaner_protocol::journal::{Difference, DriveDigest, End, Entry, Header, Woken};
use gleaner_protocol::manifest::Manifest;
use gleaner_protocol::{Exit, Failure, Verified};
use gleaner_transport::replay::Replay;
use gleaner_transport::{SampleMeta, Transport};

use super::claim::{Claim, different};
use super::digests::Digests;
use super::paced::{PaceError, Paced};
use super::stage::{DriveError, Stage};
use super::{Load, Options};
use crate::api::data::{Tick, Topic, Wake};
use crate::api::trace::offered;
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
    let (header, is_part) = (claim.header().clone(), claim.is_part);
    let digests = Digests::start(if is_part { Vec::new() } else { options.drives.clone() });
    let drive = Replay::open(&options.drives).map_err(|error| Failure::from(DriveError(error)))?;
    if is_part {
        holds_all_inputs(&drive, &header)?;
    }
    let Stage { drive, inputs, session, mut guest } = Stage::set(Paced::new(drive), options, manifest, load)?;
    let engine = guest.engine();
    let initialised = guest.init();
    let mut remake = Remake {
        header: &header,
        is_part,
        start_ns: drive.start_ns(),
        drive,
        scribe: Scribe::new(&inputs),
        judge: Judge::new(session.clone(), guest),
        session,
        inputs,
        wakes: 0,
        triggers: 0,
        uncovered: 0,
        uncovered_triggers: 0,
    };
    if let Err(fault) = initialised {
        let mut failure = Failure::new(Exit::LambdaFaulted, format!("cannot start lambda `{name}`"));
        failure.causes = vec![fault.message];
        return Err(failure);
    }
    // What `init` says is no part of a wake.
    remake.session.take_log();
    remake.session.take_said();
    while let Some(entry) = claim.next()? {
        remake.wake(&entry)?;
    }
    let reader = claim.reader();
    if let Some(end) = reader.end().filter(|_| !is_part) {
        remake.end(end)?;
        same_drives(end, digests)?;
    }
    let Remake { wakes, triggers, uncovered, uncovered_triggers, .. } = remake;
    if is_part && (uncovered == wakes || triggers > 0 && uncovered_triggers == triggers) {
        let message = format!("the clip alone proves no trigger of lambda `{name}`");
        let mut failure = Failure::new(Exit::Usage, message);
        let what = "in each wake that could show one, it had looked at samples from before the clip";
        failure.causes = vec![format!("{what} ({uncovered} of {wakes} wakes)")];
        return Err(failure.with_help(
            "make `preroll` longer than the lambda looks back; this clip can be verified against its drive: \
             gleaner replay DIR DRIVE --verify JOURNAL",
        ));
    }
    let noted = |what: &str, journal: &str, now: &str| {
        (journal != now).then(|| format!("{what}: {journal} in the journal, {now} now"))
    };
    Ok(Verified {
        lambda: name.to_owned(),
        wakes,
        triggers,
        uncovered,
        uncovered_triggers,
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
fn holds_all_inputs(clip: &Replay, header: &Header) -> Result<(), Failure> {
    let topics = clip.topics();
    let missing = header.inputs.iter().find(|input| !topics.iter().any(|topic| topic.topic == input.wire_topic));
    let Some(input) = missing else { return Ok(()) };
    let message = format!("the clip holds no `{}`, which input `{}` of the lambda reads", input.wire_topic, input.name);
    let help = "add the topic to [record] for further clips; this one can be verified against its drive only: \
                gleaner replay DIR DRIVE --verify JOURNAL";
    Err(Failure::new(Exit::Usage, message).with_help(help))
}

/// A lambda that runs again.
struct Remake<'a> {
    header: &'a Header,
    is_part: bool,
    drive: Paced,
    start_ns: i64,
    inputs: Vec<Arc<Topic>>,
    session: crate::api::Session,
    scribe: Scribe,
    judge: Judge,
    wakes: u64,
    triggers: u64,
    /// Wakes in which the lambda had looked at samples from before the clip, and their triggers.
    uncovered: u64,
    uncovered_triggers: u64,
}

impl Remake<'_> {
    fn wake(&mut self, entry: &Entry) -> Result<(), Failure> {
        // Of a clip's first wake nobody knows how many of the samples before it are in the clip.
        let joins = self.is_part && self.wakes == 0;
        if joins {
            self.join(entry)?
        } else {
            self.feed(entry)?
        }
        let wake = self.cause(entry)?;
        self.scribe.begin(&wake);
        let decision = self.judge.judge(wake);
        self.session.take_log();
        let said = self.session.take_said();
        let mut now = self.scribe.end(&decision, said).clone();
        if joins {
            for (now, journal) in now.seen.iter_mut().zip(&entry.seen) {
                (now.new, now.digest) = (journal.new, journal.digest);
                now.newest = now.newest.or(journal.newest);
            }
        }
        let is_covered = self.covers(entry);
        if !is_covered {
            let (theirs, seen) = (entry.clone(), std::mem::take(&mut now.seen));
            now = Entry { seen, ..theirs };
        }
        if !is_covered || self.is_part && self.header.wakes_before > 0 {
            // What the lambda keeps in its own variables since before the clip may cost it another step, or another look.
            now.fuel = entry.fuel;
            for (now, journal) in now.seen.iter_mut().zip(&entry.seen) {
                now.reach = journal.reach;
            }
        }
        if let Some(difference) = entry.differs_from(&now, &self.header.inputs, !self.is_part) {
            return Err(self.differs(entry, &difference));
        }
        let triggers = entry.triggers.len() as u64;
        self.wakes += 1;
        self.triggers += triggers;
        self.uncovered += u64::from(!is_covered);
        self.uncovered_triggers += if is_covered { 0 } else { triggers };
        Ok(())
    }

    /// Delivers the samples that came since the wake before.
    fn feed(&mut self, entry: &Entry) -> Result<(), Failure> {
        let before: Vec<_> = self.inputs.iter().map(|topic| offered(topic)).collect();
        self.drive.deliver(entry.seen.iter().map(|seen| seen.new)).map_err(unreadable)?;
        for ((topic, before), seen) in self.inputs.iter().zip(before).zip(&entry.seen) {
            let came = offered(topic) - before;
            if came < seen.new {
                let difference = Difference {
                    what: format!("samples of input `{}` ({}) before this wake", topic.name(), topic.ros_topic()),
                    journal: seen.new.to_string(),
                    now: format!("{came}, then the drive ends"),
                };
                return Err(self.differs(entry, &difference));
            }
        }
        Ok(())
    }

    /// Delivers what a clip holds up to the samples that were newest in its first wake.
    fn join(&mut self, entry: &Entry) -> Result<(), Failure> {
        let until_ns = entry.at_ns.saturating_add(SLACK_NS);
        let mut owed = Vec::new();
        for (lane, seen) in entry.seen.iter().enumerate() {
            let is_newest = |meta: &SampleMeta| seen.newest.is_some_and(|newest| is_sample(meta, newest));
            let ahead = match seen.newest {
                Some(_) => self.drive.ahead(lane, until_ns, is_newest).map_err(unreadable)?,
                None => None,
            };
            owed.push(ahead.unwrap_or(0));
        }
        self.drive.deliver(owed.into_iter()).map_err(unreadable)
    }

    fn cause(&self, entry: &Entry) -> Result<Wake, Failure> {
        let (writer, seq) = match entry.cause {
            Woken::Tick { missed } => return Ok(Wake::Tick(Tick { at_ns: entry.at_ns, missed })),
            Woken::Sample { writer, seq } => (writer, seq),
        };
        let topic = self.header.event_input.and_then(|input| self.inputs.get(input));
        let found = topic.and_then(|topic| {
            let reader = topic.reader();
            let head = reader.head();
            let oldest = head.saturating_sub(reader.depth() as u64);
            let mut leases = (oldest..head).rev().filter_map(|position| reader.get(position));
            Some(Wake::Event(topic.sample(leases.find(|lease| is_sample(lease.meta(), (writer, seq)))?)))
        });
        found.ok_or_else(|| {
            let difference = Difference {
                what: "the sample that woke the lambda".to_owned(),
                journal: format!("number {seq}, at {:.6} s", self.seconds(entry)),
                now: "it is not there".to_owned(),
            };
            self.differs(entry, &difference)
        })
    }

    /// Whether everything that the lambda looked at in this wake is there.
    fn covers(&self, entry: &Entry) -> bool {
        self.inputs.iter().zip(&entry.seen).all(|(topic, seen)| seen.reach <= topic.reader().head())
    }

    /// The drive must end as the journal does.
    fn end(&mut self, end: &End) -> Result<(), Failure> {
        self.drive.deliver(std::iter::repeat(u64::MAX)).map_err(unreadable)?;
        let samples = self.inputs.iter().enumerate().map(|(input, topic)| {
            let journal = end.samples.get(input).copied().unwrap_or(0);
            (format!("samples of input `{}` in all", topic.name()), journal, offered(topic))
        });
        let mut counts = std::iter::once(("wakes".to_owned(), end.wakes, self.wakes)).chain(samples);
        match counts.find(|(_, journal, now)| journal != now) {
            None => Ok(()),
            Some((what, journal, now)) => {
                let difference = Difference { what, journal: journal.to_string(), now: now.to_string() };
                let name = &self.header.lambda;
                Err(different(format!("the drive of lambda `{name}` does not end as in the journal"), &difference))
            }
        }
    }

    fn differs(&self, entry: &Entry, difference: &Difference) -> Failure {
        let Header { wakes_before, lambda, .. } = self.header;
        let number = wakes_before.saturating_add(self.wakes).saturating_add(1);
        let message = format!("wake {number} of lambda `{lambda}`, at {:.6} s, differs", self.seconds(entry));
        let failure = different(message, difference);
        if self.is_part && *wakes_before > 0 {
            return failure.with_help(format!(
                "the lambda had run {wakes_before} times before this clip begins; what it kept in its own variables since then \
                 is not in the clip: gleaner replay DIR DRIVE --verify JOURNAL tells"
            ));
        }
        failure
    }

    fn seconds(&self, entry: &Entry) -> f64 {
        entry.at_ns.saturating_sub(self.start_ns) as f64 / 1e9
    }
}

/// Whether `meta` is of the sample of this writer and number. A clip keeps the lower 32 bits of a number.
fn is_sample(meta: &SampleMeta, (writer, seq): ([u8; 16], u64)) -> bool {
    meta.writer.0 == writer && meta.seq as u32 == seq as u32
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
