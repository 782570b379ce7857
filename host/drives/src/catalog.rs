//! The topics of a drive: the channels of all its files, merged by name, type and layout.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, OnceLock};

use tracing::warn;

use super::file::{ChannelInfo, Contents};
use gleaner_base::text::nearest;
use gleaner_messages::{Definitions, Sources, SourcesError};
use gleaner_transport::{DiscoveredTopic, TopicSpec, TransportError, same_type};

/// Most different definitions of one topic; each is compared with the others.
const DEFINITIONS_MAX: usize = 64;

/// A channel of a drive.
#[derive(Copy, Clone)]
pub(super) struct DriveChannel {
    /// Index of its file.
    pub(super) file: usize,
    /// Its id in that file.
    pub(super) id: u16,
    /// Number of the layout of its messages among those of its topic.
    pub(super) layout: u16,
}

/// A topic of all files, as far as it has one type.
struct DriveTopic {
    type_name: String,
    layouts: Layouts,
    /// `None` if a file does not have the number.
    messages: Option<u64>,
    /// In the order of files and ids.
    channels: Vec<DriveChannel>,
    /// The unsupported encoding of messages, if there is one.
    foreign: Option<String>,
    /// The unsupported encoding of definitions, if there is one.
    foreign_text: Option<String>,
    /// Set if a channel has no definitions.
    lacks_text: bool,
    /// The first reason for which the layout of a channel is unknown.
    unknown_layout: Option<&'static str>,
    /// The QoS of the first channel that states one.
    offered_qos: Option<String>,
    /// Definitions found elsewhere, since the files have none.
    found: OnceLock<Option<Arc<str>>>,
    definitions: OnceLock<Arc<Definitions>>,
}

/// The layouts of one type on one topic. Definitions that differ only in comments and constants
/// have one layout.
#[derive(Default)]
struct Layouts {
    /// The definitions of each layout, as the first channel has them, in the order of channels.
    texts: Vec<Arc<str>>,
    /// The same, parsed, once there are different texts; `None` for malformed ones.
    parsed: Vec<Option<Definitions>>,
    /// All different texts, each with the number of its layout.
    known: Vec<(Arc<str>, u16)>,
    /// Set beyond [`DEFINITIONS_MAX`].
    is_full: bool,
}

impl Layouts {
    /// Returns the number of the layout of `text`.
    fn number(&mut self, type_name: &str, text: &Arc<str>) -> u16 {
        if let Some((_, number)) = self.known.iter().find(|(known, _)| known == text) {
            return *number;
        }
        if self.known.len() >= DEFINITIONS_MAX {
            self.is_full = true;
            return 0;
        }
        let parse = |text: &str| Definitions::parse(type_name, text).ok();
        let mut number = self.texts.len();
        if number > 0 {
            let texts = &self.texts[self.parsed.len()..];
            self.parsed.extend(texts.iter().map(|text| parse(text)));
            let this = parse(text);
            let is_same = |known: &Option<Definitions>| {
                known.as_ref().zip(this.as_ref()).is_some_and(|(a, b)| a.is_equivalent(b))
            };
            number = self.parsed.iter().position(is_same).unwrap_or(number);
        }
        if number == self.texts.len() {
            self.texts.push(text.clone());
        }
        let number = number as u16; // At most `DEFINITIONS_MAX`.
        self.known.push((text.clone(), number));
        number
    }
}

impl DriveTopic {
    fn new(type_name: &str) -> Self {
        Self {
            type_name: type_name.to_owned(),
            layouts: Layouts::default(),
            messages: Some(0),
            channels: Vec::new(),
            foreign: None,
            foreign_text: None,
            lacks_text: false,
            unknown_layout: None,
            offered_qos: None,
            found: OnceLock::new(),
            definitions: OnceLock::new(),
        }
    }

    /// Adds a channel; `messages` is the number of its messages, if it is known.
    fn add(&mut self, file: usize, id: u16, channel: &ChannelInfo, messages: Option<u64>) {
        let sum = self.messages.zip(messages);
        self.messages = sum.map(|(known, messages)| known.saturating_add(messages));
        if channel.message_encoding != "cdr" {
            self.foreign.get_or_insert_with(|| channel.message_encoding.clone());
        }
        if self.offered_qos.is_none() {
            self.offered_qos.clone_from(&channel.offered_qos);
        }
        self.unknown_layout = self.unknown_layout.or(channel.unknown_layout);
        let mut layout = 0;
        match &channel.definitions_text {
            Some(text) if channel.schema_encoding == "ros2msg" => {
                layout = self.layouts.number(&self.type_name, text);
            }
            // A writer that does not know a type leaves out its text, and the encoding with it.
            None if !channel.type_name.is_empty() => self.lacks_text = true,
            _ => {
                self.foreign_text.get_or_insert_with(|| channel.schema_encoding.clone());
            }
        }
        self.channels.push(DriveChannel { file, id, layout });
    }

    /// Returns the reason why the layout of some channels is unknown, if there is one.
    fn unknown_layout(&self) -> Option<&'static str> {
        let layouts = &self.layouts;
        if self.unknown_layout.is_some() {
            return self.unknown_layout;
        }
        if layouts.is_full {
            return Some("it has more than 64 different definitions; replay fewer files at a time");
        }
        if self.foreign_text.is_some() && !layouts.texts.is_empty() {
            return Some(
                "some of its definitions are no ros2msg text, others are; replay the files with \
                 each kind separately",
            );
        }
        (self.lacks_text && layouts.texts.len() > 1).then_some(
            "the files define its type in several ways, and some of its messages do not state \
             theirs; replay the files separately",
        )
    }
}

