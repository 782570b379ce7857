//! Samples, fields and frames, as a lambda reads them.
//!
//! Every number that a lambda passes is clamped here, and nothing is allocated in proportion to it beyond the clamps below.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use gleaner_buffers::{Lease, RingCounts, RingReader};
use gleaner_transport::SampleMeta;
use gleaner_transport::message::{CdrError, Definitions, Endian, FieldPath, HeaderStamp, Value, header_stamp};

pub use super::error::DataError;
use super::frame::{Frame, Images, Picture};
use super::log::cut;
use super::trace::{Arrivals, Looked};
pub use super::values::{Column, Counts, Identity, Stamps, Tick};

/// Most samples that one call hands out.
pub const SAMPLES_PER_CALL: usize = 256;
/// Most values in one column.
pub const COLUMN_LEN: usize = 65_536;
/// Most bytes that one call copies out.
pub const BYTES_PER_CALL: usize = 1 << 20;
/// What reading a field at a fixed place costs, in bytes: the walk to it, and its value.
pub const FIELD_BYTES: usize = 64;
/// Longest path of a field, in bytes.
pub const PATH_BYTES: usize = 1024;
/// Longest list of strings in one field.
pub const TEXTS_PER_FIELD: usize = 4096;

/// The ring of one input, as its lambda sees it.
pub struct Topic {
    input: String,
    topic: String,
    type_name: String,
    reader: RingReader<SampleMeta>,
    definitions: Arc<Definitions>,
    header: Option<HeaderStamp>,
    pub(super) images: Images,
    skipped: AtomicU64,
    pub(super) arrivals: Arc<Arrivals>,
    pub(super) looked: Looked,
    /// Reused between column reads, so that they allocate nothing but their result.
    scratch: Mutex<Vec<Lease<SampleMeta>>>,
}

/// A compiled path into the messages of one topic.
pub struct Field {
    topic: Arc<Topic>,
    path: FieldPath,
}

/// One message; holds its cell of the ring until dropped.
#[derive(Clone)]
pub struct Sample {
    topic: Arc<Topic>,
    lease: Lease<SampleMeta>,
}

impl Topic {
    /// The topic behind input `input`, whose samples arrive through `reader` and are summed up in `arrivals`.
    pub fn new(
        input: &str,
        topic: &str,
        type_name: &str,
        reader: RingReader<SampleMeta>,
        arrivals: Arc<Arrivals>,
        definitions: Arc<Definitions>,
        images: Images,
    ) -> Arc<Self> {
        Arc::new(Self {
            input: input.to_owned(),
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            header: header_stamp(&definitions),
            reader,
            definitions,
            images,
            skipped: AtomicU64::new(0),
            arrivals,
            looked: Looked::default(),
            scratch: Mutex::default(),
        })
    }

    /// The input's name.
    pub fn name(&self) -> &str {
        &self.input
    }

    /// The ROS topic, as the manifest gives it.
    pub fn ros_topic(&self) -> &str {
        &self.topic
    }

    /// The ROS type, such as `sensor_msgs/msg/Imu`.
    pub fn type_name(&self) -> &str {
        &self.type_name
    }

    /// Newest sample; none before the first.
    pub fn newest(self: &Arc<Self>) -> Option<Sample> {
        let newest = self.reader.newest();
        self.looked.at(newest.as_ref());
        newest.map(|lease| self.sample(lease))
    }

    /// The `n` newest samples, oldest first; at most [`SAMPLES_PER_CALL`].
    pub fn last(self: &Arc<Self>, n: usize) -> Vec<Sample> {
        let mut leases = Vec::new();
        self.reader.last(n.min(SAMPLES_PER_CALL), &mut leases);
        self.looked.at(leases.first());
        leases.into_iter().map(|lease| self.sample(lease)).collect()
    }

    /// Samples received later than `since_ns`, oldest first; the newest [`SAMPLES_PER_CALL`] at most.
    pub fn since(self: &Arc<Self>, since_ns: i64) -> Vec<Sample> {
        let mut leases = Vec::new();
        self.reader.newest_while(SAMPLES_PER_CALL, |meta| meta.at_ns > since_ns, &mut leases);
        self.looked.at(leases.first());
        leases.into_iter().map(|lease| self.sample(lease)).collect()
    }

    /// What became of the samples.
    pub fn counts(&self) -> Counts {
        let RingCounts { received, overwritten, no_slot, too_big } = self.reader.counts();
        let skipped = self.skipped.load(Ordering::Relaxed);
        Counts { received, lost: None, overwritten, no_slot, too_big, skipped }
    }

