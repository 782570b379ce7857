//! The recorder: samples and wakes go in, clips come out.

mod draft;
mod finished;
mod limits;
mod part;
mod picture;
mod stem;
mod stock;
#[cfg(test)]
mod tests;
mod waiting;

use std::path::PathBuf;
use std::time::Duration;

use gleaner_protocol::journal::{Encoder, Entry};
use gleaner_protocol::manifest::Store;
use gleaner_protocol::{Clip, Moment};
use gleaner_transport::SampleMeta;

use crate::RecordError;
use crate::file::{Folder, Topic};
use crate::preroll::{Held, Losses, Preroll};
use crate::window::{Group, Heard, Rules, Step, Window, Windows, nanoseconds};
use draft::{Close, Draft};
use finished::Finished;
use limits::Limits;
use stock::{Crew, Desk, Lane, Stock};
use waiting::Waiting;

pub use stock::Member;

/// Most topics of one recorder.
const TOPICS_MAX: usize = 256;

/// How a recorder works.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Where the preroll waits.
    pub store: Store,
    /// Most bytes of the preroll, with 64 bytes or a little more for each sample.
    pub preroll_bytes: u64,
    /// The longest clip; what is longer goes on in a next one.
    pub max_length: Duration,
    /// The folder that clips go to. A preroll on disk is in `preroll` there.
    pub folder: PathBuf,
    /// What stamps are, for example "log time of the drive".
    pub clock: String,
    /// Whether memory for the preroll is taken from the system at once.
    pub prefault: bool,
}

/// A topic of a recorder.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TopicId(usize);

/// A lambda of a recorder.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LambdaId(usize);

/// What a recorder has done so far.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Clips that are finished.
    pub clips: u64,
    /// Windows that triggers opened.
    pub windows: u64,
    /// Triggers that opened none, because they came within the cooldown of another.
    pub in_cooldown: u64,
    /// Starts while one was open, and stops while none was.
    pub ignored: u64,
    /// Samples that left the preroll for want of bytes before they were too old for any window.
    pub pushed_out: u64,
    /// Samples that are larger than the preroll. While a clip is open, they are in it nevertheless, unless they are larger
    /// than any message of a clip, which is somewhat below 1 GiB.
    pub too_big: u64,
    /// Samples and wakes with a stamp before 1970, and samples of missing topics: they are not recorded.
    pub refused: u64,
    /// Samples older than one that came before them. They are recorded where windows cover them.
    pub out_of_order: u64,
    /// Bytes that the preroll holds.
    pub preroll_bytes: u64,
    /// The most that it held so far.
    pub preroll_highest: u64,
    /// The most that it may hold.
    pub preroll_bound: u64,
}

/// Cuts clips out of what passes by. Synchronous; time is what stamps and [`Recorder::advance`] say, and never goes back.
///
/// After an error a recorder is of no use: drop it. What it has written is recovered by the next [`Folder::open`].
pub struct Recorder {
    windows: Windows,
    stock: Stock,
    draft: Option<Draft>,
    /// Groups of windows so far; each has its number.
    groups: u64,
    now: Option<i64>,
    max_length_ns: i64,
    finished: Finished,
    counts: Counts,
    /// Where a wake is encoded.
    encoded: Vec<u8>,
}

impl Recorder {
    /// A recorder without topics and lambdas.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] if the preroll is on disk and has no place there.
    pub fn new(folder: Folder, settings: Settings) -> Result<Recorder, RecordError> {
        let Settings { store, preroll_bytes, max_length, folder: out, clock, prefault } = settings;
        let preroll = Preroll::open(store, preroll_bytes, out.join("preroll"), prefault)?;
        let max_length_ns = nanoseconds(max_length).max(1);
        Ok(Recorder {
            windows: Windows::new(max_length_ns),
            stock: Stock {
                preroll,
                losses: Vec::new(),
                wake_losses: Vec::new(),
                waiting: Waiting::default(),
                desk: Desk { folder, clock, limits: Limits::default(), lanes: Vec::new(), crews: Vec::new() },
                began_at: 0,
            },
            draft: None,
            groups: 0,
            now: None,
            max_length_ns,
            finished: Finished::default(),
            counts: Counts { preroll_bound: preroll_bytes, ..Counts::default() },
            encoded: Vec::new(),
        })
    }

    /// Adds a topic; one of the same name that is there already stays as it is.
    ///
    /// # Errors
    ///
    /// [`RecordError::TooManyTopics`] beyond 256; [`RecordError::LongTopic`] if a clip has no room for what it says of itself.
    pub fn add_topic(&mut self, topic: Topic) -> Result<TopicId, RecordError> {
        self.add_lane(topic, false)
    }

    /// Adds a topic that is wanted but not there: clips list it with no messages and no type.
    ///
    /// # Errors
    ///
    /// As [`Recorder::add_topic`].
    pub fn add_missing_topic(&mut self, name: &str) -> Result<TopicId, RecordError> {
        let topic = Topic { name: name.to_owned(), type_name: String::new(), definitions: None, offered_qos: None };
        self.add_lane(topic, true)
    }

