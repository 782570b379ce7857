//! Content of a file: its channels, and the positions of its messages.

use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::Arc;

use tracing::warn;

use crate::damage::Damage;
use crate::records::{McapChannel, McapSchema, op};
use gleaner_messages::transport::Guid;

pub struct ChannelInfo {
    pub topic: String,
    /// Empty if the channel has no schema.
    pub type_name: String,
    pub message_encoding: String,
    pub schema_encoding: String,
    pub definitions_text: Option<Arc<str>>,
    pub offered_qos: Option<String>,
    /// The writer of its messages, if the file names it. Clips do.
    pub writer: Option<Guid>,
    /// True for samples from before a clip. Clips state it.
    pub is_latched: bool,
    /// RIHS01 of its type, as its writer announced it.
    pub type_hash: Option<String>,
    /// The reason why the layout of its messages is unknown, although definitions were found.
    pub unknown_layout: Option<&'static str>,
}

#[cfg(feature = "bags")]
impl ChannelInfo {
    /// Returns the size of its texts, without the definitions, which channels share.
    pub fn bytes(&self) -> usize {
        let texts = [&self.topic, &self.type_name, &self.message_encoding, &self.schema_encoding];
        texts
            .into_iter()
            .chain(&self.offered_qos)
            .chain(&self.type_hash)
            .map(|text| text.len())
            .sum()
    }
}

struct SchemaInfo {
    name: String,
    encoding: String,
    text: Option<Arc<str>>,
}

/// The channels of a file that are known so far.
#[derive(Default)]
pub struct Channels {
    schemas: HashMap<u16, SchemaInfo>,
    by_id: HashMap<u16, ChannelInfo>,
    /// Size in bytes of the schemas and channels that were kept.
    bytes: usize,
}

/// Size limit of all schemas and channels of a file; a drive with a hundred topics has some 100
/// KiB.
const KNOWN_BYTES: usize = 64 << 20;
/// Length limit of an offered QoS that is kept; a usual one has 200 bytes.
const QOS_BYTES: usize = 64 << 10;
/// Length limit of a name of the file in an error.
const SHOWN_CHARS: usize = 100;
const TOO_MUCH: Damage = Damage::Malformed("its schemas and channels take more than 64 MiB");

impl Channels {
    pub fn len(&self) -> usize {
        self.by_id.len()
    }

    pub fn get(&self, id: u16) -> Option<&ChannelInfo> {
        self.by_id.get(&id)
    }

    /// Returns all channels by id, so that everything derived from them has one order.
    pub fn iter(&self) -> impl Iterator<Item = (u16, &ChannelInfo)> {
        let mut all: Vec<_> = self.by_id.iter().map(|(id, info)| (*id, info)).collect();
        all.sort_unstable_by_key(|(id, _)| *id);
        all.into_iter()
    }

    #[cfg(feature = "bags")]
    pub fn add(&mut self, id: u16, info: ChannelInfo) -> Result<(), Damage> {
        self.make_room(info.bytes() + info.definitions_text.as_ref().map_or(0, |text| text.len()))?;
        self.by_id.insert(id, info);
        Ok(())
    }

    pub fn make_room(&mut self, bytes: usize) -> Result<(), Damage> {
        self.bytes = self.bytes.saturating_add(bytes);
        if self.bytes > KNOWN_BYTES { Err(TOO_MUCH) } else { Ok(()) }
    }

    /// Adds a schema or channel record; other records are skipped. Writers repeat schemas and
    /// channels, always with the same content: a different repetition is damage, since messages
    /// would change their topic or their type.
    pub fn learn(&mut self, opcode: u8, body: &[u8]) -> Result<(), Damage> {
        match opcode {
            op::SCHEMA => {
                let schema = schema_of(body)?;
                if let Some(known) = self.schemas.get(&schema.id) {
                    return known.check(&schema);
                }
                self.make_room(body.len())?;
                self.schemas.insert(schema.id, SchemaInfo::of(&schema));
            }
            op::CHANNEL => {
                let channel = channel_of(body)?;
                if let Some(known) = self.by_id.get(&channel.id) {
                    return self.check_channel(known, &channel);
                }
                self.make_room(body.len())?;
                let schema = self.schema_of_channel(&channel)?;
                let of = |field: fn(&SchemaInfo) -> &String| schema.map(field).cloned();
                let info = ChannelInfo {
                    topic: channel.topic.to_owned(),
                    type_name: of(|schema| &schema.name).unwrap_or_default(),
                    message_encoding: channel.encoding.to_owned(),
                    schema_encoding: of(|schema| &schema.encoding).unwrap_or_default(),
                    definitions_text: schema.and_then(|schema| schema.text.clone()),
                    offered_qos: offered_qos(
                        channel.topic,
                        channel.metadata.get("offered_qos_profiles"),
                    ),
                    writer: channel.metadata.get("gleaner.writer").and_then(Guid::from_hex),
                    is_latched: channel.metadata.get("gleaner.latched").is_some(),
                    type_hash: channel.metadata.get("topic_type_hash").map(str::to_owned),
                    unknown_layout: None,
                };
                self.by_id.insert(channel.id, info);
            }
            _ => {}
        }
        Ok(())
    }

    /// Compares a record with known ones; other records, and unknown schemas and channels, are
    /// skipped.
    pub fn check(&self, opcode: u8, body: &[u8]) -> Result<(), Damage> {
        match opcode {
            op::SCHEMA => {
                let schema = schema_of(body)?;
                self.schemas.get(&schema.id).map_or(Ok(()), |known| known.check(&schema))
            }
            op::CHANNEL => {
                let channel = channel_of(body)?;
                self.by_id
                    .get(&channel.id)
                    .map_or(Ok(()), |known| self.check_channel(known, &channel))
            }
            _ => Ok(()),
        }
    }