    /// Compiles a path once, such as `linear_acceleration.x` or `cov[3]`.
    ///
    /// # Errors
    ///
    /// [`DataError::NoSuchField`] names the nearest field.
    pub fn field(self: &Arc<Self>, path: &str) -> Result<Field, DataError> {
        if path.len() > PATH_BYTES {
            let why = format!("has {} bytes; a path has {PATH_BYTES} at most", path.len());
            return Err(DataError::WrongField { path: cut(path, 64).to_owned(), why });
        }
        let path = FieldPath::compile(&self.definitions, path).map_err(DataError::NoSuchField)?;
        Ok(Field { topic: Arc::clone(self), path })
    }

    /// `field` of the `n` newest samples; at most [`COLUMN_LEN`].
    ///
    /// # Errors
    ///
    /// [`DataError::WrongField`] if the field is no number or belongs to another topic; [`DataError::Malformed`].
    pub fn column(self: &Arc<Self>, field: &Field, n: usize) -> Result<Column, DataError> {
        self.read_column(field, |reader, out| reader.last(n.min(COLUMN_LEN), out))
    }

    /// `field` of all samples received later than `since_ns`; at most [`COLUMN_LEN`].
    ///
    /// # Errors
    ///
    /// As [`Topic::column`].
    pub fn column_since(self: &Arc<Self>, field: &Field, since_ns: i64) -> Result<Column, DataError> {
        self.read_column(field, |reader, out| reader.newest_while(COLUMN_LEN, |meta| meta.at_ns > since_ns, out))
    }

    fn read_column(
        self: &Arc<Self>,
        field: &Field,
        select: impl FnOnce(&RingReader<SampleMeta>, &mut Vec<Lease<SampleMeta>>),
    ) -> Result<Column, DataError> {
        field.must_belong_to(self)?;
        let mut leases = self.scratch.lock().unwrap_or_else(PoisonError::into_inner);
        select(&self.reader, &mut leases);
        self.looked.at(leases.first());
        let column = leases.iter().try_fold(Column::with_capacity(leases.len()), |mut column, lease| {
            column.values.push(self.number(&field.path, lease)?);
            column.at_ns.push(lease.meta().at_ns);
            Ok(column)
        });
        // Nothing of the ring may stay pinned between two calls.
        leases.clear();
        column
    }

    fn number(&self, path: &FieldPath, lease: &Lease<SampleMeta>) -> Result<f64, DataError> {
        path.number(lease, lease.meta().endian).map_err(|error| self.unreadable(path, error))
    }

    fn unreadable(&self, path: &FieldPath, error: CdrError) -> DataError {
        match error {
            CdrError::NotANumber => DataError::WrongField {
                path: path.path().to_owned(),
                why: format!("of `{}` is no number", self.type_name),
            },
            source => DataError::Malformed { topic: self.topic.clone(), type_name: self.type_name.clone(), source },
        }
    }

    /// Bytes that a column of `field` over `n` samples may touch, judged by the newest sample; the ring holds no more than
    /// its depth.
    pub fn column_work(&self, field: &Field, n: usize) -> usize {
        let held = usize::try_from(self.reader.head()).unwrap_or(usize::MAX).min(self.reader.depth());
        let message_bytes = self.reader.newest().map_or(0, |lease| lease.len());
        n.min(held).saturating_mul(field.work(message_bytes))
    }

    pub(crate) fn reader(&self) -> &RingReader<SampleMeta> {
        &self.reader
    }

    pub(crate) fn sample(self: &Arc<Self>, lease: Lease<SampleMeta>) -> Sample {
        Sample { topic: Arc::clone(self), lease }
    }

    pub(crate) fn add_skipped(&self, samples: u64) {
        self.skipped.fetch_add(samples, Ordering::Relaxed);
    }

    /// Nanoseconds spent in decoding JPEG and PNG for this topic.
    pub fn decode_ns(&self) -> u64 {
        self.images.decode_ns()
    }
}

impl Field {
    /// Whether elements of varying size lie before it, so that reading it walks over much of a message.
    pub fn walks(&self) -> bool {
        self.path.walks()
    }

    /// Bytes that reading it from a message of `message_bytes` may touch: all of them if elements of varying size lie before it.
    pub fn work(&self, message_bytes: usize) -> usize {
        if self.walks() { message_bytes.max(FIELD_BYTES) } else { FIELD_BYTES }
    }

    /// The path as it was written.
    pub fn path(&self) -> &str {
        self.path.path()
    }

    fn must_belong_to(&self, topic: &Arc<Topic>) -> Result<(), DataError> {
        if Arc::ptr_eq(&self.topic, topic) {
            return Ok(());
        }
        let why = format!("belongs to input `{}`, not to `{}`", self.topic.input, topic.input);
        Err(DataError::WrongField { path: self.path().to_owned(), why })
    }
}

impl Sample {
    /// What makes it different from every other sample.
    pub fn identity(&self) -> Identity {
        let meta = self.lease.meta();
        Identity { topic: self.topic.topic.clone(), writer: meta.writer, seq: meta.seq }
    }