    fn add_lane(&mut self, topic: Topic, is_missing: bool) -> Result<TopicId, RecordError> {
        let lanes = &mut self.stock.desk.lanes;
        if let Some(found) = lanes.iter().position(|lane| lane.topic.name == topic.name) {
            return Ok(TopicId(found));
        }
        if lanes.len() == TOPICS_MAX {
            return Err(RecordError::TooManyTopics { most: TOPICS_MAX });
        }
        topic.check()?;
        lanes.push(Lane { topic, is_missing, lambdas: Vec::new() });
        self.stock.losses.push(Losses::default());
        Ok(TopicId(lanes.len() - 1))
    }

    /// Adds a lambda that records, before its first wake.
    pub fn add_lambda(&mut self, member: Member) -> LambdaId {
        let lambda = self.windows.add(Rules {
            preroll_ns: nanoseconds(member.rules.preroll),
            postroll_ns: nanoseconds(member.rules.postroll),
            cooldown_ns: nanoseconds(member.rules.cooldown),
        });
        for topic in &member.topics {
            let lambdas = &mut self.stock.desk.lanes[topic.0].lambdas;
            if !lambdas.contains(&lambda) {
                lambdas.push(lambda);
            }
        }
        let encoder = Encoder::new(member.header.inputs.len());
        self.stock.desk.crews.push(Crew { member, encoder, wakes: 0 });
        self.stock.wake_losses.push(Losses::default());
        LambdaId(lambda)
    }

