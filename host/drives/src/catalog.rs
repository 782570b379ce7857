//! The topics of a drive: the channels of all its files, merged by name.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, OnceLock};

use super::error::ReplayError;
use super::file::Contents;
use gleaner_base::text::nearest;
use gleaner_messages::{Definitions, Sources, SourcesError};
use gleaner_transport::{DiscoveredTopic, TopicSpec, TransportError, same_type};

/// A topic of all files.
struct DriveTopic {
    type_name: String,
    /// Index of the first file that names the type.
    named_by: usize,
    text: Option<Arc<str>>,
    /// `None` if a file does not have the number.
    messages: Option<u64>,
    /// (file, channel id), in that order.
    channels: Vec<(usize, u16)>,
    /// The unsupported encoding of messages, if there is one.
    foreign: Option<String>,
    /// The unsupported encoding of definitions, if there is one.
    foreign_text: Option<String>,
    /// The QoS of the first channel that states one.
    offered_qos: Option<String>,
    /// Definitions found elsewhere, since the files have none.
    found: OnceLock<Option<Arc<str>>>,
    definitions: OnceLock<Arc<Definitions>>,
}

/// A topic that can be subscribed.
pub(super) struct Selected<'a> {
    /// (file, channel id), in that order.
    pub(super) channels: &'a [(usize, u16)],
    pub(super) messages: Option<u64>,
}

/// All topics.
pub(super) struct Catalog {
    by_name: BTreeMap<String, DriveTopic>,
    /// The sources of definitions that the files do not carry.
    sources: Option<Sources>,
}

impl Catalog {
    pub(super) fn build(
        files: &[(&Path, &Contents)],
        sources: Option<Sources>,
    ) -> Result<Self, ReplayError> {
        let mut topics: BTreeMap<String, DriveTopic> = BTreeMap::new();
        for (file, (path, contents)) in files.iter().enumerate() {
            for (id, channel) in contents.channels.iter() {
                let topic = topics.entry(channel.topic.clone()).or_insert_with(|| DriveTopic {
                    type_name: channel.type_name.clone(),
                    named_by: file,
                    text: None,
                    messages: Some(0),
                    channels: Vec::new(),
                    foreign: None,
                    foreign_text: None,
                    offered_qos: None,
                    found: OnceLock::new(),
                    definitions: OnceLock::new(),
                });
                if !same_type(&topic.type_name, &channel.type_name) {
                    return Err(ReplayError::TypeConflict {
                        topic: channel.topic.clone(),
                        first: files[topic.named_by].0.to_owned(),
                        first_type: topic.type_name.clone(),
                        second: path.to_path_buf(),
                        second_type: channel.type_name.clone(),
                    });
                }
                let messages = contents.messages.get(&id).copied().unwrap_or(0);
                let messages = topic
                    .messages
                    .filter(|_| !contents.uncounted)
                    .map(|known| known.saturating_add(messages));
                topic.messages = messages;
                topic.channels.push((file, id));
                if channel.message_encoding != "cdr" {
                    topic.foreign.get_or_insert_with(|| channel.message_encoding.clone());
                }
                if topic.offered_qos.is_none() {
                    topic.offered_qos.clone_from(&channel.offered_qos);
                }
                match &channel.definitions_text {
                    Some(text) if channel.schema_encoding == "ros2msg" => {
                        topic.text.get_or_insert_with(|| text.clone());
                    }
                    // A writer that does not know a type leaves out its text, and the encoding with
                    // it.
                    None if !channel.type_name.is_empty() => {}
                    _ => {
                        topic.foreign_text.get_or_insert_with(|| channel.schema_encoding.clone());
                    }
                }
            }
        }
        Ok(Self { by_name: topics, sources })
    }

    pub(super) fn topics(&self) -> Vec<DiscoveredTopic> {
        let discovered = |(name, topic): (&String, &DriveTopic)| DiscoveredTopic {
            topic: name.clone(),
            type_name: topic.type_name.clone(),
            // Errors of it are reported when fields are read.
            definitions_text: self.text(name, topic).ok().flatten().cloned(),
            messages: topic.messages,
            offered_qos: topic.offered_qos.clone(),
        };
        self.by_name.iter().map(discovered).collect()
    }

    /// Returns the definitions of a topic's type: those of its files, otherwise those found
    /// elsewhere.
    fn text<'a>(
        &'a self,
        name: &str,
        topic: &'a DriveTopic,
    ) -> Result<Option<&'a Arc<str>>, TransportError> {
        let Some(sources) = self.sources.as_ref().filter(|_| topic.text.is_none()) else {
            return Ok(topic.text.as_ref());
        };
        if topic.found.get().is_none() {
            let found = match sources.find(&topic.type_name) {
                Err(SourcesError::Name { .. }) => None,
                found => found.map_err(|source| TransportError::UnusableDefinitions {
                    topic: name.to_owned(),
                    source: Box::new(source),
                })?,
            };
            // No other thread can have set another text first.
            let _ = topic.found.set(found);
        }
        Ok(topic.found.get().and_then(Option::as_ref))
    }

    /// Returns the channels of a topic, if it matches `spec`.
    pub(super) fn select(&self, spec: &TopicSpec) -> Result<Selected<'_>, TransportError> {
        let topic = self.get(&spec.topic)?;
        if !same_type(&topic.type_name, &spec.type_name) {
            return Err(TransportError::WrongType {
                topic: spec.topic.clone(),
                wanted: spec.type_name.clone(),
                found: topic.type_name.clone(),
            });
        }
        let encoding = |what, found: &String, wanted| {
            Err(TransportError::Encoding {
                topic: spec.topic.clone(),
                what,
                found: found.clone(),
                wanted,
            })
        };
        if let Some(found) = &topic.foreign {
            return encoding("message encoding", found, "cdr");
        }
        if let Some(found) = &topic.foreign_text
            && self.text(&spec.topic, topic)?.is_none()
        {
            return encoding("schema encoding", found, "ros2msg");
        }
        Ok(Selected { channels: &topic.channels, messages: topic.messages })
    }

    pub(super) fn definitions(&self, name: &str) -> Result<Arc<Definitions>, TransportError> {
        let topic = self.get(name)?;
        if let Some(known) = topic.definitions.get() {
            return Ok(known.clone());
        }
        let text = self.text(name, topic)?.ok_or_else(|| TransportError::NoDefinitions {
            topic: name.to_owned(),
            type_name: topic.type_name.clone(),
        })?;
        let parsed = Definitions::parse(&topic.type_name, text)
            .map_err(|source| TransportError::BadDefinitions { topic: name.to_owned(), source })?;
        Ok(topic.definitions.get_or_init(|| Arc::new(parsed)).clone())
    }

    fn get(&self, name: &str) -> Result<&DriveTopic, TransportError> {
        self.by_name.get(name).ok_or_else(|| TransportError::NoSuchTopic {
            topic: name.to_owned(),
            known: self.by_name.keys().cloned().collect(),
            nearest: nearest(name, self.by_name.keys().map(String::as_str)).map(str::to_owned),
        })
    }
}
