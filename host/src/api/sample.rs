//! One message, as a lambda reads it: fields, bytes, stamps, and its image if it is one.

use std::sync::Arc;

use gleaner_buffers::Lease;
use gleaner_messages::transport::{SampleMeta, StoredMeta};
use gleaner_messages::{Endian, MessageValue};
use gleaner_rules::clamps::Length;

use super::data::{DataError, Field, Topic};
use super::frame::Frame;
use super::images::ImageMessage;
use super::shared_bytes::SharedBytes;
use super::values::{Identity, Stamps};

/// One message; holds its slot of the ring until dropped.
#[derive(Clone)]
pub struct Sample {
    topic: Arc<Topic>,
    lease: Lease<StoredMeta>,
}

impl Sample {
    /// The message of `topic` in this slot of its ring.
    pub(super) fn new(topic: Arc<Topic>, lease: Lease<StoredMeta>) -> Self {
        Self { topic, lease }
    }

    pub fn identity(&self) -> Identity {
        let meta = self.meta();
        Identity { topic: self.topic.topic.clone(), writer: meta.writer, seq: meta.seq }
    }

    pub fn stamps(&self) -> Stamps {
        let meta = self.meta();
        let header = self.topic.headers.get(usize::from(self.layout())).and_then(Option::as_ref);
        let header_ns = header.and_then(|header| header.read(&self.lease, meta.endian).ok());
        Stamps { at_ns: meta.at_ns, publish_ns: meta.publish_ns, header_ns }
    }

    /// Returns the value of any field.
    ///
    /// # Errors
    ///
    /// [`DataError::WrongField`] if the field belongs to another topic or is longer than one call
    /// may return; [`DataError::Malformed`].
    pub fn get(&self, field: &Field) -> Result<MessageValue<'_>, DataError> {
        // A path may require parsing the whole message, and the value may be most of it.
        self.topic.per_call.charge(|| self.lease.len())?;
        field.must_belong_to(&self.topic)?;
        let value = field
            .path
            .in_layout(self.layout())
            .and_then(|path| path.read(&self.lease, self.meta().endian))
            .map_err(|error| self.topic.unreadable(&field.path, error))?;
        if let Some(number) = number(&value) {
            field.draw(self.meta().at_ns, number);
        }
        let length = match &value {
            MessageValue::Text(text) => Length::Text(text.len()),
            MessageValue::Bytes(bytes) => Length::Bytes(bytes.len()),
            MessageValue::Numbers(numbers) => Length::Numbers(numbers.len()),
            MessageValue::Texts(texts) => Length::Texts(texts.len()),
            MessageValue::Bool(_)
            | MessageValue::Signed(_)
            | MessageValue::Unsigned(_)
            | MessageValue::Real(_) => Length::One,
        };
        self.topic.per_call.clamps().value(field.path(), length)?;
        Ok(value)
    }

    /// Returns the value of a numeric or boolean field. Fails as [`Topic::column`].
    pub fn number(&self, field: &Field) -> Result<f64, DataError> {
        self.topic.per_call.charge(|| field.work(self.lease.len()))?;
        field.must_belong_to(&self.topic)?;
        let number = self.topic.number(&field.path, &self.lease, self.lease.meta())?;
        field.draw(self.meta().at_ns, number);
        Ok(number)
    }

    /// The whole message as CDR, without the encapsulation header.
    pub fn bytes(&self) -> &[u8] {
        &self.lease
    }

    pub fn big_endian(&self) -> bool {
        self.meta().endian == Endian::Big
    }

    /// Bytes from `offset`: `len`, or fewer where the message ends.
    ///
    /// # Errors
    ///
    /// [`DataError::TooLong`] for more than `call_bytes` of `[limits]`; [`DataError::OutOfFuel`].
    pub fn cdr(&self, offset: u64, len: u32) -> Result<SharedBytes, DataError> {
        let message = SharedBytes::of_message(&self.lease);
        self.topic.per_call.piece(&message, (offset, len), "sample", &self.topic.topic)
    }

    /// Work of [`Sample::as_frame`] in bytes, estimated by the header of the image; 0 if it is
    /// decoded already.
    fn decode_work(&self) -> usize {
        match self.picture() {
            Ok(ImageMessage::Compressed(compressed)) => {
                self.topic.images.decode_work(self.lease.position(), &compressed)
            }
            Ok(ImageMessage::Raw(_)) | Err(_) => 0,
        }
    }

    /// Returns the message as an image; JPEG and PNG are decoded now, once for each sample.
    ///
    /// # Errors
    ///
    /// [`DataError::NoImageType`], [`DataError::NotAFrame`], [`DataError::TooLarge`],
    /// [`DataError::NoSlot`], [`DataError::NoRoom`].
    pub fn as_frame(&self) -> Result<Frame, DataError> {
        self.topic.per_call.charge(|| self.decode_work())?;
        Frame::of(self)
    }

    pub(super) fn picture(&self) -> Result<ImageMessage<'_>, DataError> {
        let Topic { topic, type_name, .. } = &*self.topic;
        if self.topic.has_other_layout {
            let type_name = format!("{type_name}, with other fields than in ROS 2");
            return Err(DataError::NoImageType { topic: topic.clone(), type_name });
        }
        ImageMessage::of(type_name, &self.lease, self.meta().endian)
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

    pub(crate) fn position(&self) -> Option<u64> {
        self.lease.position()
    }

    /// Number of its layout among those of the definitions.
    fn layout(&self) -> u16 {
        self.topic.live_layout.number_of(self.meta())
    }

    pub(crate) fn meta(&self) -> &SampleMeta {
        &self.lease.meta().sample
    }

    /// Its metadata, with the sums up to it.
    pub(crate) fn stored(&self) -> &StoredMeta {
        self.lease.meta()
    }

    pub(super) fn lease(&self) -> &Lease<StoredMeta> {
        &self.lease
    }

    pub fn topic(&self) -> &Arc<Topic> {
        &self.topic
    }
}

/// Converts a value to a number, like [`Sample::number`]; `None` if it is none.
fn number(value: &MessageValue<'_>) -> Option<f64> {
    match value {
        MessageValue::Bool(value) => Some(f64::from(u8::from(*value))),
        MessageValue::Signed(value) => Some(*value as f64),
        MessageValue::Unsigned(value) => Some(*value as f64),
        MessageValue::Real(value) => Some(*value),
        MessageValue::Text(_)
        | MessageValue::Bytes(_)
        | MessageValue::Numbers(_)
        | MessageValue::Texts(_) => None,
    }
}