    /// A sample came.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn sample(&mut self, topic: TopicId, meta: &SampleMeta, cdr: &[u8]) -> Result<(), RecordError> {
        if meta.at_ns < 0 || self.stock.desk.lanes[topic.0].is_missing {
            self.counts.refused += 1;
            return Ok(());
        }
        self.counts.out_of_order += u64::from(self.now.is_some_and(|now| meta.at_ns < now));
        self.pass(meta.at_ns)?;
        // MCAP has no room for times before 1970.
        let meta = SampleMeta { publish_ns: meta.publish_ns.max(0), ..*meta };
        let mut in_group = 0;
        if let (Some(draft), Some(group)) = (&mut self.draft, self.windows.open())
            && self.stock.desk.covers(group, topic.0, meta.at_ns)
        {
            if cdr.len() <= self.stock.desk.limits.message_bytes {
                draft.message(&mut self.stock.desk, group, topic.0, &meta, cdr)?;
            } else {
                draft.refuse(topic.0);
            }
            in_group = draft.group;
        }
        let Counts { pushed_out, too_big, .. } = &mut self.counts;
        self.stock.keep(Held::sample(topic.0, &meta, in_group), cdr, pushed_out, too_big)
    }

    /// A lambda was woken: keeps the wake for its journal, and does what its triggers ask for.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn wake(&mut self, lambda: LambdaId, entry: &Entry) -> Result<(), RecordError> {
        let crew = &mut self.stock.desk.crews[lambda.0];
        let number = crew.wakes;
        crew.wakes += 1;
        if entry.at_ns < 0 {
            self.counts.refused += 1;
            return Ok(());
        }
        self.encoded.clear();
        crew.encoder.reset();
        crew.encoder.encode(entry, &mut self.encoded);
        self.pass(entry.at_ns)?;
        let mut in_group = 0;
        if let (Some(draft), Some(group)) = (&mut self.draft, self.windows.open())
            && (group.begin..=group.to).contains(&entry.at_ns)
        {
            draft.wake(lambda.0, number, &self.encoded);
            in_group = draft.group;
        }
        let Counts { pushed_out, too_big, .. } = &mut self.counts;
        self.stock.keep(Held::wake(lambda.0, number, entry.at_ns, in_group), &self.encoded, pushed_out, too_big)?;
        if entry.triggers.is_empty() {
            return Ok(());
        }
        let most = self.stock.desk.limits.waiting;
        for trigger in &entry.triggers {
            match self.windows.trigger(lambda.0, trigger.kind, &trigger.label, entry.at_ns) {
                Heard::Opened => self.counts.windows += 1,
                Heard::InCooldown => self.counts.in_cooldown += 1,
                Heard::Ignored => self.counts.ignored += 1,
                Heard::Stopped => {}
            }
            let name = &self.stock.desk.crews[lambda.0].member.header.lambda;
            self.stock.waiting.push(lambda.0, Moment::of(name, trigger, entry.at_ns), &self.windows, most);
        }
        self.run()?;
        if let (Some(draft), Some(group)) = (&mut self.draft, self.windows.open()) {
            self.stock.gather(draft, group, self.windows.limit());
        }
        Ok(())
    }

    /// Time passes without samples.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn advance(&mut self, now_ns: i64) -> Result<(), RecordError> {
        self.pass(now_ns.max(0))
    }

    /// The drive ends: completes what is open. A clip whose window had not ended says so.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn finish(&mut self, end_ns: i64) -> Result<(), RecordError> {
        self.pass(end_ns.max(0))?;
        let end = self.now.unwrap_or(end_ns);
        while let Some(group) = self.windows.close() {
            self.complete(&group, Close::EndOfDrive(end))?;
            self.run()?;
        }
        Ok(())
    }

    /// The newest of the clips that are finished, in the order in which they were; `clips.jsonl` has all.
    pub fn clips(&self) -> &[Clip] {
        self.finished.newest()
    }

    /// What was done so far.
    pub fn counts(&self) -> Counts {
        let preroll = &self.stock.preroll;
        let (preroll_bytes, preroll_highest) = (preroll.bytes_held(), preroll.bytes_highest());
        Counts { clips: self.finished.count, preroll_bytes, preroll_highest, ..self.counts }
    }

    /// Lets time pass. What is due is done before anything is given up for its age: it may need it.
    fn pass(&mut self, now: i64) -> Result<(), RecordError> {
        if self.now.is_none() {
            self.stock.began_at = now;
        }
        self.now = self.now.max(Some(now));
        self.windows.pass(now);
        self.run()?;
        self.stock.trim(self.windows.horizon())
    }

    /// Does all that is to be done.
    fn run(&mut self) -> Result<(), RecordError> {
        while let Some(step) = self.windows.step() {
            match step {
                Step::Begin(windows) => self.begin(&windows)?,
                Step::Join { windows, fresh_from: Some(from) } => self.settle(&windows, from)?,
                // It covers nothing new so far, and its trigger is gathered by whoever brought it.
                Step::Join { .. } => {}
                Step::Roll { boundary, before } => self.roll(boundary, &before)?,
                Step::Finish(group) => self.complete(&group, Close::Complete)?,
                Step::Stray(windows, group) => self.stray(&windows, *group)?,
            }
        }
        Ok(())
    }

    fn begin(&mut self, windows: &[Window]) -> Result<(), RecordError> {
        if let Some(group) = self.windows.open() {
            self.groups += 1;
            let limits = self.stock.desk.limits;
            self.draft = Some(Draft::new(self.groups, self.stock.opening(group), group, limits));
        }
        self.settle(windows, i64::MIN)
    }

    fn settle(&mut self, windows: &[Window], fresh_from: i64) -> Result<(), RecordError> {
        match (&mut self.draft, self.windows.open()) {
            (Some(draft), Some(group)) => self.stock.settle(draft, group, windows, self.windows.limit(), fresh_from),
            _ => Ok(()),
        }
    }

    /// Goes on in a next clip.
    fn roll(&mut self, boundary: i64, before: &Group) -> Result<(), RecordError> {
        let (Some(draft), Some(group)) = (&mut self.draft, self.windows.open()) else { return Ok(()) };
        if !draft.is_empty() {
            let next = draft.next(group);
            let full = std::mem::replace(draft, next);
            self.finished.add(self.stock.finish(full, before, Close::Full(boundary))?);
        }
        // Where nothing came for longer than a clip may be, no clips are made of it.
        let until = self.stock.earliest(draft, group).or(self.now).unwrap_or(boundary);
        if until > self.windows.limit() {
            self.windows.slide(until);
        }
        self.settle(&[], i64::MIN)
    }

    fn complete(&mut self, group: &Group, close: Close) -> Result<(), RecordError> {
        if let Some(draft) = self.draft.take() {
            // The clip before promised that more would come; where nothing did, there is no clip of nothing.
            if draft.continues && draft.is_empty() && draft.triggers == 0 {
                return Ok(());
            }
            self.finished.add(self.stock.finish(draft, group, close)?);
        }
        Ok(())
    }

    /// Makes a clip of windows that lie before the one that is open. All of it is in the past.
    fn stray(&mut self, windows: &[Window], mut group: Group) -> Result<(), RecordError> {
        self.groups += 1;
        let mut draft = Draft::new(self.groups, self.stock.opening(&group), &group, self.stock.desk.limits);
        self.stock.settle(&mut draft, &group, windows, group.from.saturating_add(self.max_length_ns), i64::MIN)?;
        loop {
            let boundary = group.from.saturating_add(self.max_length_ns);
            if group.to <= boundary {
                self.finished.add(self.stock.finish(draft, &group, Close::Complete)?);
                return Ok(());
            }
            let before = group.clone();
            group.roll(boundary);
            if !draft.is_empty() {
                let next = draft.next(&group);
                let full = std::mem::replace(&mut draft, next);
                self.finished.add(self.stock.finish(full, &before, Close::Full(boundary))?);
            }
            self.stock.settle(&mut draft, &group, &[], group.from.saturating_add(self.max_length_ns), i64::MIN)?;
        }
    }
}
