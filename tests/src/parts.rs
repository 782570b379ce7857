//! Takes clips apart and reassembles them, so that a test can change any part.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;

use gleaner_lambda::Clip;
use mcap::records::{MessageHeader, Metadata, Record};
use mcap::{Attachment, Channel};

#[derive(Clone)]
pub struct ClipAttachment {
    pub name: String,
    pub media_type: String,
    pub log_time: u64,
    pub data: Vec<u8>,
}

/// A message, with the index of its channel.
pub type ClipMessage = (usize, MessageHeader, Vec<u8>);

#[derive(Clone)]
pub struct ClipParts {
    pub metadata: Vec<Metadata>,
    pub channels: Vec<Arc<Channel<'static>>>,
    /// Its messages, each with the index of its channel.
    pub messages: Vec<ClipMessage>,
    pub attachments: Vec<ClipAttachment>,
}

impl ClipParts {
    /// Takes the clip `path` apart.
    pub fn of(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap();
        let mut parts =
            Self { metadata: vec![], channels: vec![], messages: vec![], attachments: vec![] };
        let (mut schemas, mut indexes) = (BTreeMap::new(), BTreeMap::new());
        for record in mcap::read::ChunkFlattener::new(&bytes).unwrap() {
            match record.unwrap() {
                Record::Schema { header, data } => {
                    let data = Cow::Owned(data.into_owned());
                    let schema = mcap::Schema {
                        id: header.id,
                        name: header.name,
                        encoding: header.encoding,
                        data,
                    };
                    schemas.insert(header.id, Arc::new(schema));
                }
                // The summary repeats the channels.
                Record::Channel(channel) if !indexes.contains_key(&channel.id) => {
                    indexes.insert(channel.id, parts.channels.len());
                    parts.channels.push(Arc::new(Channel {
                        id: channel.id,
                        topic: channel.topic,
                        schema: schemas.get(&channel.schema_id).cloned(),
                        message_encoding: channel.message_encoding,
                        metadata: channel.metadata,
                    }));
                }
                Record::Message { header, data } => {
                    parts.messages.push((indexes[&header.channel_id], header, data.into_owned()));
                }
                Record::Metadata(metadata) => parts.metadata.push(metadata),
                Record::Attachment { header, data, .. } => parts.attachments.push(ClipAttachment {
                    name: header.name,
                    media_type: header.media_type,
                    log_time: header.log_time,
                    data: data.into_owned(),
                }),
                _ => {}
            }
        }
        parts
    }

    /// Reassembles the clip with correct checksums.
    pub fn bytes(&self) -> Vec<u8> {
        let mut file = Cursor::new(Vec::new());
        let mut writer = mcap::WriteOptions::new().profile("ros2").create(&mut file).unwrap();
        self.metadata.iter().for_each(|metadata| writer.write_metadata(metadata).unwrap());
        let mut ids = Vec::new();
        for channel in &self.channels {
            let schema = channel.schema.as_ref().unwrap();
            let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data).unwrap();
            ids.push(
                writer
                    .add_channel(
                        schema,
                        &channel.topic,
                        &channel.message_encoding,
                        &channel.metadata,
                    )
                    .unwrap(),
            );
        }
        for (channel, header, data) in &self.messages {
            let header = MessageHeader { channel_id: ids[*channel], ..*header };
            writer.write_to_known_channel(&header, data).unwrap();
        }
        for ClipAttachment { name, media_type, log_time, data } in &self.attachments {
            let (name, media_type, data) =
                (name.clone(), media_type.clone(), Cow::Borrowed(&data[..]));
            let attachment =
                Attachment { log_time: *log_time, create_time: *log_time, name, media_type, data };
            writer.attach(&attachment).unwrap();
        }
        writer.finish().unwrap();
        drop(writer);
        file.into_inner()
    }

    /// The first record `gleaner.NAME`.
    pub fn record(&mut self, name: &str) -> &mut BTreeMap<String, String> {
        let record =
            self.metadata.iter_mut().find(|metadata| metadata.name == format!("gleaner.{name}"));
        &mut record.unwrap_or_else(|| panic!("no record gleaner.{name}")).metadata
    }

    pub fn topic(&mut self, topic: &str) -> &mut BTreeMap<String, String> {
        let is_it =
            |metadata: &&mut Metadata| metadata.metadata.get("topic").is_some_and(|of| of == topic);
        &mut self.metadata.iter_mut().find(is_it).unwrap().metadata
    }

    pub fn change_line(&mut self, change: impl FnOnce(&mut Clip)) {
        let record = self.record("clip");
        let mut line = serde_json::from_str(&record["line"]).unwrap();
        change(&mut line);
        record.insert("line".to_owned(), serde_json::to_string(&line).unwrap());
    }

    pub fn channel_of(&self, topic: &str) -> usize {
        self.channels.iter().position(|channel| channel.topic == topic).unwrap()
    }

    pub fn messages_of(&mut self, topic: &str) -> Vec<&mut ClipMessage> {
        let channels: Vec<_> = self.channels.iter().map(|channel| channel.topic == topic).collect();
        self.messages.iter_mut().filter(|(channel, ..)| channels[*channel]).collect()
    }

    pub fn drop_messages_of(&mut self, topic: &str) {
        let channels: Vec<_> = self.channels.iter().map(|channel| channel.topic == topic).collect();
        self.messages.retain(|(channel, ..)| !channels[*channel]);
    }

    pub fn journal(&mut self) -> &mut ClipAttachment {
        self.attachments
            .iter_mut()
            .find(|attachment| attachment.name.starts_with("journal/"))
            .unwrap()
    }
}
