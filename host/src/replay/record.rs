//! Clips in a replay: the recorder sees the drive's samples beside the lambda, and every wake after
//! it.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_base::{Exit, Failure};
use gleaner_drives::Replay;
use gleaner_journal::{Entry, Header};
use gleaner_lambda::Clip;
use gleaner_lambda::manifest::{Manifest, Record};
use gleaner_recorder::{
    Earlier, Folder, LambdaId, Member, RecordError, Recorder, Settings, Topic, TopicId, is_image,
    lambda_digest,
};
use gleaner_transport::{DiscoveredTopic, SampleMeta, Sink, Transport, Verdict};

use super::chosen;
use super::pictures::Camera;
use super::{CLOCK, Options};

/// A recorder over one lambda's `[record]`.
pub(super) struct ReplayRecorder {
    shared: Arc<Mutex<Shared>>,
    /// One for each topic, with what the recorder calls it.
    lanes: Vec<Arc<Lane>>,
    rules: Record,
    /// What an earlier replay left, and what of it was recovered only now; until it is replaced.
    earlier: Option<(Earlier, Vec<Clip>)>,
    lambda: Option<LambdaId>,
}

struct Shared {
    /// There once the folder is ours.
    recorder: Option<Recorder>,
    /// Why it stopped. A sink can only say that a sample was not taken.
    failed: Option<RecordError>,
}

/// One recorded topic.
struct Lane {
    shared: Arc<Mutex<Shared>>,
    topic: Topic,
    /// Whether the drive has it.
    is_there: bool,
    id: Mutex<Option<TopicId>>,
    camera: Option<Arc<Camera>>,
}

