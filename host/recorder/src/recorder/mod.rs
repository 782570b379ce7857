//! The recorder: turns samples and wakes into clips.

mod backfill;
mod clip_name;
mod clip_writer;
mod finished;
mod limits;
mod live;
mod open_clip;
mod settings;
mod state;
mod steps;
#[cfg(test)]
mod tests;
mod waiting;

use std::sync::Arc;

use gleaner_base::nanoseconds;
use gleaner_journal::{Encoder, JournalEntry};
use gleaner_lambda::{Clip, Moment, TriggerKind};
use gleaner_protocol::RecordingCounts;
use gleaner_transport::{Gaps, SampleMeta};

use crate::file::{RecordingFolder, TopicSchema};
use crate::preroll::{EntryMeta, Losses, Preroll, Walked};
use crate::window::{TriggerOutcome, WindowRules, Windows};
use crate::{LAMBDAS_MAX, RecordError};
use backfill::Backfill;
use clip_writer::ClipWriter;
use finished::Finished;
use limits::RecorderLimits;
use open_clip::OpenClip;
use state::{ClipContext, RecordedLambda, RecorderState, TopicState};
use steps::LateClip;
use waiting::WaitingTriggers;

#[cfg(feature = "program")]
pub(crate) use live::counted;
pub use settings::{Commanded, LambdaId, RecorderCounts, Settings, TopicId, Work};
pub use state::LambdaSpec;

/// Most topics of one recorder. A vehicle has some hundreds. For each, the stamps of some thousand
/// lost samples are kept: 100 KiB.
pub const TOPICS_MAX: usize = 1024;

/// Most bytes of the names of all topics of one recorder, and of their types: they are in a line of
/// the list of clips, up to seven times and with six bytes for one, and a line has at most 16 MiB.
const NAMES_MAX: usize = 256 << 10;

/// Cuts clips out of the stream of samples. Time is given by stamps and [`Recorder::advance`], and
/// never goes back.
///
/// A recorder of [`new`](Self::new) does everything within each call; the recording depends on
/// stamps only. A recorder of [`live`](Self::live) leaves long work to a thread, and to
/// [`work`](Self::work), which has to be called in between.
///
/// After an error, drop the recorder. Its written data is recovered by the next
/// [`RecordingFolder::open`].
pub struct Recorder {
    windows: Windows,
    state: RecorderState,
    open_clip: Option<OpenClip>,
    /// A clip of windows before those of `open_clip`.
    late_clip: Option<LateClip>,
    /// The backfill of `late_clip`, or else of `open_clip`. Nothing is decided while it runs.
    backfill: Option<Backfill>,
    /// The last entry before the messages that could not be written to `open_clip` when they came.
    behind: Option<Option<Walked>>,
    /// The reason why recording is suspended.
    held: Option<Arc<str>>,
    /// Number of groups of windows so far.
    groups: u64,
    now: Option<i64>,
    max_length_ns: i64,
    finished: Finished,
    counts: RecorderCounts,
    /// Buffer for an encoded wake.
    encoded: Vec<u8>,
    settings: Settings,
}

impl Recorder {
    /// A recorder without topics and lambdas, for a replay.
    ///
    /// # Errors
    ///
    /// [`RecordError::Preroll`] if the preroll is on disk and there is no room.
    pub fn new(folder: RecordingFolder, settings: Settings) -> Result<Recorder, RecordError> {
        Recorder::with(ClipWriter::inline(folder), settings, false)
    }

