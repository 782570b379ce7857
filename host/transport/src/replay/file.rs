//! What one file contains: its channels, and where its messages lie.

use std::collections::HashMap;
use std::sync::Arc;

use tracing::warn;

use super::chunk::Segment;
use super::error::Damage;
use super::records::{Channel, Schema, op};
use crate::transport::Guid;

/// A channel of a file.
pub(super) struct ChannelInfo {
    pub(super) topic: String,
    /// Empty if the channel has no schema.
    pub(super) type_name: String,
    pub(super) message_encoding: String,
    pub(super) schema_encoding: String,
    pub(super) definitions_text: Option<Arc<str>>,
    pub(super) offered_qos: Option<String>,
    /// Who wrote its messages, if the file says so. Clips do.
    pub(super) writer: Option<Guid>,
}

#[cfg(feature = "bags")]
impl ChannelInfo {
    /// What its texts take, without the definitions, which channels share.
    pub(super) fn bytes(&self) -> usize {
        let texts = [&self.topic, &self.type_name, &self.message_encoding, &self.schema_encoding];
        texts.into_iter().chain(&self.offered_qos).map(|text| text.len()).sum()
    }
}

struct SchemaInfo {
    name: String,
    encoding: String,
    text: Option<Arc<str>>,
}

/// The channels of a file, as far as they are known.
#[derive(Default)]
pub(super) struct Channels {
    schemas: HashMap<u16, SchemaInfo>,
    by_id: HashMap<u16, ChannelInfo>,
    /// Bytes of the schemas and channels that were kept.
    bytes: usize,
}

/// What all schemas and channels of a file may take; a drive with a hundred topics has some 100 KiB.
const KNOWN_BYTES: usize = 64 << 20;
/// The longest description of offered qualities of service that is kept; a usual one has 200 bytes.
const QOS_BYTES: usize = 64 << 10;
const TOO_MUCH: Damage = Damage::Malformed("its schemas and channels take more than 64 MiB");

impl Channels {
    pub(super) fn len(&self) -> usize {
        self.by_id.len()
    }

    pub(super) fn get(&self, id: u16) -> Option<&ChannelInfo> {
        self.by_id.get(&id)
    }

    /// All channels by id, so that everything derived from them has one order.
    pub(super) fn iter(&self) -> impl Iterator<Item = (u16, &ChannelInfo)> {
        let mut all: Vec<_> = self.by_id.iter().map(|(id, info)| (*id, info)).collect();
        all.sort_unstable_by_key(|(id, _)| *id);
        all.into_iter()
    }

    /// Adds a channel that a database calls a topic.
    #[cfg(feature = "bags")]
    pub(super) fn add(&mut self, id: u16, info: ChannelInfo) -> Result<(), Damage> {
        self.make_room(info.bytes() + info.definitions_text.as_ref().map_or(0, |text| text.len()))?;
        self.by_id.insert(id, info);
        Ok(())
    }

    pub(super) fn make_room(&mut self, bytes: usize) -> Result<(), Damage> {
        self.bytes = self.bytes.saturating_add(bytes);
        if self.bytes > KNOWN_BYTES { Err(TOO_MUCH) } else { Ok(()) }
    }

    /// Learns from a record; other records are passed over. Writers repeat schemas and channels:
    /// the first of an id counts.
    pub(super) fn learn(&mut self, opcode: u8, body: &[u8]) -> Result<(), Damage> {
        match opcode {
            op::SCHEMA => {
                let schema = Schema::parse(body).ok_or(Damage::Malformed("a schema record is malformed"))?;
                if self.schemas.contains_key(&schema.id) {
                    return Ok(());
                }
                self.make_room(body.len())?;
                self.schemas.entry(schema.id).or_insert_with(|| SchemaInfo {
                    name: schema.name.to_owned(),
                    encoding: schema.encoding.to_owned(),
                    // Comments in other encodings are common and harmless.
                    text: Some(String::from_utf8_lossy(schema.data).trim())
                        .filter(|text| !text.is_empty())
                        .map(Arc::from),
                });
            }
            op::CHANNEL => {
                let channel = Channel::parse(body).ok_or(Damage::Malformed("a channel record is malformed"))?;
                if self.by_id.contains_key(&channel.id) {
                    return Ok(());
                }
                self.make_room(body.len())?;
                let schema = self.schemas.get(&channel.schema);
                if schema.is_none() && channel.schema != 0 {
                    return Err(Damage::Malformed("a channel names a schema that is not defined"));
                }
                let of = |field: fn(&SchemaInfo) -> &String| schema.map(field).cloned();
                let info = ChannelInfo {
                    topic: channel.topic.to_owned(),
                    type_name: of(|schema| &schema.name).unwrap_or_default(),
                    message_encoding: channel.encoding.to_owned(),
                    schema_encoding: of(|schema| &schema.encoding).unwrap_or_default(),
                    definitions_text: schema.and_then(|schema| schema.text.clone()),
                    offered_qos: offered_qos(channel.topic, channel.metadata.get("offered_qos_profiles")),
                    writer: channel.metadata.get("gleaner.writer").and_then(Guid::from_hex),
                };
                self.by_id.insert(channel.id, info);
            }
            _ => {}
        }
        Ok(())
    }
}

/// What rosbag2 notes of a topic's writers; it is nothing to fail over if it cannot be kept.
pub(super) fn offered_qos(topic: &str, found: Option<&str>) -> Option<String> {
    let found = found.filter(|text| !text.is_empty())?;
    if found.len() > QOS_BYTES {
        warn!(topic, bytes = found.len(), "offered_qos_profiles is longer than 64 KiB, passed over");
        return None;
    }
    Some(found.to_owned())
}

/// Everything a scan found out about a file.
#[derive(Default)]
pub(super) struct Contents {
    pub(super) channels: Channels,
    /// In file order.
    pub(super) segments: Vec<Segment>,
    /// Messages per channel: from the summary, or counted.
    pub(super) messages: HashMap<u16, u64>,
    /// Whether nobody counted them.
    pub(super) uncounted: bool,
    /// Whether `messages` is a claim of the summary, to be checked against what is delivered.
    pub(super) claimed: bool,
    /// Where the file is damaged and how; everything in `segments` lies before.
    pub(super) damage: Option<(u64, Damage)>,
    /// First and last log time, in ns, if they are not those of `segments`.
    pub(super) times: Option<(u64, u64)>,
    /// Whether the second of `times` is not the last: that is lost.
    pub(super) is_end_unknown: bool,
}

impl Contents {
    /// First and last log time, in ns.
    pub(super) fn span(&self) -> Option<(u64, u64)> {
        if self.times.is_some() {
            return self.times;
        }
        // A chunk without messages has no times; writers put 0 in both.
        let segments = self.segments.iter().filter(|s| (s.start_time, s.end_time) != (0, 0));
        segments.map(|segment| (segment.start_time, segment.end_time)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }
}
