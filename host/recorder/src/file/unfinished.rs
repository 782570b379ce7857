//! Writes a clip.

use std::collections::{BTreeMap, HashMap};
use std::fs::OpenOptions;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use gleaner_lambda::{Clip, Recovered};
use gleaner_messages::transport::{Guid, SampleMeta};
use gleaner_trust::{ClipSigner, ClipStatement};
use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, Compression, McapError, WriteOptions, Writer};

use super::clip_dir::{CLIP, CLIPS, ClipDir, JPG, JPG_PART};
use super::clip_records::{self, THUMBNAIL};
use super::sink::FileSink;
use super::written::{Written, encapsulation, stamp};
use super::{ClipHeader, ClipTrailer, TopicSchema, durable, signing};
use crate::error::RecordError;

/// Compression of chunks. On the example drive (JPEG, IMU, speed) zstd at level 1 leaves 0.74 of
/// the bytes at 590 MB/s, lz4 0.77 at 650 MB/s, and no compression 1.06 at 1760 MB/s; without the
/// camera 0.23, 0.28 and 1.25. Every MCAP reader supports zstd.
const COMPRESSION: Option<Compression> = Some(Compression::Zstd);
/// A chunk is closed when it has this many bytes, before compression.
const CHUNK_BYTES: u64 = 1 << 20;
/// A chunk is closed before it spans more time than this, in ns: a crash of the recorder costs at
/// most this much of a clip.
pub(super) const CHUNK_SPAN_NS: i64 = 1_000_000_000;
/// Maximum number of channels of a clip. Further writers share one channel of their topic, without
/// a writer.
pub(super) const CHANNELS_MAX: usize = 16 << 10;

/// Maximum length of a message, in bytes. The fields of the file allow more, but every reader of a
/// clip holds a chunk of it in memory, and our reader no more than 1 GiB: a message and the rest of
/// its chunk.
pub const MESSAGE_MAX: usize = 960 << 20;
/// Maximum length of a metadata record, in bytes; usual ones have some KB, with the config of a
/// lambda.
pub(super) const METADATA_MAX: usize = 64 << 20;

/// A clip that is being written. Unless it is finished, its file stays unfinished, for
/// [`super::RecordingFolder::open`] to recover.
pub(crate) struct UnfinishedClip {
    dir: Arc<ClipDir>,
    name: String,
    path: PathBuf,
    /// `None` once it is finished or dropped.
    writer: Option<Writer<FileSink>>,
    clock: String,
    channels: Channels,
    chunk: Option<Chunk>,
    /// Bytes of the file up to the open chunk.
    closed_bytes: Arc<AtomicU64>,
    /// Makes the sink hold the end of the file.
    hold: Arc<AtomicBool>,
    /// Encapsulation and payload of a message.
    frame: Vec<u8>,
    written: Written,
}

#[derive(Copy, Clone)]
struct Chunk {
    first_ns: i64,
    last_ns: i64,
    bytes: u64,
}

#[derive(Default)]
struct Channels {
    by_topic: HashMap<String, TopicChannels>,
    count: usize,
}

struct TopicChannels {
    /// Index in [`Written::topics`].
    index: usize,
    by_writer: HashMap<ChannelKey, u16>,
}

/// Common properties of the messages of a channel, beside their topic.
#[derive(Copy, Clone, Default, PartialEq, Eq, Hash)]
struct ChannelKey {
    writer: Option<Guid>,
    layout: u16,
    is_latched: bool,
}

impl ChannelKey {
    fn of(meta: &SampleMeta) -> Self {
        let SampleMeta { writer, layout, is_latched, .. } = *meta;
        Self { writer: Some(writer), layout, is_latched }
    }
}

struct ClipChannel {
    /// Index in [`Written::topics`].
    index: usize,
    id: u16,
    /// Approximate bytes of its description, if it is new.
    new_bytes: u64,
}

/// The recovery of a clip after its recorder died.
pub(super) struct RecoveredFrom {
    pub(super) recovered: Recovered,
    /// File name of the unfinished clip.
    pub(super) from: String,
}