    /// When it came to be.
    pub fn stamps(&self) -> Stamps {
        let meta = self.lease.meta();
        let header_ns = self.topic.header.as_ref().and_then(|header| header.read(&self.lease, meta.endian).ok());
        Stamps { at_ns: meta.at_ns, publish_ns: meta.publish_ns, header_ns }
    }

    /// Any field.
    ///
    /// # Errors
    ///
    /// [`DataError::WrongField`] if the field belongs to another topic or is longer than one call hands out;
    /// [`DataError::Malformed`].
    pub fn get(&self, field: &Field) -> Result<Value<'_>, DataError> {
        field.must_belong_to(&self.topic)?;
        let value = field
            .path
            .read(&self.lease, self.lease.meta().endian)
            .map_err(|error| self.topic.unreadable(&field.path, error))?;
        let (len, max) = match &value {
            Value::Text(text) => (text.len(), BYTES_PER_CALL),
            Value::Bytes(bytes) => (bytes.len(), BYTES_PER_CALL),
            Value::Numbers(numbers) => (numbers.len(), COLUMN_LEN),
            Value::Texts(texts) => (texts.len(), TEXTS_PER_FIELD),
            Value::Bool(_) | Value::Signed(_) | Value::Unsigned(_) | Value::Real(_) => (0, 0),
        };
        if len > max {
            let why = format!("has {len} items, one call hands out {max}; read it with `cdr`");
            return Err(DataError::WrongField { path: field.path().to_owned(), why });
        }
        Ok(value)
    }

    /// A numeric or boolean field.
    ///
    /// # Errors
    ///
    /// As [`Topic::column`].
    pub fn number(&self, field: &Field) -> Result<f64, DataError> {
        field.must_belong_to(&self.topic)?;
        self.topic.number(&field.path, &self.lease)
    }

    /// The whole message as CDR, without the encapsulation header.
    pub fn bytes(&self) -> &[u8] {
        &self.lease
    }

    /// Whether the message is big-endian.
    pub fn big_endian(&self) -> bool {
        self.lease.meta().endian == Endian::Big
    }

    /// Bytes from `offset`, `len` at most, clamped to the message and to [`BYTES_PER_CALL`].
    pub fn cdr(&self, offset: u64, len: u32) -> &[u8] {
        piece(&self.lease, offset, len)
    }

    /// Bytes that [`Sample::as_frame`] would have to decode: by the header, and none if that is done already.
    pub fn undecoded_bytes(&self) -> usize {
        match self.picture() {
            Ok(Picture::Compressed(compressed)) => {
                self.topic.images.undecoded_bytes(self.lease.position(), compressed.data)
            }
            Ok(Picture::Raw(_)) | Err(_) => 0,
        }
    }

    /// The message as an image; JPEG and PNG are decoded now, once for each sample.
    ///
    /// # Errors
    ///
    /// [`DataError::NoImageType`], [`DataError::NotAFrame`], [`DataError::TooLarge`], [`DataError::NoSlot`].
    pub fn as_frame(&self) -> Result<Frame, DataError> {
        Frame::of(self)
    }

    pub(super) fn picture(&self) -> Result<Picture<'_>, DataError> {
        let Topic { topic, type_name, .. } = &*self.topic;
        Picture::of(type_name, &self.lease, self.lease.meta().endian)
            .map_err(|source| DataError::Malformed { topic: topic.clone(), type_name: type_name.clone(), source })?
            .ok_or_else(|| DataError::NoImageType { topic: topic.clone(), type_name: type_name.clone() })
    }

    /// Where it stands in its ring.
    pub(crate) fn position(&self) -> Option<u64> {
        self.lease.position()
    }

    pub(crate) fn meta(&self) -> &SampleMeta {
        self.lease.meta()
    }

    pub(super) fn lease(&self) -> &Lease<SampleMeta> {
        &self.lease
    }

    /// The topic it arrived on.
    pub fn topic(&self) -> &Arc<Topic> {
        &self.topic
    }
}

/// `len` bytes from `offset`, clamped to `bytes` and to [`BYTES_PER_CALL`].
pub(super) fn piece(bytes: &[u8], offset: u64, len: u32) -> &[u8] {
    let start = usize::try_from(offset).unwrap_or(usize::MAX).min(bytes.len());
    let len = (len as usize).min(BYTES_PER_CALL).min(bytes.len() - start);
    &bytes[start..start + len]
}

/// Why a lambda runs.
pub enum Wake {
    /// A new sample on the input that the schedule names.
    Event(Sample),
    /// The period is over.
    Tick(Tick),
}

impl Wake {
    /// Time of the wake, in nanoseconds.
    pub fn at_ns(&self) -> i64 {
        match self {
            Self::Event(sample) => sample.meta().at_ns,
            Self::Tick(tick) => tick.at_ns,
        }
    }
}
