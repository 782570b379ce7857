//! Reads clips, complete or truncated.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use gleaner_drives::{Damage, DamageLocation, DriveLimits, Replay, ReplayError, read_extras};
use gleaner_lambda::Clip;
use gleaner_messages::transport::{Delivery, SampleMeta, TopicSpec, Transport};

use super::clip_records::{BEGIN, CLIP_RECORD, read_begin, read_line, read_recovered_from};
use super::recover::Pause;
use super::written::Written;
use super::{ClipHeader, TopicSchema};
use crate::error::RecordError;

/// The largest chunk: one message of any size that a lambda may request.
const LIMITS: DriveLimits =
    DriveLimits { chunk_bytes: 1 << 30, open_bytes: 1 << 30, unpacked_bytes: 0 };
/// Maximum size of the metadata and attachments of a clip, in bytes: the journals of 16 lambdas.
const EXTRAS_BYTES: u64 = 1 << 30;

/// The end of an incomplete file, and the reason.
pub(super) struct EarlyEnd {
    pub(super) at: u64,
    pub(super) why: Damage,
}

struct ClipReader {
    replay: Replay,
    last: Arc<LastMessage>,
    topics: Vec<TopicSchema>,
}

impl ClipReader {
    fn open(path: &Path, limits: DriveLimits) -> Result<ClipReader, RecordError> {
        let mut replay = Replay::open_with(&[path.to_owned()], limits).map_err(unreadable(path))?;
        let last = Arc::new(LastMessage::default());
        let mut topics = Vec::new();
        for found in replay.topics() {
            let spec = TopicSpec {
                topic: found.topic,
                type_name: found.type_name,
                queue: 1,
                max_bytes: usize::MAX,
                qos: Default::default(),
            };
            replay
                .subscribe(&spec, Arc::clone(&last) as Arc<dyn gleaner_messages::transport::Sink>)
                .map_err(|source| RecordError::Topic {
                    path: path.to_owned(),
                    source: Box::new(source),
                })?;
            topics.push(TopicSchema {
                name: spec.topic,
                type_name: spec.type_name,
                definitions: found.definitions_text,
                other_definitions: found.other_definitions,
                offered_qos: found.offered_qos,
            });
        }
        Ok(ClipReader { replay, last, topics })
    }

    /// Passes the next message, with the index of its topic, to `act`; `None` at the end.
    fn next<T>(
        &mut self,
        act: impl FnOnce(usize, &SampleMeta, &[u8]) -> T,
    ) -> Result<Option<T>, ReplayError> {
        Ok(self.replay.step()?.map(|step| {
            let cdr = self.last.0.lock().unwrap_or_else(PoisonError::into_inner);
            act(step.subscription.0, &step.meta, &cdr)
        }))
    }
}

/// Passes each message of the clip `path` to `act`, in the order of their stamps, up to the end or
/// to the damage, which is returned.
pub(super) fn each_message(
    path: &Path,
    mut act: impl FnMut(&TopicSchema, &SampleMeta, &[u8]) -> Result<(), RecordError>,
) -> Result<Option<EarlyEnd>, RecordError> {
    let mut reader = ClipReader::open(path, LIMITS)?;
    let topics = std::mem::take(&mut reader.topics);
    loop {
        match reader.next(|topic, meta, cdr| act(&topics[topic], meta, cdr)) {
            Ok(Some(done)) => done?,
            Ok(None) => return Ok(None),
            Err(ReplayError::Damaged { at: DamageLocation::Byte(at), what, .. }) => {
                return Ok(Some(EarlyEnd { at, why: what }));
            }
            Err(error) => return Err(unreadable(path)(error)),
        }
    }
}

/// Counts the messages of the clip `path`. The file is untrusted: its chunks are bounded as those
/// of a drive.
pub(super) fn written(path: &Path) -> Result<Written, RecordError> {
    let mut reader = ClipReader::open(path, DriveLimits::default())?;
    let mut written = Written::default();
    for topic in &reader.topics {
        let index = written.add_topic(topic);
        for text in topic.definitions.iter().chain(&topic.other_definitions) {
            written.add_definitions(index, text);
        }
    }
    while reader
        .next(|topic, meta, cdr| written.count(topic, meta, cdr))
        .map_err(unreadable(path))?
        .is_some()
    {}
    Ok(written)
}

fn unreadable(path: &Path) -> impl Fn(ReplayError) -> RecordError + '_ {
    |source| RecordError::Unreadable { path: path.to_owned(), source: Box::new(source) }
}

/// A sink that keeps the last message.
#[derive(Default)]
struct LastMessage(Mutex<Vec<u8>>);

impl gleaner_messages::transport::Sink for LastMessage {
    fn deliver(&self, _: &SampleMeta, cdr: &[u8]) -> Delivery {
        let mut last = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        last.clear();
        last.extend_from_slice(cdr);
        Delivery::Taken
    }
}

/// Returns the list entry of the clip `path` if the file is complete, which is checked by reading
/// all of it.
pub(super) fn complete_clip(path: &Path, pause: &mut Pause) -> Result<Option<Clip>, RecordError> {
    if each_message(path, |_, _, _| pause())?.is_some() {
        return Ok(None);
    }
    let extras = read_extras(path, EXTRAS_BYTES).map_err(unreadable(path))?;
    Ok(extras
        .metadata
        .iter()
        .find(|(name, _)| name == CLIP_RECORD)
        .and_then(|(_, metadata)| read_line(metadata)))
}

/// Returns the header of the clip `path`; `None` if it cannot be read.
pub(super) fn clip_header(path: &Path) -> Option<ClipHeader> {
    let extras = read_extras(path, EXTRAS_BYTES).ok()?;
    extras
        .metadata
        .iter()
        .find(|(name, _)| name == BEGIN)
        .and_then(|(_, metadata)| read_begin(metadata).ok())
}

pub(super) fn recovered_from(path: &Path) -> Option<String> {
    let extras = read_extras(path, EXTRAS_BYTES).ok()?;
    let (_, metadata) = extras.metadata.iter().find(|(name, _)| name == CLIP_RECORD)?;
    read_recovered_from(metadata).map(str::to_owned)
}