/// A topic that can be subscribed.
pub(super) struct Selected<'a> {
    /// In the order of files and ids.
    pub(super) channels: &'a [DriveChannel],
    pub(super) messages: Option<u64>,
}

/// All topics.
pub(super) struct Catalog {
    /// One entry for each type of a topic, that with the most messages first.
    by_name: BTreeMap<String, Vec<DriveTopic>>,
    /// The sources of definitions that the files do not carry.
    sources: Option<Sources>,
}

impl Catalog {
    pub(super) fn build(files: &[(&Path, &Contents)], sources: Option<Sources>) -> Self {
        let mut by_name: BTreeMap<String, Vec<DriveTopic>> = BTreeMap::new();
        for (file, (_, contents)) in files.iter().enumerate() {
            for (id, channel) in contents.channels.iter() {
                let topics = by_name.entry(channel.topic.clone()).or_default();
                let is_same = |topic: &DriveTopic| same_type(&topic.type_name, &channel.type_name);
                let index = topics.iter().position(is_same).unwrap_or_else(|| {
                    topics.push(DriveTopic::new(&channel.type_name));
                    topics.len() - 1
                });
                let messages = contents.messages.get(&id).copied().unwrap_or(0);
                let messages = (!contents.uncounted).then_some(messages);
                topics[index].add(file, id, channel, messages);
            }
        }
        for topics in by_name.values_mut() {
            topics.sort_by_key(|topic| std::cmp::Reverse(topic.messages.unwrap_or(u64::MAX)));
        }
        Self { by_name, sources }
    }

    pub(super) fn topics(&self) -> Vec<DiscoveredTopic> {
        let discovered = |name: &String, topic: &DriveTopic| DiscoveredTopic {
            topic: name.clone(),
            type_name: topic.type_name.clone(),
            // Errors of it are reported when fields are read.
            definitions_text: self.text(name, topic).ok().flatten().cloned(),
            type_hash: None,
            other_definitions: topic.layouts.texts.iter().skip(1).cloned().collect(),
            messages: topic.messages,
            offered_qos: topic.offered_qos.clone(),
        };
        let all = self.by_name.iter();
        all.flat_map(|(name, topics)| topics.iter().map(move |topic| discovered(name, topic)))
            .collect()
    }

    /// Returns the definitions of a topic's type: those of its files, otherwise those found
    /// elsewhere.
    fn text<'a>(
        &'a self,
        name: &str,
        topic: &'a DriveTopic,
    ) -> Result<Option<&'a Arc<str>>, TransportError> {
        let own = topic.layouts.texts.first();
        let Some(sources) = self.sources.as_ref().filter(|_| own.is_none()) else {
            return Ok(own);
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
        let topic = self.get(&spec.topic, Some(&spec.type_name))?;
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
        if let Some(why) = topic.unknown_layout() {
            return Err(TransportError::UnknownLayout { topic: spec.topic.clone(), why });
        }
        Ok(Selected { channels: &topic.channels, messages: topic.messages })
    }

    /// Warns if messages of other types than that of `spec` are left out of its topic.
    pub(super) fn warn_of_other_types(&self, spec: &TopicSpec) {
        let topics = self.by_name.get(&spec.topic).map_or(&[][..], Vec::as_slice);
        for other in topics.iter().filter(|other| !same_type(&other.type_name, &spec.type_name)) {
            warn!(
                topic = %spec.topic,
                read = %spec.type_name,
                left_out = %other.type_name,
                messages = other.messages,
                "a topic has messages of another type, which are left out"
            );
        }
    }

    /// Returns the definitions of a topic; if it has several types, those of `type_name`, or of the
    /// one with the most messages.
    pub(super) fn definitions(
        &self,
        name: &str,
        type_name: Option<&str>,
    ) -> Result<Arc<Definitions>, TransportError> {
        let topic = self.get(name, type_name)?;
        if let Some(known) = topic.definitions.get() {
            return Ok(known.clone());
        }
        let text = self.text(name, topic)?.ok_or_else(|| TransportError::NoDefinitions {
            topic: name.to_owned(),
            type_name: topic.type_name.clone(),
        })?;
        let parse = |text: &Arc<str>| {
            Definitions::parse(&topic.type_name, text)
                .map_err(|source| TransportError::BadDefinitions { topic: name.to_owned(), source })
        };
        let others = topic.layouts.texts.iter().skip(1).map(parse).collect::<Result<_, _>>()?;
        let parsed = parse(text)?.with_layouts(others);
        Ok(topic.definitions.get_or_init(|| Arc::new(parsed)).clone())
    }

    fn get(&self, name: &str, type_name: Option<&str>) -> Result<&DriveTopic, TransportError> {
        let topics = self.by_name.get(name).map_or(&[][..], Vec::as_slice);
        let typed = topics
            .iter()
            .find(|topic| type_name.is_some_and(|wanted| same_type(&topic.type_name, wanted)));
        typed.or(topics.first()).ok_or_else(|| TransportError::NoSuchTopic {
            topic: name.to_owned(),
            known: self.by_name.keys().cloned().collect(),
            nearest: nearest(name, self.by_name.keys().map(String::as_str)).map(str::to_owned),
        })
    }
}
