//! One message, as a lambda reads it: fields, bytes, stamps, and its picture if it is one.

use std::sync::Arc;

use gleaner_buffers::Lease;
use gleaner_messages::{Endian, Value};
use gleaner_rules::clamps::Length;
use gleaner_transport::SampleMeta;

use super::data::{DataError, Field, OutOfFuel, Topic};
use super::frame::{Frame, Picture};
use super::piece::Piece;
use super::values::{Identity, Stamps};

/// One message; holds its cell of the ring until dropped.
#[derive(Clone)]
pub struct Sample {
    topic: Arc<Topic>,
    lease: Lease<SampleMeta>,
}

impl Sample {
    /// The message of `topic` in this cell of its ring.
    pub(super) fn new(topic: Arc<Topic>, lease: Lease<SampleMeta>) -> Self {
        Self { topic, lease }
    }

    /// What makes it different from every other sample.
    pub fn identity(&self) -> Identity {
        let meta = self.lease.meta();
        Identity { topic: self.topic.topic.clone(), writer: meta.writer, seq: meta.seq }
    }

    /// When it came to be.
    pub fn stamps(&self) -> Stamps {
        let meta = self.lease.meta();
        let header_ns = self
            .topic
            .header
            .as_ref()
            .and_then(|header| header.read(&self.lease, meta.endian).ok());
        Stamps { at_ns: meta.at_ns, publish_ns: meta.publish_ns, header_ns }
    }

    /// Any field.
    ///
    /// # Errors
    ///
    /// [`DataError::WrongField`] if the field belongs to another topic or is longer than one call
    /// hands out; [`DataError::Malformed`].
    pub fn get(&self, field: &Field) -> Result<Value<'_>, DataError> {
        // A path may walk over the whole message, and the value may be most of it.
        self.topic.per_call.charge(|| self.lease.len())?;
        field.must_belong_to(&self.topic)?;
        let value = field
            .path
            .read(&self.lease, self.lease.meta().endian)
            .map_err(|error| self.topic.unreadable(&field.path, error))?;
        if let Some(number) = number(&value) {
            field.draw(self.lease.meta().at_ns, number);
        }
        let length = match &value {
            Value::Text(text) => Length::Text(text.len()),
            Value::Bytes(bytes) => Length::Bytes(bytes.len()),
            Value::Numbers(numbers) => Length::Numbers(numbers.len()),
            Value::Texts(texts) => Length::Texts(texts.len()),
            Value::Bool(_) | Value::Signed(_) | Value::Unsigned(_) | Value::Real(_) => Length::One,
        };
        self.topic.per_call.clamps().value(field.path(), length)?;
        Ok(value)
    }

    /// A numeric or boolean field.
    ///
    /// # Errors
    ///
    /// As [`Topic::column`].
    pub fn number(&self, field: &Field) -> Result<f64, DataError> {
        self.topic.per_call.charge(|| field.work(self.lease.len()))?;
        field.must_belong_to(&self.topic)?;
        let number = self.topic.number(&field.path, &self.lease)?;
        field.draw(self.lease.meta().at_ns, number);
        Ok(number)
    }

    /// The whole message as CDR, without the encapsulation header.
    pub fn bytes(&self) -> &[u8] {
        &self.lease
    }

    /// Whether the message is big-endian.
    pub fn big_endian(&self) -> bool {
        self.lease.meta().endian == Endian::Big
    }

    /// Bytes from `offset`, `len` at most, clamped to the message and to `call_bytes` of
    /// `[limits]`.
    ///
    /// # Errors
    ///
    /// [`OutOfFuel`].
    pub fn cdr(&self, offset: u64, len: u32) -> Result<Piece, OutOfFuel> {
        let per_call = &self.topic.per_call;
        let piece = Piece::of_message(&self.lease).part(offset, per_call.bytes.min(len as usize));
        per_call.charge(|| piece.len())?;
        Ok(piece)
    }

    /// Work of [`Sample::as_frame`], by the header of what it has to decode, in bytes; none if that
    /// is done already.
    fn decode_work(&self) -> usize {
        match self.picture() {
            Ok(Picture::Compressed(compressed)) => {
                self.topic.images.decode_work(self.lease.position(), compressed.data)
            }
            Ok(Picture::Raw(_)) | Err(_) => 0,
        }
    }

    /// The message as an image; JPEG and PNG are decoded now, once for each sample.
    ///
    /// # Errors
    ///
    /// [`DataError::NoImageType`], [`DataError::NotAFrame`], [`DataError::TooLarge`],
    /// [`DataError::NoSlot`], [`DataError::NoRoom`].
    pub fn as_frame(&self) -> Result<Frame, DataError> {
        self.topic.per_call.charge(|| self.decode_work())?;
        Frame::of(self)
    }

    pub(super) fn picture(&self) -> Result<Picture<'_>, DataError> {
        let Topic { topic, type_name, .. } = &*self.topic;
        Picture::of(type_name, &self.lease, self.lease.meta().endian)
            .map_err(|source| DataError::Malformed {
                topic: topic.clone(),
                type_name: type_name.clone(),
                source,
            })?
            .ok_or_else(|| DataError::NoImageType {
                topic: topic.clone(),
                type_name: type_name.clone(),
            })
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

/// A single number, as [`Sample::number`] gives it.
fn number(value: &Value<'_>) -> Option<f64> {
    match value {
        Value::Bool(value) => Some(f64::from(u8::from(*value))),
        Value::Signed(value) => Some(*value as f64),
        Value::Unsigned(value) => Some(*value as f64),
        Value::Real(value) => Some(*value),
        Value::Text(_) | Value::Bytes(_) | Value::Numbers(_) | Value::Texts(_) => None,
    }
}
