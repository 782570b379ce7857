//! Implements `gleaner:lambda/data`: samples and fields, as a lambda reads them. Clamps every
//! number that a lambda passes.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_rules::clamps::{self, Length, WrongField};
pub use gleaner_rules::schedule::Tick;
use gleaner_rules::{refused, ring};

pub(crate) use super::frame::Frame;
use super::frame::FramePool;
use super::manifest::{Input, Limits};
use super::message::{ENCAPSULATION, Message};
use super::path::{FieldPath, FieldRef, MissingField, known};
use super::ring::{Cell, Ring};
use super::session::{Handle, HandleCounter, current};
use crate::bindings::gleaner::lambda::types::Column;
use crate::data::{Counts, DataError, Identity, Stamps, Value};

type CallResult<T> = Result<T, DataError>;

impl From<WrongField> for DataError {
    fn from(wrong: WrongField) -> Self {
        Self::WrongField(wrong.to_string())
    }
}

/// Cause of a wake.
pub enum Wake {
    /// A new sample on the input that `[schedule] event` names.
    Event(Sample),
    /// A tick of the `[schedule] period`.
    Tick(Tick),
}

pub(crate) fn input(name: &str) -> CallResult<Topic> {
    let session = current();
    session.check_bytes(name.len());
    let found = session.inputs.iter().find(|source| source.declared.name == name);
    let source = found.cloned().ok_or_else(|| {
        let names = session.inputs.iter().map(|source| source.declared.name.as_str());
        DataError::NoSuchInput(refused::no_such_input(name, names))
    })?;
    let handle = source.handles.acquire();
    Ok(Topic { source, _handle: handle })
}

pub(crate) fn inputs() -> Vec<String> {
    current().inputs.iter().map(|source| source.declared.name.clone()).collect()
}

pub(crate) fn now_ns() -> i64 {
    current().lock().now_ns
}

/// State that all handles of one input share, for the whole run.
pub(crate) struct InputState {
    pub(super) declared: Input,
    pub(super) limits: Limits,
    pub(super) handles: Arc<HandleCounter>,
    pub(super) frame_pool: FramePool,
    /// Default fields of the input's messages, if the test set them.
    pub(super) blank: Option<Message>,
    state: Mutex<InputBuffer>,
}

/// Samples received so far.
pub(super) struct InputBuffer {
    pub(super) ring: Ring,
    pub(super) skipped: u64,
    pub(super) seq: u64,
}

impl InputState {
    pub(super) fn new(
        declared: Input,
        limits: Limits,
        handles: Arc<HandleCounter>,
        frame_pool: FramePool,
        blank: Option<Message>,
    ) -> Arc<Self> {
        let ring = Ring::new(declared.depth, declared.hold, declared.max_size);
        let state = Mutex::new(InputBuffer { ring, skipped: 0, seq: 0 });
        Arc::new(Self { declared, limits, handles, frame_pool, blank, state })
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, InputBuffer> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn counts(&self) -> Counts {
        let InputBuffer { ring: arrived, skipped, .. } = &*self.lock();
        let ring::Counts { received, overwritten, no_slot, too_big } = arrived.counts();
        Counts { received, lost: None, overwritten, no_slot, too_big, skipped: *skipped }
    }

    pub(super) fn sample(self: &Arc<Self>, cell: Arc<Cell>) -> Sample {
        Sample { source: Arc::clone(self), cell, _handle: self.handles.acquire() }
    }

    /// Returns `len` bytes from `offset`, or fewer where `whole` ends. Panics for more than one
    /// call returns, where the host ends the lambda.
    pub(super) fn requested(&self, whole: &[u8], (offset, len): (u64, u32), kind: &str) -> Vec<u8> {
        let (topic, most) = (&self.declared.topic, self.limits.per_call.bytes);
        let piece = clamps::piece(whole.len(), offset, len as usize);
        let bytes = piece.len();
        assert!(
            bytes <= most,
            "{bytes} bytes of a {kind} of `{topic}` are requested; one call returns at most {most}: \
             read it in pieces, by `offset` and `len`"
        );
        whole[piece].to_vec()
    }

    fn malformed(&self, why: &str) -> DataError {
        DataError::Malformed(refused::malformed(
            &self.declared.topic,
            &self.declared.type_name,
            why,
        ))
    }

    fn find<'a>(&self, path: &FieldPath, message: &'a Message) -> CallResult<FieldRef<'a>> {
        path.find(&message.fields).map_err(|missing| match missing {
            MissingField::Element(why) => self.malformed(&why),
            MissingField::Field(known) => {
                let (topic, text) = (&self.declared.topic, &path.text);
                DataError::NoSuchField(format!(
                    "a message that the test delivered to `{topic}` has no field `{text}`{known}"
                ))
            }
        })
    }

    fn number(&self, path: &FieldPath, cell: &Cell) -> CallResult<f64> {
        let found = self.find(path, &cell.sample.message)?;
        found
            .number()
            .ok_or_else(|| WrongField::no_number(&path.text, &self.declared.type_name).into())
    }

    pub(super) fn identity(&self, cell: &Cell) -> Identity {
        Identity {
            topic: self.declared.topic.clone(),
            writer: cell.sample.writer,
            seq: cell.sample.seq,
        }
    }

    pub(super) fn stamps(&self, cell: &Cell) -> Stamps {
        let arrival = &cell.sample;
        Stamps {
            at_ns: arrival.at_ns,
            publish_ns: arrival.publish_ns,
            header_ns: arrival.message.header_ns(),
        }
    }
}

