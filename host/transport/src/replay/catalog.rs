//! The topics of a drive: the channels of all its files, brought together by name.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, OnceLock};

use super::error::ReplayError;
use super::file::{ChannelInfo, Contents};
use crate::message::Definitions;
use crate::nearest::nearest;
use crate::transport::{DiscoveredTopic, TopicSpec, TransportError, same_type};

/// A topic, over all files.
struct Topic {
    type_name: String,
    /// Index of the file that named the type first.
    named_by: usize,
    text: Option<Arc<str>>,
    messages: u64,
    /// (file, channel id), in that order.
    channels: Vec<(usize, u16)>,
    /// What is encoded in a way we do not read, and how.
    foreign: Option<(&'static str, String, &'static str)>,
    /// Of the first channel that has it.
    offered_qos: Option<String>,
    definitions: OnceLock<Arc<Definitions>>,
}

/// A topic that may be subscribed.
pub(super) struct Selected<'a> {
    /// (file, channel id), in that order.
    pub(super) channels: &'a [(usize, u16)],
    pub(super) messages: u64,
}

/// All topics by name.
pub(super) struct Catalog(BTreeMap<String, Topic>);

impl Catalog {
    pub(super) fn build(files: &[(&Path, &Contents)]) -> Result<Self, ReplayError> {
        let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
        for (file, (path, contents)) in files.iter().enumerate() {
            for (id, channel) in contents.channels.iter() {
                let topic = topics.entry(channel.topic.clone()).or_insert_with(|| Topic {
                    type_name: channel.type_name.clone(),
                    named_by: file,
                    text: None,
                    messages: 0,
                    channels: Vec::new(),
                    foreign: None,
                    offered_qos: None,
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
                topic.messages = topic.messages.saturating_add(messages);
                topic.channels.push((file, id));
                topic.foreign = topic.foreign.take().or_else(|| foreign(channel));
                if topic.offered_qos.is_none() {
                    topic.offered_qos.clone_from(&channel.offered_qos);
                }
                if topic.text.is_none() && channel.schema_encoding == "ros2msg" {
                    topic.text.clone_from(&channel.definitions_text);
                }
            }
        }
        Ok(Self(topics))
    }

    pub(super) fn topics(&self) -> Vec<DiscoveredTopic> {
        let discovered = |(name, topic): (&String, &Topic)| DiscoveredTopic {
            topic: name.clone(),
            type_name: topic.type_name.clone(),
            definitions_text: topic.text.clone(),
            messages: Some(topic.messages),
            offered_qos: topic.offered_qos.clone(),
        };
        self.0.iter().map(discovered).collect()
    }

    /// The channels of a topic, if it is as `spec` wants it.
    pub(super) fn select(&self, spec: &TopicSpec) -> Result<Selected<'_>, TransportError> {
        let topic = self.get(&spec.topic)?;
        if !same_type(&topic.type_name, &spec.type_name) {
            return Err(TransportError::WrongType {
                topic: spec.topic.clone(),
                wanted: spec.type_name.clone(),
                found: topic.type_name.clone(),
            });
        }
        if let Some((what, found, wanted)) = &topic.foreign {
            return Err(TransportError::Encoding { topic: spec.topic.clone(), what, found: found.clone(), wanted });
        }
        Ok(Selected { channels: &topic.channels, messages: topic.messages })
    }

    pub(super) fn definitions(&self, name: &str) -> Result<Arc<Definitions>, TransportError> {
        let topic = self.get(name)?;
        if let Some(known) = topic.definitions.get() {
            return Ok(known.clone());
        }
        let text = topic.text.as_deref().ok_or_else(|| TransportError::NoDefinitions {
            topic: name.to_owned(),
            type_name: topic.type_name.clone(),
        })?;
        let parsed = Definitions::parse(&topic.type_name, text)
            .map_err(|source| TransportError::BadDefinitions { topic: name.to_owned(), source })?;
        Ok(topic.definitions.get_or_init(|| Arc::new(parsed)).clone())
    }

    fn get(&self, name: &str) -> Result<&Topic, TransportError> {
        self.0.get(name).ok_or_else(|| TransportError::NoSuchTopic {
            topic: name.to_owned(),
            known: self.0.keys().cloned().collect(),
            nearest: nearest(name, self.0.keys().map(String::as_str)).map(str::to_owned),
        })
    }
}

fn foreign(channel: &ChannelInfo) -> Option<(&'static str, String, &'static str)> {
    if channel.message_encoding != "cdr" {
        return Some(("message encoding", channel.message_encoding.clone(), "cdr"));
    }
    if channel.schema_encoding != "ros2msg" {
        return Some(("schema encoding", channel.schema_encoding.clone(), "ros2msg"));
    }
    None
}