impl UnfinishedClip {
    /// Begins the clip `name`, in a new file with this suffix.
    pub(super) fn create(
        dir: Arc<ClipDir>,
        name: String,
        trailer: &str,
        clip_header: Option<&ClipHeader>,
    ) -> Result<Self, RecordError> {
        let path = dir.path(&name, trailer);
        let file = OpenOptions::new().write(true).create_new(true).open(&path);
        let file = file.map_err(|source| RecordError::Create { path: path.clone(), source })?;
        let sink = FileSink::new(file, dir.signer().is_some());
        Self::begin(dir, name, path, sink, clip_header)
    }

    pub(super) fn begin(
        dir: Arc<ClipDir>,
        name: String,
        path: PathBuf,
        sink: FileSink,
        clip_header: Option<&ClipHeader>,
    ) -> Result<Self, RecordError> {
        let (closed_bytes, hold) = (sink.position(), sink.hold());
        let writer = options().create(sink).map_err(|error| cannot_write(&path, error))?;
        let mut clip = Self {
            dir,
            name,
            path,
            writer: Some(writer),
            clock: clip_header
                .map_or_else(|| "unknown".to_owned(), |clip_header| clip_header.clock.clone()),
            channels: Channels::default(),
            chunk: None,
            closed_bytes,
            hold,
            frame: Vec::new(),
            written: Written::default(),
        };
        if let Some((name, metadata)) =
            clip_header.map(|clip_header| clip_records::begin(clip_header, clip_records::LIBRARY))
        {
            clip.metadata(name, metadata)?;
        }
        clip.flush()?;
        Ok(clip)
    }

    /// Adds a message of `topic`, whose payload is `cdr`.
    ///
    /// # Errors
    ///
    /// [`RecordError::TooLarge`] above [`MESSAGE_MAX`]; then nothing was written. [`RecordError`]
    /// if it cannot be written. Then the clip must not be used further: its content is recovered
    /// when the folder is opened again.
    pub fn message(
        &mut self,
        topic: &TopicSchema,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        self.check("a message", cdr.len(), MESSAGE_MAX)?;
        if self.chunk.is_some_and(|chunk| chunk.is_closed_by(meta.at_ns)) {
            self.flush()?;
        }
        let ClipChannel { index, id: channel_id, new_bytes } =
            self.channel(topic, ChannelKey::of(meta))?;
        let mut frame = std::mem::take(&mut self.frame);
        frame.clear();
        frame.extend_from_slice(&encapsulation(meta));
        frame.extend_from_slice(cdr);
        let header = MessageHeader {
            channel_id,
            // The field has 32 bits; a writer that sends more starts again at 0.
            sequence: meta.seq as u32,
            log_time: stamp(meta.at_ns),
            publish_time: stamp(meta.publish_ns),
        };
        let written = self.with_writer(|writer| writer.write_to_known_channel(&header, &frame));
        let bytes = frame.len() as u64 + new_bytes;
        self.frame = frame;
        written?;
        self.written.count(index, meta, cdr);
        let chunk =
            self.chunk.get_or_insert(Chunk { first_ns: meta.at_ns, last_ns: meta.at_ns, bytes: 0 });
        chunk.first_ns = chunk.first_ns.min(meta.at_ns);
        chunk.last_ns = chunk.last_ns.max(meta.at_ns);
        chunk.bytes += bytes;
        if chunk.bytes >= CHUNK_BYTES { self.flush() } else { Ok(()) }
    }

    /// Gives `topic` a channel if it has none: it was recorded, but had no message.
    /// Errors as of [`UnfinishedClip::message`].
    pub fn declare(&mut self, topic: &TopicSchema) -> Result<(), RecordError> {
        if self.channels.by_topic.contains_key(&topic.name) {
            return Ok(());
        }
        let channel = self.channel(topic, ChannelKey::default())?;
        // Many topics with large definitions must not share one chunk.
        if channel.new_bytes > CHUNK_BYTES / 16 { self.flush() } else { Ok(()) }
    }

    /// Closes the open chunk: its content survives a crash of this process. Called internally at
    /// least for every second of messages. Errors as of [`UnfinishedClip::message`].
    pub fn flush(&mut self) -> Result<(), RecordError> {
        self.chunk = None;
        self.with_writer(Writer::flush)?;
        Ok(())
    }

    /// Completes, renames and lists the clip. When this returns, all of it is on the disk.
    ///
    /// # Errors
    ///
    /// [`RecordError`]; the written content is then recovered when the folder is opened again.
    pub fn finish(self, trailer: ClipTrailer) -> Result<Clip, RecordError> {
        let name = self.name.clone();
        self.close(trailer, &name, None)
    }