/// The ring of one `[[input]]`.
pub struct Topic {
    source: Arc<InputState>,
    _handle: Handle,
}

/// A path into the messages of one topic.
pub struct Field {
    source: Arc<InputState>,
    path: FieldPath,
    _handle: Handle,
}

/// One message; keeps its cell of the ring.
pub struct Sample {
    pub(super) source: Arc<InputState>,
    pub(super) cell: Arc<Cell>,
    _handle: Handle,
}

impl Topic {
    pub(crate) fn name(&self) -> String {
        self.source.declared.name.clone()
    }

    pub(crate) fn ros_topic(&self) -> String {
        self.source.declared.topic.clone()
    }

    pub(crate) fn type_name(&self) -> String {
        self.source.declared.type_name.clone()
    }

    pub(crate) fn newest(&self) -> Option<Sample> {
        let newest = self.source.lock().ring.newest();
        newest.map(|cell| self.source.sample(cell))
    }

    pub(crate) fn last(&self, n: u32) -> Vec<Sample> {
        self.samples(n as usize, i64::MIN, true)
    }

    pub(crate) fn since(&self, since_ns: i64) -> Vec<Sample> {
        self.samples(usize::MAX, since_ns, false)
    }

    fn samples(&self, most: usize, since_ns: i64, all: bool) -> Vec<Sample> {
        let most = most.min(self.source.limits.per_call.samples());
        let cells =
            self.source.lock().ring.newest_while(most, |arrival| all || arrival.at_ns > since_ns);
        cells.into_iter().map(|cell| self.source.sample(cell)).collect()
    }

    pub(crate) fn counts(&self) -> Counts {
        self.source.counts()
    }

    pub(crate) fn field(&self, path: &str) -> CallResult<Field> {
        clamps::path(path)?;
        let path = FieldPath::new(path)
            .map_err(|malformed| DataError::NoSuchField(malformed.to_string()))?;
        if let Some(blank) = &self.source.blank
            && let Err(MissingField::Field(known)) = path.find(&blank.fields)
        {
            let type_name = &self.source.declared.type_name;
            let why = format!(
                "type `{type_name}`, as the test defines it, has no field `{}`{known}",
                path.text
            );
            return Err(DataError::NoSuchField(why));
        }
        Ok(Field { source: Arc::clone(&self.source), path, _handle: self.source.handles.acquire() })
    }

    pub(crate) fn column(&self, field: &Field, n: u32) -> CallResult<Column> {
        self.read_column(field, n as usize, |_| true)
    }