    fn with(
        writer: ClipWriter,
        settings: Settings,
        is_live: bool,
    ) -> Result<Recorder, RecordError> {
        let Settings { store, preroll_bytes, prefault, .. } = settings;
        let preroll =
            Preroll::open(store, preroll_bytes, settings.folder.join("preroll"), prefault)?;
        let max_length_ns = nanoseconds(settings.max_length).max(1);
        Ok(Recorder {
            windows: Windows::new(max_length_ns),
            state: RecorderState {
                preroll,
                losses: Vec::new(),
                wake_losses: Vec::new(),
                waiting: WaitingTriggers::default(),
                context: ClipContext {
                    writer,
                    clips: 0,
                    clock: settings.clock.clone(),
                    limits: RecorderLimits::default(),
                    is_live,
                    topics: Vec::new(),
                    lambdas: Vec::new(),
                },
                began_at: 0,
            },
            open_clip: None,
            late_clip: None,
            backfill: None,
            behind: None,
            held: None,
            groups: 0,
            now: None,
            max_length_ns,
            finished: Finished::default(),
            counts: RecorderCounts { preroll_bound: preroll_bytes, ..RecorderCounts::default() },
            encoded: Vec::new(),
            settings,
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
        let topic = TopicSchema {
            name: name.to_owned(),
            type_name: String::new(),
            definitions: None,
            offered_qos: None,
        };
        self.add_topic_state(topic, true)
    }

    fn add_topic_state(
        &mut self,
        topic: TopicSchema,
        is_missing: bool,
    ) -> Result<TopicId, RecordError> {
        let topics = &mut self.state.context.topics;
        if let Some(found) =
            topics.iter().position(|topic_state| topic_state.topic.name == topic.name)
        {
            return Ok(TopicId(found));
        }
        if topics.len() == TOPICS_MAX {
            return Err(RecordError::TooManyTopics { most: TOPICS_MAX });
        }
        topic.check()?;
        let names = |topic: &TopicSchema| topic.name.len() + topic.type_name.len();
        if topics.iter().map(|topic_state| names(&topic_state.topic)).sum::<usize>() + names(&topic)
            > NAMES_MAX
        {
            return Err(RecordError::LongNames { most: NAMES_MAX });
        }
        let (topic, lambdas, gaps) = (Arc::new(topic), Vec::new(), Gaps::default());
        topics.push(TopicState { topic, is_missing, found_at: None, lambdas, gaps });
        self.state.losses.push(Losses::default());
        Ok(TopicId(topics.len() - 1))
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
        if self.state.context.lambdas.len() == LAMBDAS_MAX {
            return Err(RecordError::TooManyLambdas { most: LAMBDAS_MAX });
        }
        let lambda = self.windows.add(WindowRules {
            preroll_ns: nanoseconds(member.rules.preroll),
            postroll_ns: nanoseconds(member.rules.postroll),
            cooldown_ns: nanoseconds(member.rules.cooldown),
        });
        for topic in &member.topics {
            let lambdas = &mut self.state.context.topics[topic.0].lambdas;
            if !lambdas.contains(&lambda) {
                lambdas.push(lambda);
            }
        }
        let LambdaSpec { header, digest, topics, .. } = member;
        let encoder = Encoder::new(header.inputs.len());
        self.state.context.lambdas.push(RecordedLambda {
            header: Arc::new(header),
            digest,
            topics,
            encoder,
            wakes: 0,
        });
        self.state.wake_losses.push(Losses::default());
        Ok(LambdaId(lambda))
    }

    /// Takes a sample.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn sample(
        &mut self,
        topic: TopicId,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        if meta.at_ns < 0 {
            self.counts.recording.before_1970 += 1;
            return Ok(());
        }
        if self.state.context.topics[topic.0].is_missing {
            self.counts.recording.topic_unknown += 1;
            return Ok(());
        }
        self.counts.out_of_order += u64::from(self.now.is_some_and(|now| meta.at_ns < now));
        if self.state.context.is_live {
            self.state.note_gap(topic.0, meta);
        }
        self.pass(meta.at_ns)?;
        // MCAP has no room for times before 1970.
        let meta = SampleMeta { publish_ns: meta.publish_ns.max(0), ..*meta };
        let in_group = self.write(topic.0, &meta, cdr)?;
        let RecordingCounts { evicted_early, too_big, .. } = &mut self.counts.recording;
        self.state.keep(EntryMeta::sample(topic.0, &meta, in_group), cdr, evicted_early, too_big)
    }

    /// Writes a sample to the open clip, if it belongs there. Returns the group whose clip then has
    /// it, or 0.
    fn write(&mut self, topic: usize, meta: &SampleMeta, cdr: &[u8]) -> Result<u64, RecordError> {
        let is_prompt = self.is_prompt(meta.at_ns);
        let (Some(open_clip), Some(group)) = (&mut self.open_clip, self.windows.open()) else {
            return Ok(0);
        };
        let RecorderState { preroll, context, .. } = &mut self.state;
        if !context.covers(group, topic, meta.at_ns) {
            return Ok(0);
        }
        if cdr.len() > context.limits.message_bytes {
            open_clip.refuse(topic);
        } else if is_prompt || !preroll.fits(cdr.len()) && context.writer.has_room() {
            open_clip.message(context, group, topic, meta, cdr)?;
        } else {
            // It is counted as too big if it cannot be kept; else a backfill writes it later.
            if self.backfill.is_none() || self.late_clip.is_some() {
                self.behind.get_or_insert_with(|| preroll.newest());
            }
            return Ok(0);
        }
        Ok(open_clip.group)
    }

    /// Takes a wake of a lambda for its journal, and applies its triggers.
    ///
    /// Live, its stamp does not advance time: earlier samples may still be in transit, and the wake
    /// may be up to 200 ms late.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn wake(&mut self, lambda: LambdaId, entry: &JournalEntry) -> Result<(), RecordError> {
        let recorded = &mut self.state.context.lambdas[lambda.0];
        let number = recorded.wakes;
        recorded.wakes += 1;
        if entry.at_ns < 0 {
            self.counts.recording.before_1970 += 1;
            return Ok(());
        }
        self.encoded.clear();
        recorded.encoder.reset();
        recorded.encoder.encode(entry, &mut self.encoded);
        if !self.state.context.is_live {
            self.pass(entry.at_ns)?;
        }
        let mut in_group = 0;
        if let (Some(open_clip), Some(group)) = (&mut self.open_clip, self.windows.open())
            && (group.begin..=group.to.min(self.windows.limit())).contains(&entry.at_ns)
        {
            open_clip.wake(lambda.0, number, &self.encoded);
            in_group = open_clip.group;
        }
        let RecordingCounts { evicted_early, too_big, .. } = &mut self.counts.recording;
        self.state.keep(
            EntryMeta::wake(lambda.0, number, entry.at_ns, in_group),
            &self.encoded,
            evicted_early,
            too_big,
        )?;
        if entry.triggers.is_empty() {
            return Ok(());
        }
        if self.held.is_some() {
            self.counts.recording.disk_suppressed +=
                entry.triggers.iter().filter(|trigger| trigger.kind != TriggerKind::Stop).count()
                    as u64;
            return Ok(());
        }
        for trigger in &entry.triggers {
            match self.windows.trigger(lambda.0, trigger.kind, &trigger.label, entry.at_ns) {
                TriggerOutcome::Opened => self.counts.recording.windows += 1,
                TriggerOutcome::InCooldown => self.counts.recording.in_cooldown += 1,
                TriggerOutcome::Ignored => self.counts.recording.ignored += 1,
                TriggerOutcome::TooManyStarted => self.counts.recording.too_many_started += 1,
                TriggerOutcome::TooManyWaiting => self.counts.recording.too_many_waiting += 1,
                TriggerOutcome::Stopped => {}
            }
            self.await_clip(lambda, Moment::of(self.name_of(lambda), trigger, entry.at_ns));
        }
        self.act()
    }