    /// Finishes the clip as [`UnfinishedClip::finish`] does, under the name `name`.
    pub(super) fn close(
        mut self,
        trailer: ClipTrailer,
        name: &str,
        recovery: Option<RecoveredFrom>,
    ) -> Result<Clip, RecordError> {
        let dir = Arc::clone(&self.dir);
        // Before the footer, so that a complete unfinished file has its thumbnail.
        if let Some(jpeg) = &trailer.thumbnail {
            durable::write(&dir.path(name, JPG_PART), &dir.path(name, JPG), dir.folder(), jpeg)?;
        }
        let thumbnail = dir.exists(name, JPG).then(|| format!("{CLIPS}/{name}{JPG}").into());
        let mut clip = clip_records::clip(
            &trailer,
            &self.written,
            format!("{CLIPS}/{name}{CLIP}").into(),
            thumbnail,
        );
        clip.recovered = recovery.as_ref().map(|recovery| recovery.recovered.clone());
        let from = recovery.as_ref().map(|recovery| recovery.from.as_str());
        let written = std::mem::take(&mut self.written);
        for (name, metadata) in clip_records::records(&trailer, &clip, &written, &self.clock, from)
        {
            self.metadata(name, metadata)?;
        }
        let signing = dir.signer().and_then(|signer| self.statement(signer, &trailer, &clip));
        self.attach_all(trailer, signing.as_ref().map(|(_, _, length)| *length))?;
        self.with_writer(|writer| writer.finish().map(drop))?;
        let cannot_sync = |source| RecordError::Sync { path: self.path.clone(), source };
        let sink = self
            .writer
            .take()
            .expect("nothing takes the writer before its clip is closed")
            .into_inner();
        clip.bytes = self.closed_bytes.load(Ordering::Relaxed);
        let file = sink
            .complete(|before, rest| {
                let Some((signer, statement, _)) = signing else { return };
                if let Err(error) = signer.complete(before, rest, statement) {
                    signing::failed(&dir, &clip, &error);
                }
            })
            .map_err(|source| RecordError::Write { path: self.path.clone(), source })?;
        file.sync_all().map_err(cannot_sync)?;
        durable::rename(&self.path, &dir.path(name, CLIP), dir.folder())?;
        dir.add(name, &clip)?;
        Ok(clip)
    }

    /// Attaches journals and thumbnail, and room for an envelope of `signature` bytes.
    fn attach_all(
        &mut self,
        trailer: ClipTrailer,
        signature: Option<usize>,
    ) -> Result<(), RecordError> {
        let at_ns = trailer.to_ns;
        for (lambda, journal) in trailer.journals {
            let name = clip_records::journal(&lambda);
            self.attach(name, "application/octet-stream", journal, at_ns)?;
        }
        if let Some(jpeg) = trailer.thumbnail {
            self.attach(THUMBNAIL.to_owned(), "image/jpeg", jpeg, at_ns)?;
        }
        if let Some(length) = signature {
            self.hold.store(true, Ordering::Relaxed);
            let (name, media_type) = signing::ATTACHMENT;
            self.attach(name.to_owned(), media_type, vec![b' '; length], at_ns)?;
        }
        Ok(())
    }