    fn check_channel(&self, known: &ChannelInfo, again: &McapChannel<'_>) -> Result<(), Damage> {
        let redefined =
            |field, first, second| redefined("channel", again.id, field, Some((first, second)));
        if known.topic != again.topic {
            return redefined("topic", &known.topic, again.topic);
        }
        if known.message_encoding != again.encoding {
            return redefined("message encoding", &known.message_encoding, again.encoding);
        }
        let (type_name, encoding, text) = match self.schema_of_channel(again)? {
            Some(schema) => (schema.name.as_str(), schema.encoding.as_str(), schema.text.as_ref()),
            None => ("", "", None),
        };
        if known.type_name != type_name {
            return redefined("type", &known.type_name, type_name);
        }
        if known.schema_encoding != encoding {
            return redefined("schema encoding", &known.schema_encoding, encoding);
        }
        match known.definitions_text.as_ref() == text {
            true => Ok(()),
            false => self::redefined("channel", again.id, "definition of its type", None),
        }
    }

    /// Returns the schema of a channel; id 0 means none.
    fn schema_of_channel(&self, channel: &McapChannel<'_>) -> Result<Option<&SchemaInfo>, Damage> {
        match self.schemas.get(&channel.schema) {
            None if channel.schema != 0 => {
                Err(Damage::Malformed("a channel names a schema that is not defined"))
            }
            schema => Ok(schema),
        }
    }
}

impl SchemaInfo {
    fn of(schema: &McapSchema<'_>) -> Self {
        let text = definitions(schema);
        let (name, encoding) = (schema.name.to_owned(), schema.encoding.to_owned());
        Self {
            name,
            encoding,
            text: Some(text.trim()).filter(|text| !text.is_empty()).map(Arc::from),
        }
    }

    fn check(&self, again: &McapSchema<'_>) -> Result<(), Damage> {
        let redefined = |field, values| redefined("schema", again.id, field, values);
        if self.name != again.name {
            return redefined("name", Some((&self.name, again.name)));
        }
        if self.encoding != again.encoding {
            return redefined("encoding", Some((&self.encoding, again.encoding)));
        }
        match self.text.as_deref().unwrap_or_default() == definitions(again).trim() {
            true => Ok(()),
            false => redefined("text", None),
        }
    }
}

/// Returns the text of a schema. Comments in other encodings than UTF-8 are common and harmless.
fn definitions<'a>(schema: &McapSchema<'a>) -> Cow<'a, str> {
    String::from_utf8_lossy(schema.data)
}

fn schema_of(body: &[u8]) -> Result<McapSchema<'_>, Damage> {
    McapSchema::parse(body).ok_or(Damage::Malformed("a schema record is malformed"))
}

fn channel_of(body: &[u8]) -> Result<McapChannel<'_>, Damage> {
    McapChannel::parse(body).ok_or(Damage::Malformed("a channel record is malformed"))
}

fn redefined(
    what: &'static str,
    id: u16,
    field: &'static str,
    values: Option<(&str, &str)>,
) -> Result<(), Damage> {
    let shown = |text: &str| text.chars().take(SHOWN_CHARS).collect();
    Err(Damage::Redefined {
        what,
        id,
        field,
        values: values.map(|(first, second)| Box::new([shown(first), shown(second)])),
    })
}

/// Returns the QoS of a topic's writers as rosbag2 wrote it; one that is too long is skipped.
pub fn offered_qos(topic: &str, found: Option<&str>) -> Option<String> {
    let found = found.filter(|text| !text.is_empty())?;
    if found.len() > QOS_BYTES {
        warn!(topic, bytes = found.len(), "offered_qos_profiles is longer than 64 KiB; skipped");
        return None;
    }
    Some(found.to_owned())
}

/// Position of a chunk, or of a run of messages outside chunks, in a file.
pub struct FileSegment {
    /// Offset of the head of the first record.
    pub offset: u64,
    /// Length of all its records, including their heads.
    pub len: u64,
    pub start_time: u64,
    pub end_time: u64,
    pub kind: SegmentKind,
    /// The channels with messages in it, if known.
    pub channels: Option<Box<[u16]>>,
}

#[derive(Copy, Clone, PartialEq, Eq)]
pub enum SegmentKind {
    Chunk,
    Run,
}

#[derive(Default)]
pub struct Contents {
    pub channels: Channels,
    /// In file order.
    pub segments: Vec<FileSegment>,
    /// Number of messages per channel: from the summary, or counted.
    pub messages: HashMap<u16, u64>,
    /// Set if they are unknown.
    pub uncounted: bool,
    /// Set if `messages` is a claim of the summary, to be checked against the delivered messages.
    pub claimed: bool,
    /// Damage and its position; all `segments` are before it.
    pub damage: Option<(u64, Damage)>,
    /// First and last log time, in ns, if not those of `segments`.
    pub times: Option<(u64, u64)>,
    /// Set if the last log time is lost; then the second of `times` is not the last.
    pub is_end_unknown: bool,
}

impl Contents {
    /// Returns the first and last log time, in ns; times beyond the year 2262 are none.
    pub fn span(&self) -> Option<(u64, u64)> {
        if self.times.is_some() {
            return self.times;
        }
        // A chunk without messages has no times; writers put 0 in both.
        let segments = self.segments.iter().filter(|s| (s.start_time, s.end_time) != (0, 0));
        segments
            .map(|segment| (segment.start_time, segment.end_time))
            .reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }
}
