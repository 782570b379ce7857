//! Records clips in a replay: the recorder receives the drive's samples beside the lambda, and
//! every wake after it.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_base::{Exit, Failure, excerpt};
use gleaner_drives::Replay;
use gleaner_journal::{JournalEntry, JournalHeader};
use gleaner_lambda::Clip;
use gleaner_lambda::manifest::{Manifest, RecordSpec};
use gleaner_messages::transport::{
    Delivery, DiscoveredTopic, SampleMeta, Sink, Transport, same_type,
};
use gleaner_recorder::{
    EarlierClips, LambdaId, LambdaSpec, RecordError, Recorder, RecordingFolder, Settings, TopicId,
    TopicSchema, is_image, lambda_digest,
};

use super::options::ReplayOptions;
use super::pictures::RecordedCamera;
use super::topic_filter;
use crate::input::Remap;
use crate::journal::CLOCK_OF_DRIVE;

/// Most sentences on what all clips lack.
const NOTES_MAX: usize = 64;

/// Most types of a topic that a clip names as left out.
const NOTED: usize = 8;

/// A recorder over one lambda's `[record]`.
pub(super) struct ReplayRecorder {
    shared: Arc<Mutex<SharedRecorder>>,
    topics: Vec<Arc<TopicRecorder>>,
    rules: RecordSpec,
    /// Sentences on what all clips lack.
    notes: Vec<String>,
    /// Clips of an earlier replay, and those of them that were recovered now; until they are
    /// replaced.
    earlier: Option<(EarlierClips, Vec<Clip>)>,
    lambda: Option<LambdaId>,
}

struct SharedRecorder {
    /// Set once the folder is locked.
    recorder: Option<Recorder>,
    /// The error that stopped it. A sink can only report that a sample was not taken.
    failed: Option<RecordError>,
}

struct TopicRecorder {
    shared: Arc<Mutex<SharedRecorder>>,
    topic: TopicSchema,
    /// Set if the drive has it.
    exists: bool,
    id: Mutex<Option<TopicId>>,
    camera: Option<Arc<RecordedCamera>>,
}

