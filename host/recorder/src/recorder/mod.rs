//! The recorder: turns samples and wakes into clips.
//!
//! - `sources`: the topics and lambdas.
//! - `history`: the preroll, and what it has lost.
//! - `clips`: windows, open clips, finished clips.
//! - `writer`: the files of clips, inline or on a thread.
//! - `live`: the calls of a live recorder only.

mod clips;
mod history;
mod limits;
mod live;
mod settings;
mod sources;
#[cfg(test)]
pub(crate) mod tests;
mod writer;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use gleaner_base::nanoseconds;
use gleaner_journal::JournalEntry;
use gleaner_lambda::{Clip, Moment, TriggerKind};
use gleaner_messages::transport::{LatchedSample, SampleMeta};
use gleaner_protocol::RecordingCounts;

use crate::RecordError;
use crate::file::{RecordingFolder, TopicSchema};
use crate::preroll::{EntryMeta, Preroll};
use crate::window::{TriggerOutcome, WindowRules};
use clips::Clips;
use history::History;
use limits::RecorderLimits;
use sources::RecordedSources;
use writer::ClipDisk;

pub(crate) use live::counted;
pub use settings::{Commanded, LambdaId, RecorderCounts, Settings, TopicId, Work};
pub use sources::{LambdaSpec, TOPICS_MAX};

struct RecorderContext {
    sources: RecordedSources,
    history: History,
}

/// Cuts clips out of the stream of samples. Time is given by stamps and [`Recorder::advance`], and
/// never goes back.
///
/// A recorder of [`new`](Self::new) does everything within each call; the recording depends on
/// stamps only. A recorder of [`live`](Self::live) leaves long work to a thread, and to
/// [`work`](Self::work), which has to be called in between.
///
/// Calls that return [`RecordError`] fail if the disk of the preroll fails, or, in a replay, that
/// of the clips. Live, a clip that could not be written is in [`Recorder::take_failures`]. After an
/// error, drop the recorder. Its written data is recovered by the next [`RecordingFolder::open`].
pub struct Recorder {
    material: RecorderContext,
    clips: Clips,
    counts: RecorderCounts,
    encoded: Vec<u8>,
    settings: Settings,
    /// Number of clips that could not be signed.
    unsigned: Arc<AtomicU64>,
}

impl Recorder {
    /// A recorder without topics and lambdas, for a replay.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] if the preroll is on disk and there is no room.
    pub fn new(folder: RecordingFolder, settings: Settings) -> Result<Recorder, RecordError> {
        let unsigned = folder.unsigned();
        Recorder::with(ClipDisk::inline(folder), settings, unsigned, false)
    }

    fn with(
        disk: ClipDisk,
        settings: Settings,
        unsigned: Arc<AtomicU64>,
        is_live: bool,
    ) -> Result<Recorder, RecordError> {
        let Settings { store, preroll_bytes, prefault, .. } = settings;
        let preroll =
            Preroll::open(store, preroll_bytes, settings.folder.join("preroll"), prefault)?;
        let max_length_ns = nanoseconds(settings.max_length).max(1);
        Ok(Recorder {
            material: RecorderContext {
                sources: RecordedSources::new(settings.clock.clone(), is_live),
                history: History::new(preroll, RecorderLimits::default().message_bytes),
            },
            clips: Clips::new(disk, max_length_ns, is_live),
            counts: RecorderCounts { preroll_bound: preroll_bytes, ..RecorderCounts::default() },
            encoded: Vec::new(),
            settings,
            unsigned,
        })
    }

    /// Adds a topic; an existing one of the same name is unchanged.
    ///
    /// # Errors
    ///
    /// [`RecordError::TooManyTopics`] beyond [`TOPICS_MAX`]; [`RecordError::LongTopic`] and
    /// [`RecordError::LongNames`] if a clip has no room for its description, or for all names
    /// together.
    pub fn add_topic(&mut self, topic: TopicSchema) -> Result<TopicId, RecordError> {
        self.add_topic_state(topic, false)
    }