    fn name_of(&self, lambda: LambdaId) -> &str {
        &self.state.context.lambdas[lambda.0].header.lambda
    }

    /// Queues a moment for the clip that it belongs to.
    fn await_clip(&mut self, lambda: LambdaId, moment: Moment) {
        let most = self.state.context.limits.waiting;
        self.state.waiting.push(lambda.0, moment, &self.windows, most);
    }

    /// Applies the effects of triggers.
    fn act(&mut self) -> Result<(), RecordError> {
        self.run()?;
        if let (Some(open_clip), Some(group)) = (&mut self.open_clip, self.windows.open()) {
            self.state.gather(open_clip, group, self.windows.limit());
        }
        Ok(())
    }

    /// Advances time without samples.
    ///
    /// # Errors
    ///
    /// [`RecordError`] if the disk fails.
    pub fn advance(&mut self, now_ns: i64) -> Result<(), RecordError> {
        self.pass(now_ns.max(0))
    }

    /// The newest finished clips, in order; `clips.jsonl` has all.
    pub fn clips(&self) -> &[Clip] {
        self.finished.newest()
    }

    /// The counts so far.
    pub fn counts(&self) -> RecorderCounts {
        let preroll = &self.state.preroll;
        RecorderCounts {
            recording: RecordingCounts { clips: self.finished.count, ..self.counts.recording },
            preroll_bytes: preroll.bytes_held(),
            preroll_highest: preroll.bytes_highest(),
            in_flight: self.state.context.writer.in_flight() as u64,
            ..self.counts
        }
    }
}