    /// Returns the statement to sign, and the length of its envelope; `None` if it cannot be
    /// signed, which is no reason to lose the clip.
    fn statement<'s>(
        &self,
        signer: &'s ClipSigner,
        trailer: &ClipTrailer,
        clip: &Clip,
    ) -> Option<(&'s ClipSigner, ClipStatement, usize)> {
        let statement = signing::statement(signer, trailer, clip, &self.clock);
        let ready = statement.and_then(|statement| {
            let length = signer.length(&statement)?;
            Ok((signer, statement, length))
        });
        ready.inspect_err(|error| signing::failed(&self.dir, clip, error)).ok()
    }

    pub(super) fn messages(&self) -> u64 {
        self.written.messages()
    }

    pub(super) fn span(&self) -> Option<(i64, i64)> {
        self.written.span
    }

    fn metadata(
        &mut self,
        name: String,
        metadata: BTreeMap<String, String>,
    ) -> Result<(), RecordError> {
        let bytes = metadata.iter().map(|(key, value)| key.len() + value.len()).sum();
        self.check("a metadata record", bytes, METADATA_MAX)?;
        let record = Metadata { name, metadata };
        self.with_writer(|writer| writer.write_metadata(&record))
    }

    fn attach(
        &mut self,
        name: String,
        media_type: &str,
        data: Vec<u8>,
        at_ns: i64,
    ) -> Result<(), RecordError> {
        let (log_time, create_time) = (stamp(at_ns), stamp(at_ns));
        let attachment = Attachment {
            log_time,
            create_time,
            name,
            media_type: media_type.to_owned(),
            data: data.into(),
        };
        self.with_writer(|writer| writer.attach(&attachment))
    }

    /// Checks that a clip has room for `bytes` of this kind of data.
    fn check(&self, what: &'static str, bytes: usize, most: usize) -> Result<(), RecordError> {
        if bytes <= most {
            Ok(())
        } else {
            Err(RecordError::TooLarge { path: self.path.clone(), what, bytes, most })
        }
    }

    /// Returns the channel for messages of the topic by this writer, or by an unnamed one.
    fn channel(
        &mut self,
        topic: &TopicSchema,
        mut key: ChannelKey,
    ) -> Result<ClipChannel, RecordError> {
        let is_full = self.channels.count >= CHANNELS_MAX;
        if let Some(known) = self.channels.by_topic.get(&topic.name) {
            let mut id = known.by_writer.get(&key);
            if id.is_none() && is_full {
                key.writer = None;
                id = known.by_writer.get(&key);
            }
            if let Some(id) = id {
                return Ok(ClipChannel { index: known.index, id: *id, new_bytes: 0 });
            }
        }
        let mut metadata = BTreeMap::new();
        if let Some(qos) = &topic.offered_qos {
            metadata.insert("offered_qos_profiles".to_owned(), qos.clone());
        }
        if key.is_latched {
            metadata.insert("gleaner.latched".to_owned(), "true".to_owned());
        }
        if let Some(writer) = key.writer {
            metadata.insert("gleaner.writer".to_owned(), writer.to_string());
        }
        let definitions = topic.layout(key.layout).map(Arc::as_ref).unwrap_or_default();
        let new_bytes =
            definitions.len() + topic.offered_qos.as_deref().map_or(0, str::len) + topic.name.len();
        let id = self.with_writer(|writer| {
            // Without definitions the schema still has the type's name.
            let schema = writer.add_schema(&topic.type_name, "ros2msg", definitions.as_bytes())?;
            writer.add_channel(schema, &topic.name, "cdr", &metadata)
        })?;
        let written = &mut self.written;
        let known = self.channels.by_topic.entry(topic.name.clone()).or_insert_with(|| {
            TopicChannels { index: written.add_topic(topic), by_writer: HashMap::new() }
        });
        written.add_definitions(known.index, definitions);
        known.by_writer.insert(key, id);
        self.channels.count += 1;
        Ok(ClipChannel { index: known.index, id, new_bytes: new_bytes as u64 })
    }

    fn with_writer<T>(
        &mut self,
        act: impl FnOnce(&mut Writer<FileSink>) -> Result<T, McapError>,
    ) -> Result<T, RecordError> {
        let writer =
            self.writer.as_mut().expect("nothing takes the writer before its clip is closed");
        act(writer).map_err(|error| cannot_write(&self.path, error))
    }
}

impl Drop for UnfinishedClip {
    fn drop(&mut self) {
        // Otherwise the writer would add a footer, and the file would look complete.
        if let Some(writer) = self.writer.take() {
            drop(writer.into_inner());
        }
    }
}

impl Chunk {
    fn is_closed_by(&self, at_ns: i64) -> bool {
        let (first, last) = (self.first_ns.min(at_ns), self.last_ns.max(at_ns));
        last.saturating_sub(first) > CHUNK_SPAN_NS
    }
}

fn options() -> WriteOptions {
    WriteOptions::new()
        .profile("ros2")
        .library(clip_records::LIBRARY)
        .compression(COMPRESSION)
        .compression_level(1)
        // No threads: this thread has the time.
        .compression_threads(0)
        // Chunks are closed here, by time as well.
        .chunk_size(None)
        // A chunk is built in memory and written at once, so only the last one can be torn.
        .disable_seeking(true)
}

fn cannot_write(path: &Path, error: McapError) -> RecordError {
    let path = path.to_owned();
    match error {
        McapError::Io(source) => RecordError::Write { path, source },
        source => RecordError::Format { path, source: Box::new(source) },
    }
}