    /// Adds a topic that is requested but does not exist yet: clips list it without messages and
    /// type.
    ///
    /// # Errors
    ///
    /// As [`Recorder::add_topic`].
    pub fn add_missing_topic(&mut self, name: &str) -> Result<TopicId, RecordError> {
        let topic = TopicSchema { name: name.to_owned(), ..TopicSchema::default() };
        self.add_topic_state(topic, true)
    }

    fn add_topic_state(
        &mut self,
        topic: TopicSchema,
        is_missing: bool,
    ) -> Result<TopicId, RecordError> {
        let topic = self.material.sources.add_topic(topic, is_missing)?;
        self.material.history.grow(topic + 1, 0);
        Ok(TopicId(topic))
    }

    /// Adds a sentence on what all clips lack.
    pub fn note(&mut self, note: String) {
        self.material.sources.notes.push(note);
    }

    /// Adds a lambda that records, before its first wake.
    ///
    /// # Panics
    ///
    /// Beyond 1024 lambdas, which a replay never has; [`Recorder::try_add_lambda`] returns an error
    /// instead.
    pub fn add_lambda(&mut self, member: LambdaSpec) -> LambdaId {
        self.try_add_lambda(member).expect("few lambdas are added without asking")
    }

    /// As [`Recorder::add_lambda`].
    ///
    /// # Errors
    ///
    /// [`RecordError::TooManyLambdas`] beyond 1024.
    pub fn try_add_lambda(&mut self, member: LambdaSpec) -> Result<LambdaId, RecordError> {
        self.material.sources.check_room()?;
        let lambda = self.clips.windows.add(WindowRules {
            preroll_ns: nanoseconds(member.rules.preroll),
            postroll_ns: nanoseconds(member.rules.postroll),
            cooldown_ns: nanoseconds(member.rules.cooldown),
        });
        self.material.sources.add_lambda(lambda, member);
        self.material.history.grow(0, lambda + 1);
        Ok(LambdaId(lambda))
    }

    /// Takes a sample.
    pub fn sample(
        &mut self,
        topic: TopicId,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        let topic = topic.0;
        if meta.at_ns < 0 {
            self.counts.recording.before_1970 += 1;
            return Ok(());
        }
        if self.material.sources.is_missing(topic) {
            self.counts.recording.topic_unknown += 1;
            return Ok(());
        }
        let is_late = self.material.history.now().is_some_and(|now| meta.at_ns < now);
        self.counts.out_of_order += u64::from(is_late);
        if self.clips.progress.is_live {
            self.material.history.note_gap(topic, meta);
        }
        self.pass(meta.at_ns)?;
        self.material.sources.saw(topic);
        // MCAP has no room for times before 1970.
        // In a clip that is replayed, a latched sample is one like any other.
        let meta = SampleMeta { publish_ns: meta.publish_ns.max(0), is_latched: false, ..*meta };
        let in_group = self.clips.write(topic, &meta, cdr, &self.material)?;
        if let Some(rule) = self.material.sources.latch_rule(topic) {
            let horizon = self.clips.windows.horizon();
            self.material.history.latch(topic, LatchedSample::new(&meta, cdr), rule, horizon);
        }
        self.material.history.keep(EntryMeta::sample(topic, &meta, in_group), cdr)
    }

    /// Takes a wake of a lambda for its journal, and applies its triggers.
    ///
    /// Live, its stamp does not advance time: earlier samples may still be in transit, and the wake
    /// may be up to 200 ms late.
    pub fn wake(&mut self, lambda: LambdaId, entry: &JournalEntry) -> Result<(), RecordError> {
        let mut encoded = std::mem::take(&mut self.encoded);
        self.material.sources.encode(lambda.0, entry, &mut encoded);
        let taken = self.encoded_wake(lambda, entry, &encoded);
        self.encoded = encoded;
        taken
    }