    pub(crate) fn column_since(&self, field: &Field, since_ns: i64) -> CallResult<Column> {
        self.read_column(field, usize::MAX, |at_ns| at_ns > since_ns)
    }

    fn read_column(
        &self,
        field: &Field,
        most: usize,
        keep: impl Fn(i64) -> bool,
    ) -> CallResult<Column> {
        let source = &self.source;
        let path = field.of(source)?;
        let most = most.min(source.limits.per_call.items);
        let cells = source.lock().ring.newest_while(most, |arrival| keep(arrival.at_ns));
        let values =
            cells.iter().map(|cell| source.number(path, cell)).collect::<CallResult<_>>()?;
        Ok(Column { at_ns: cells.iter().map(|cell| cell.sample.at_ns).collect(), values })
    }
}

impl Field {
    pub(crate) fn path(&self) -> String {
        self.path.text.clone()
    }

    fn of(&self, source: &Arc<InputState>) -> CallResult<&FieldPath> {
        if Arc::ptr_eq(&self.source, source) {
            return Ok(&self.path);
        }
        Err(WrongField::elsewhere(
            &self.path.text,
            &self.source.declared.name,
            &source.declared.name,
        )
        .into())
    }
}

impl Sample {
    pub(crate) fn identity(&self) -> Identity {
        self.source.identity(&self.cell)
    }

    pub(crate) fn stamps(&self) -> Stamps {
        self.source.stamps(&self.cell)
    }

    pub(crate) fn get(&self, field: &Field) -> CallResult<Value> {
        let path = field.of(&self.source)?;
        let found = self.source.find(path, &self.cell.sample.message)?;
        let length = match found.value() {
            Value::Text(text) => Length::Text(text.len()),
            Value::Bytes(bytes) => Length::Bytes(bytes.len()),
            Value::Numbers(numbers) => Length::Numbers(numbers.len()),
            Value::Texts(texts) => Length::Texts(texts.len()),
            Value::Boolean(_) | Value::Signed(_) | Value::Unsigned(_) | Value::Real(_) => {
                Length::One
            }
        };
        self.source.limits.per_call.value(&path.text, length)?;
        Ok(found.value().clone())
    }

    pub(crate) fn number(&self, field: &Field) -> CallResult<f64> {
        self.source.number(field.of(&self.source)?, &self.cell)
    }

    pub(crate) fn size(&self) -> u64 {
        self.bytes().len() as u64
    }

    pub(crate) fn big_endian(&self) -> bool {
        self.encapsulated()[1] & 1 == 0
    }

    pub(crate) fn cdr(&self, offset: u64, len: u32) -> Vec<u8> {
        self.source.requested(self.bytes(), (offset, len), "sample")
    }

    pub(crate) fn as_frame(&self) -> CallResult<Frame> {
        Frame::of(self)
    }

    fn bytes(&self) -> &[u8] {
        &self.encapsulated()[ENCAPSULATION..]
    }

    /// Returns the message as CDR.
    ///
    /// # Panics
    ///
    /// If the test set no bytes: no value would be right, and the interface has no error for it.
    fn encapsulated(&self) -> &[u8] {
        self.cell.sample.message.cdr.as_deref().unwrap_or_else(|| {
            let topic = &self.source.declared.topic;
            panic!(
                "a message that the test delivered to `{topic}` has no bytes; set them with \
                 `Message::cdr`"
            )
        })
    }

    /// Returns a field that an image must have.
    pub(super) fn need<'a>(&'a self, path: &str) -> CallResult<&'a Value> {
        let fields = &self.cell.sample.message.fields;
        let why = || {
            format!("it has no `{path}`{}; create it with `Message::image`", known(path, fields))
        };
        fields.get(path).ok_or_else(|| self.source.malformed(&why()))
    }

    pub(super) fn wrong_type(&self, path: &str) -> DataError {
        self.source
            .malformed(&format!("`{path}` has another type; create it with `Message::image`"))
    }
}