impl Sink for Lane {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict {
        if let Some(camera) = &self.camera {
            camera.see(meta, cdr);
        }
        let mut shared = lock(&self.shared);
        let Shared { recorder: Some(recorder), failed: failed @ None } = &mut *shared else {
            return Verdict::NoSlot;
        };
        let Some(id) = *lock(&self.id) else { return Verdict::NoSlot };
        match recorder.sample(id, meta, cdr) {
            Ok(()) => Verdict::Taken,
            Err(error) => {
                *failed = Some(error);
                Verdict::NoSlot
            }
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What an earlier replay left in `out`, if it left clips: this one makes none, and results of two
/// would lie side by side.
pub(super) fn remove_clips(out: &Path) -> Result<u64, Failure> {
    if !out.join("clips.jsonl").exists() {
        return Ok(0);
    }
    let (mut folder, recovered) = Folder::open(out)?;
    Ok(folder.replace(&recovered)?)
}

impl ReplayRecorder {
    /// Subscribes the topics of `[record]`; none if the manifest has no such table.
    ///
    /// A topic that the drive does not have is no error: a vehicle's sensors differ from drive to
    /// drive. Its clips say so. Subscribed before the lambda's inputs, the recorder has the sample
    /// that a trigger is about.
    pub(super) fn subscribe(
        manifest: &Manifest,
        options: &Options,
        drive: &mut Replay,
    ) -> Result<Option<Self>, Failure> {
        let Some(rules) = &manifest.record else {
            if options.topics.is_empty() {
                return Ok(None);
            }
            let failure =
                Failure::new(Exit::Usage, "there are no clips whose topics --topics could choose");
            return Err(failure
                .with_help("add a table [record] to lambda.toml, which says how long clips are"));
        };
        let shared = Arc::new(Mutex::new(Shared { recorder: None, failed: None }));
        let known = drive.topics();
        let mut lanes = Vec::new();
        // One whose images the lambda sees anyway is not kept a second time.
        let mut is_seen = manifest.inputs.iter().any(|input| is_image(input.type_name.as_str()));
        for name in chosen::topics(rules, options, drive, &known)? {
            let name = name.as_str();
            let found = known
                .binary_search_by(|topic| topic.topic.as_str().cmp(name))
                .ok()
                .map(|at| &known[at]);
            if found.is_none() {
                tracing::warn!(topic = %name, "the drive does not have this topic of [record]: clips are made without it");
            }
            let camera = found.filter(|found| !is_seen && is_image(&found.type_name));
            is_seen |= camera.is_some();
            let lane = Arc::new(Lane {
                shared: Arc::clone(&shared),
                topic: topic(name, found),
                is_there: found.is_some(),
                id: Mutex::new(None),
                camera: camera.map(|found| Camera::new(name, &found.type_name)),
            });
            if let Some(found) = found
                && let Err(error) = drive.subscribe(&chosen::spec_of(found), lane.clone())
            {
                let failure = Failure::caused_by(
                    Exit::Usage,
                    format!("cannot record topic `{name}`"),
                    &error,
                );
                return Err(failure.with_help(
                    "remove the topic from [record], or replay without clips: --no-record",
                ));
            }
            lanes.push(lane);
        }
        if !lanes.iter().any(|lane| lane.is_there) {
            let mut failure =
                Failure::new(Exit::Usage, "the drive has none of the topics of [record]");
            let list = |names: Vec<&str>| names.join("`, `");
            failure.causes = vec![format!(
                "[record] has `{}`",
                list(lanes.iter().map(|lane| lane.topic.name.as_str()).collect())
            )];
            let help = format!(
                "the drive has {}; pass --remap FROM:=TO, or replay without clips: --no-record",
                chosen::list(&known)
            );
            return Err(failure.with_help(help));
        }
        Ok(Some(Self { shared, lanes, rules: rules.clone(), earlier: None, lambda: None }))
    }

    /// What sees the images of a recorded topic, if the lambda has none.
    pub(super) fn camera(&self) -> Option<Arc<Camera>> {
        self.lanes.iter().find_map(|lane| lane.camera.clone())
    }

    /// Makes the recorder, which takes hold of the clips in `out`. What a killed replay left there
    /// is recovered, kept until the next, and said; what an earlier one left stays until
    /// [`ReplayRecorder::replace`].
    pub(super) fn start(&mut self, out: &Path, header: &Header) -> Result<(), Failure> {
        let (folder, recovered) = Folder::open(out)?;
        for clip in &recovered {
            tracing::warn!(clip = %clip.file.display(), "recovered a clip of an earlier replay, which did not end well");
        }
        self.earlier = Some((folder.earlier(), recovered));
        let settings = Settings {
            store: self.rules.store,
            preroll_bytes: self.rules.preroll_size.bytes(),
            max_length: self.rules.max_length,
            folder: out.to_owned(),
            clock: CLOCK.to_owned(),
            prefault: false,
        };
        let mut recorder = Recorder::new(folder, settings)?;
        let mut topics = Vec::new();
        for lane in &self.lanes {
            let id = if lane.is_there {
                recorder.add_topic(lane.topic.clone())?
            } else {
                recorder.add_missing_topic(&lane.topic.name)?
            };
            *lock(&lane.id) = Some(id);
            topics.push(id);
        }
        let (header, digest) = (header.clone(), lambda_digest(&header.files));
        self.lambda =
            Some(recorder.add_lambda(Member { header, rules: self.rules.clone(), digest, topics }));
        lock(&self.shared).recorder = Some(recorder);
        Ok(())
    }

    /// Replaces the clips of an earlier replay, but not those that were recovered; returns how
    /// many.
    pub(super) fn replace(&mut self) -> Result<u64, Failure> {
        Ok(self.earlier.take().map_or(Ok(0), |(earlier, recovered)| earlier.replace(&recovered))?)
    }

    /// After a wake: what it triggered opens or closes windows.
    pub(super) fn wake(&self, entry: &Entry) -> Result<(), Failure> {
        self.with(|recorder| match self.lambda {
            Some(lambda) => recorder.wake(lambda, entry),
            None => Ok(()),
        })
    }

    /// After a sample: whether it could be kept.
    pub(super) fn check(&self) -> Result<(), Failure> {
        match lock(&self.shared).failed.take() {
            None => Ok(()),
            Some(error) => Err(error.into()),
        }
    }

    /// At the end of the drive: closes what is open.
    pub(super) fn finish(&self, end_ns: i64) -> Result<gleaner_protocol::Recording, Failure> {
        self.with(|recorder| {
            recorder.finish(end_ns)?;
            Ok(recorder.counts().recording)
        })
    }

    fn with<T: Default>(
        &self,
        act: impl FnOnce(&mut Recorder) -> Result<T, RecordError>,
    ) -> Result<T, Failure> {
        match &mut lock(&self.shared).recorder {
            Some(recorder) => Ok(act(recorder)?),
            None => Ok(T::default()),
        }
    }
}

fn topic(name: &str, found: Option<&DiscoveredTopic>) -> Topic {
    Topic {
        name: name.to_owned(),
        type_name: found.map(|topic| topic.type_name.clone()).unwrap_or_default(),
        definitions: found.and_then(|topic| topic.definitions_text.clone()),
        offered_qos: found.and_then(|topic| topic.offered_qos.clone()),
    }
}