    /// As [`Recorder::wake`], for a wake that its lambda has encoded without reference to another
    /// one: preroll and clip keep these bytes. They decode to `entry`.
    pub fn encoded_wake(
        &mut self,
        lambda: LambdaId,
        entry: &JournalEntry,
        encoded: &[u8],
    ) -> Result<(), RecordError> {
        let number = self.material.sources.count_wakes(lambda.0, 1);
        if entry.at_ns < 0 {
            self.counts.recording.before_1970 += 1;
            return Ok(());
        }
        if !self.clips.progress.is_live {
            self.pass(entry.at_ns)?;
        }
        let in_group = self.clips.wake(lambda.0, number, entry.at_ns, encoded);
        let held = EntryMeta::wake(lambda.0, number, entry.at_ns, in_group);
        self.material.history.keep(held, encoded)?;
        if entry.triggers.is_empty() {
            return Ok(());
        }
        if self.clips.is_held() {
            let starts = entry.triggers.iter().filter(|trigger| trigger.kind != TriggerKind::Stop);
            self.clips.count_suppressed(starts.count() as u64);
            return Ok(());
        }
        for trigger in &entry.triggers {
            let (kind, label) = (trigger.kind, &trigger.label);
            match self.clips.windows.trigger(lambda.0, kind, label, entry.at_ns) {
                TriggerOutcome::Opened => self.counts.recording.windows += 1,
                TriggerOutcome::InCooldown => self.counts.recording.in_cooldown += 1,
                TriggerOutcome::Ignored => self.counts.recording.ignored += 1,
                TriggerOutcome::TooManyStarted => self.counts.recording.too_many_started += 1,
                TriggerOutcome::TooManyWaiting => self.counts.recording.too_many_waiting += 1,
                TriggerOutcome::Stopped => {}
            }
            let moment = Moment::of(self.material.sources.name(lambda.0), trigger, entry.at_ns);
            self.clips.await_clip(lambda.0, moment);
        }
        self.clips.act(&mut self.material)
    }

    /// Advances time without samples.
    pub fn advance(&mut self, now_ns: i64) -> Result<(), RecordError> {
        self.pass(now_ns.max(0))
    }

    fn pass(&mut self, now: i64) -> Result<(), RecordError> {
        self.material.history.pass(now);
        self.clips.pass(now, &mut self.material)
    }

    /// Ends the recording: completes open clips. A clip whose window had not ended notes that.
    /// Live, this waits for the disk.
    pub fn finish(&mut self, end_ns: i64) -> Result<(), RecordError> {
        self.clips.progress.disk.end_recovery();
        self.clips.windows.set_grace(0);
        self.pass(end_ns.max(0))?;
        let end = self.material.history.now().unwrap_or(end_ns);
        self.clips.finish(end, &mut self.material)
    }

    /// The newest finished clips, in order; `clips.jsonl` has all.
    pub fn clips(&self) -> &[Clip] {
        self.clips.progress.finished.newest()
    }

    pub fn counts(&self) -> RecorderCounts {
        let preroll = &self.material.history.preroll;
        let (evicted_early, too_big) = self.material.history.counts();
        let disk_suppressed = self.clips.disk_suppressed();
        let unsigned = self.unsigned.load(Ordering::Relaxed);
        let mut recording = RecordingCounts {
            evicted_early,
            too_big,
            disk_suppressed,
            unsigned,
            ..self.counts.recording
        };
        recording.add(self.clips.progress.finished.counts());
        RecorderCounts {
            recording,
            preroll_bytes: preroll.bytes_held(),
            preroll_highest: preroll.bytes_highest(),
            in_flight: self.clips.progress.in_flight(),
            ..self.counts
        }
    }

    #[cfg(test)]
    fn set_limits(&mut self, limits: RecorderLimits) {
        self.material.history.set_message_bytes(limits.message_bytes);
        self.clips.progress.set_limits(limits);
    }
}