impl Sink for TopicRecorder {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        if let Some(camera) = &self.camera {
            camera.see(meta, cdr);
        }
        let mut shared = lock(&self.shared);
        let SharedRecorder { recorder: Some(recorder), failed: failed @ None } = &mut *shared
        else {
            return Delivery::NoSlot;
        };
        let Some(id) = *lock(&self.id) else { return Delivery::NoSlot };
        match recorder.sample(id, meta, cdr) {
            Ok(()) => Delivery::Taken,
            Err(error) => {
                *failed = Some(error);
                Delivery::NoSlot
            }
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes the clips of an earlier replay in `out`: this replay writes none, and results of two
/// would be mixed. Returns their number.
pub(super) fn remove_clips(out: &Path) -> Result<u64, Failure> {
    if !out.join("clips.jsonl").exists() {
        return Ok(0);
    }
    let (mut folder, recovered) = RecordingFolder::open(out)?;
    Ok(folder.replace(&recovered)?)
}

impl ReplayRecorder {
    /// Subscribes the topics of `[record]`; returns `None` if the manifest has no such table.
    ///
    /// A topic that the drive does not have is no error: a vehicle's sensors differ from drive to
    /// drive. The clips note it. Call this before the lambda's inputs are subscribed, so that the
    /// recorder has the sample that causes a trigger.
    pub(super) fn subscribe(
        manifest: &Manifest,
        options: &ReplayOptions,
        drive: &mut Replay,
    ) -> Result<Option<Self>, Failure> {
        let Some(rules) = &manifest.record else {
            return if options.topics.is_empty() { Ok(None) } else { Err(nothing_recorded()) };
        };
        let shared = Arc::new(Mutex::new(SharedRecorder { recorder: None, failed: None }));
        let known = drive.topics();
        let mut topics = Vec::new();
        let chosen = topic_filter::topics(rules, options, drive, &known)?;
        let mut notes = Vec::from_iter(chosen.left_out);
        // No camera is kept if the lambda itself has an input with images.
        let mut is_seen = manifest.inputs.iter().any(|input| is_image(input.type_name.as_str()));
        for name in &chosen.names {
            let name = name.as_str();
            let found = recorded_type(name, &known, manifest, options);
            match found {
                Some(found) => notes.extend(other_types(found, &known)),
                None => tracing::warn!(
                    topic = %name,
                    "the drive does not have a topic of [record]: clips lack this topic"
                ),
            }
            let camera = found.filter(|found| !is_seen && is_image(&found.type_name));
            is_seen |= camera.is_some();
            let recorded = Arc::new(TopicRecorder {
                shared: Arc::clone(&shared),
                topic: topic(name, found),
                exists: found.is_some(),
                id: Mutex::new(None),
                camera: camera.map(|found| RecordedCamera::new(name, &found.type_name)),
            });
            if let Some(found) = found
                && let Err(error) = drive.subscribe(&topic_filter::spec_of(found), recorded.clone())
            {
                let message = format!("cannot record topic `{name}`");
                return Err(Failure::caused_by(Exit::Usage, message, &error).with_help(
                    "remove the topic from [record], or replay without clips: --no-record",
                ));
            }
            topics.push(recorded);
        }
        if !topics.iter().any(|recorded| recorded.exists) {
            return Err(none_found(&topics, &known));
        }
        let rules = rules.clone();
        Ok(Some(Self { shared, topics, rules, notes, earlier: None, lambda: None }))
    }

    /// The camera of a recorded topic, if the lambda has no input with images.
    pub(super) fn camera(&self) -> Option<Arc<RecordedCamera>> {
        self.topics.iter().find_map(|recorded| recorded.camera.clone())
    }

    /// Creates the recorder, which locks the clips in `out`. Unfinished clips of a killed replay
    /// are recovered, logged, and kept until the next replay; clips of an earlier replay stay until
    /// [`ReplayRecorder::replace`].
    pub(super) fn start(&mut self, out: &Path, header: &JournalHeader) -> Result<(), Failure> {
        let (folder, recovered) = RecordingFolder::open(out)?;
        for clip in &recovered {
            let clip = clip.file.display();
            tracing::warn!(%clip, "recovered an unfinished clip of an earlier replay");
        }
        self.earlier = Some((folder.earlier(), recovered));
        let settings = Settings {
            store: self.rules.store,
            preroll_bytes: self.rules.preroll_size.bytes(),
            max_length: self.rules.max_length,
            folder: out.to_owned(),
            clock: CLOCK_OF_DRIVE.to_owned(),
            prefault: false,
        };
        let mut recorder = Recorder::new(folder, settings)?;
        self.notes.drain(..).take(NOTES_MAX).for_each(|note| recorder.note(note));
        let mut topics = Vec::new();
        for recorded in &self.topics {
            let id = if recorded.exists {
                recorder.add_topic(recorded.topic.clone())?
            } else {
                recorder.add_missing_topic(&recorded.topic.name)?
            };
            *lock(&recorded.id) = Some(id);
            topics.push(id);
        }
        let (header, digest) = (header.clone(), lambda_digest(&header.files));
        self.lambda = Some(recorder.add_lambda(LambdaSpec {
            header,
            rules: self.rules.clone(),
            digest,
            topics,
        }));
        lock(&self.shared).recorder = Some(recorder);
        Ok(())
    }

    /// Removes the clips of an earlier replay, except those that were recovered; returns their
    /// number.
    pub(super) fn replace(&mut self) -> Result<u64, Failure> {
        Ok(self.earlier.take().map_or(Ok(0), |(earlier, recovered)| earlier.replace(&recovered))?)
    }

    /// Adds a wake, whose triggers open or close windows.
    pub(super) fn wake(&self, entry: &JournalEntry) -> Result<(), Failure> {
        self.with_recorder(|recorder| match self.lambda {
            Some(lambda) => recorder.wake(lambda, entry),
            None => Ok(()),
        })
    }

    /// Returns the error of the recorder, if a sample could not be stored; call it after each
    /// sample.
    pub(super) fn check(&self) -> Result<(), Failure> {
        match lock(&self.shared).failed.take() {
            None => Ok(()),
            Some(error) => Err(error.into()),
        }
    }

    /// Closes open windows, at the end of the drive.
    pub(super) fn finish(&self, end_ns: i64) -> Result<gleaner_protocol::RecordingCounts, Failure> {
        self.with_recorder(|recorder| {
            recorder.finish(end_ns)?;
            Ok(recorder.counts().recording)
        })
    }

    fn with_recorder<T: Default>(
        &self,
        act: impl FnOnce(&mut Recorder) -> Result<T, RecordError>,
    ) -> Result<T, Failure> {
        match &mut lock(&self.shared).recorder {
            Some(recorder) => Ok(act(recorder)?),
            None => Ok(T::default()),
        }
    }
}

/// The failure of `--topics` for a lambda that records no clips.
fn nothing_recorded() -> Failure {
    let message = "--topics selects the topics of clips, and this lambda records none";
    Failure::new(Exit::Usage, message)
        .with_help("add a table [record] to lambda.toml, which sets the length of clips")
}

/// The failure of a drive without any topic of `[record]`.
fn none_found(topics: &[Arc<TopicRecorder>], known: &[DiscoveredTopic]) -> Failure {
    let mut failure = Failure::new(Exit::Usage, "the drive has none of the topics of [record]");
    let names: Vec<_> = topics.iter().map(|recorded| recorded.topic.name.as_str()).collect();
    failure.causes = vec![format!("[record] has `{}`", names.join("`, `"))];
    failure.with_help(match known.is_empty() {
        true => "the drive has no messages; copy it again if it is damaged".to_owned(),
        false => format!(
            "the drive has {}; pass --remap FROM:=TO, or replay without clips: --no-record",
            topic_filter::list(known)
        ),
    })
}

/// Notes on the types of a topic that are left out, beside the one that is recorded.
fn other_types<'t>(
    recorded: &'t DiscoveredTopic,
    known: &'t [DiscoveredTopic],
) -> impl Iterator<Item = String> + 't {
    let is_other = |topic: &&DiscoveredTopic| {
        topic.topic == recorded.topic
            && topic.type_name != recorded.type_name
            && topic.messages != Some(0)
    };
    known.iter().filter(is_other).take(NOTED).map(|topic| {
        let (name, type_name) = (excerpt(&topic.topic), excerpt(&topic.type_name));
        format!("no messages of {name} that have the type {type_name}")
    })
}

/// Chooses the type in which a topic of the drive is recorded: that in which the lambda reads it,
/// else the one with the most messages.
fn recorded_type<'t>(
    name: &str,
    known: &'t [DiscoveredTopic],
    manifest: &Manifest,
    options: &ReplayOptions,
) -> Option<&'t DiscoveredTopic> {
    let is_read = |topic: &&DiscoveredTopic| {
        manifest.inputs.iter().any(|input| {
            Remap::apply(&options.lambda.remaps, input.topic.as_str()) == name
                && same_type(input.type_name.as_str(), &topic.type_name)
        })
    };
    let mut types = known.iter().filter(|topic| topic.topic == name);
    let first = types.next()?;
    Some(std::iter::once(first).chain(types).find(is_read).unwrap_or(first))
}

fn topic(name: &str, found: Option<&DiscoveredTopic>) -> TopicSchema {
    let found = found.cloned().unwrap_or_default();
    TopicSchema {
        name: name.to_owned(),
        type_name: found.type_name,
        definitions: found.definitions_text,
        other_definitions: found.other_definitions,
        offered_qos: found.offered_qos,
    }
}
