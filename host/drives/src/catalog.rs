//! The topics of a drive: the channels of all its files, merged by name, type and layout.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::{Arc, OnceLock};

use tracing::warn;

use crate::file::{ChannelInfo, Contents};
use gleaner_base::excerpt;
use gleaner_base::text::nearest;
use gleaner_messages::transport::{
    DiscoveredTopic, TopicSpec, TransportError, latched_depth, same_type,
};
use gleaner_messages::type_description::type_hash;
use gleaner_messages::{Definitions, Sources, SourcesError, short_name};

const LAYOUTS_MAX: usize = 64;

/// Most types that a warning names.
const NAMED: usize = 3;

/// The reason why messages of a channel are not read that states another hash of its type.
const OTHER_HASH: &str = "a channel states a type hash that is not that of its definition, so its \
    writer had another version of the type; record it where the messages of the writer are \
    installed";

#[derive(Copy, Clone)]
pub struct DriveChannel {
    pub file: usize,
    pub id: u16,
    /// Number of the layout of its messages among those of its topic.
    pub layout: u16,
}

/// A topic of all files, as far as it has one type.
#[derive(Default)]
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

#[derive(Default)]
struct Layouts {
    /// The definitions of each layout, as the first channel has them, in the order of channels.
    texts: Vec<Arc<str>>,
    /// The digest of each layout; `None` for malformed definitions.
    digests: Vec<Option<[u8; 32]>>,
    /// Set beyond [`LAYOUTS_MAX`].
    is_full: bool,
}

impl Layouts {
    fn number(&mut self, digest: Option<[u8; 32]>, text: &Arc<str>) -> u16 {
        let known = match digest {
            Some(_) => self.digests.iter().position(|known| *known == digest),
            None => self.texts.iter().position(|known| known == text),
        };
        let number = known.unwrap_or(self.texts.len());
        if number == LAYOUTS_MAX {
            self.is_full = true;
            return 0;
        }
        if known.is_none() {
            self.digests.push(digest);
            self.texts.push(text.clone());
        }
        number as u16 // Below `LAYOUTS_MAX`.
    }
}

/// All definitions of a drive, each parsed once, by their places: the files keep them. Those that
/// differ only in comments and constants have the digest of one layout.
#[derive(Default)]
struct KnownTexts(HashMap<(*const u8, String), KnownText>);

struct KnownText {
    /// `None` for malformed definitions.
    digest: Option<[u8; 32]>,
    /// RIHS01 of the type; `None` for malformed definitions, and for types that have none.
    hash: Option<String>,
}

impl KnownTexts {
    fn get(&mut self, type_name: &str, text: &Arc<str>) -> &KnownText {
        self.0.entry((text.as_ptr(), short_name(type_name))).or_insert_with(|| {
            let parsed = Definitions::parse(type_name, text).ok();
            let digest = parsed.map(|parsed| parsed.layout_digest());
            KnownText { digest, hash: type_hash(type_name, text).ok() }
        })
    }
}

/// Returns whether a text is a hash of a type. Recorders write others where they know none.
fn is_rihs01(text: &str) -> bool {
    let digits = text.strip_prefix("RIHS01_");
    digits.is_some_and(|it| it.len() == 64 && it.bytes().all(|digit| digit.is_ascii_hexdigit()))
}

impl DriveTopic {
    fn new(type_name: &str) -> Self {
        Self { type_name: type_name.to_owned(), messages: Some(0), ..Self::default() }
    }

    /// Adds a channel; `messages` is the number of its messages, if it is known.
    fn add(
        &mut self,
        (file, id): (usize, u16),
        channel: &ChannelInfo,
        messages: Option<u64>,
        known: &mut KnownTexts,
    ) {
        let sum = self.messages.zip(messages);
        self.messages = sum.map(|(known, messages)| known.saturating_add(messages));
        if self.offered_qos.is_none() {
            self.offered_qos.clone_from(&channel.offered_qos);
        }
        let mut layout = 0;
        // A channel without messages decides nothing where others have some.
        if messages != Some(0) || self.messages == Some(0) {
            layout = self.layout_of(channel, known);
        }
        self.channels.push(DriveChannel { file, id, layout });
    }

    /// Returns the number of the layout of a channel; notes what prevents its messages from being
    /// read.
    fn layout_of(&mut self, channel: &ChannelInfo, known: &mut KnownTexts) -> u16 {
        if channel.message_encoding != "cdr" {
            self.foreign.get_or_insert_with(|| channel.message_encoding.clone());
        }
        self.unknown_layout = self.unknown_layout.or(channel.unknown_layout);
        match &channel.definitions_text {
            Some(text) if channel.schema_encoding == "ros2msg" => {
                let KnownText { digest, hash } = known.get(&self.type_name, text);
                let stated = channel.type_hash.as_deref().filter(|stated| is_rihs01(stated));
                let differs =
                    |hash: &String| stated.is_some_and(|stated| !stated.eq_ignore_ascii_case(hash));
                if hash.as_ref().is_some_and(differs) {
                    self.unknown_layout.get_or_insert(OTHER_HASH);
                }
                return self.layouts.number(*digest, text);
            }
            // A writer that does not know a type leaves out its text, and the encoding with it.
            None if !channel.type_name.is_empty() => self.lacks_text = true,
            _ => {
                self.foreign_text.get_or_insert_with(|| channel.schema_encoding.clone());
            }
        }
        0
    }

    /// Returns the reason why the layout of some channels is unknown, if there is one.
    fn unknown_layout(&self) -> Option<&'static str> {
        let layouts = &self.layouts;
        if self.unknown_layout.is_some() {
            return self.unknown_layout;
        }
        if layouts.is_full {
            return Some("it has more than 64 layouts; replay fewer files at a time");
        }
        if self.foreign_text.is_some() && !layouts.texts.is_empty() {
            return Some(
                "some of its definitions are not ros2msg text, others are; replay the files with \
                 each kind separately",
            );
        }
        (self.lacks_text && layouts.texts.len() > 1).then_some(
            "the files define its type in several ways, and some of its messages do not state \
             which; replay the files separately",
        )
    }
}

pub struct Selected<'a> {
    /// In the order of files and ids.
    pub channels: &'a [DriveChannel],
    pub messages: Option<u64>,
}

pub struct Catalog {
    /// One entry for each type of a topic, that with the most messages first.
    by_name: BTreeMap<String, Vec<DriveTopic>>,
    /// The sources of definitions that the files do not carry.
    sources: Option<Sources>,
}

impl Catalog {
    pub fn build(files: &[(&Path, &Contents)], sources: Option<Sources>) -> Self {
        let mut channels = Vec::new();
        for (file, (_, contents)) in files.iter().enumerate() {
            for (id, channel) in contents.channels.iter() {
                let messages = contents.messages.get(&id).copied().unwrap_or(0);
                channels.push(((file, id), channel, (!contents.uncounted).then_some(messages)));
            }
        }
        // Channels without messages come last, where they decide nothing.
        channels.sort_by_key(|(_, _, messages)| *messages == Some(0));
        let mut by_name: BTreeMap<String, Vec<DriveTopic>> = BTreeMap::new();
        let (mut types, mut known) = (HashMap::new(), KnownTexts::default());
        for (of, channel, messages) in channels {
            let topics = by_name.entry(channel.topic.clone()).or_default();
            let index = types.entry((&channel.topic, short_name(&channel.type_name)));
            let index = *index.or_insert_with(|| {
                topics.push(DriveTopic::new(&channel.type_name));
                topics.len() - 1
            });
            topics[index].add(of, channel, messages, &mut known);
        }
        for topic in by_name.values_mut().flatten() {
            topic.channels.sort_by_key(|channel| (channel.file, channel.id));
        }
        for topics in by_name.values_mut() {
            topics.sort_by_key(|topic| std::cmp::Reverse(topic.messages.unwrap_or(u64::MAX)));
        }
        Self { by_name, sources }
    }

    pub fn topics(&self) -> Vec<DiscoveredTopic> {
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
    pub fn select(&self, spec: &TopicSpec) -> Result<Selected<'_>, TransportError> {
        let topic = self.get(&spec.topic, Some(&spec.type_name))?;
        let name = || spec.topic.clone();
        if !same_type(&topic.type_name, &spec.type_name) {
            let (wanted, found) = (spec.type_name.clone(), topic.type_name.clone());
            return Err(TransportError::WrongType { topic: name(), wanted, found });
        }
        let encoding = |what, found: &String, wanted| {
            let found = found.clone();
            Err(TransportError::Encoding { topic: name(), what, found, wanted })
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
            return Err(TransportError::UnknownLayout { topic: name(), why });
        }
        Ok(Selected { channels: &topic.channels, messages: topic.messages })
    }

    /// Returns whether the writers of a topic keep samples for readers that come later.
    pub fn is_latched(&self, spec: &TopicSpec) -> bool {
        let topic = self.get(&spec.topic, Some(&spec.type_name)).ok();
        topic.and_then(|topic| latched_depth(topic.offered_qos.as_deref()?)).is_some()
    }

    /// Warns if messages of other types than that of `spec` are left out of its topic.
    pub fn warn_of_other_types(&self, spec: &TopicSpec) {
        let topics = self.by_name.get(&spec.topic).map_or(&[][..], Vec::as_slice);
        let others = topics.iter().filter(|other| !same_type(&other.type_name, &spec.type_name));
        let others: Vec<_> = others.filter(|other| other.messages != Some(0)).collect();
        if others.is_empty() {
            return;
        }
        let names = others.iter().take(NAMED).map(|other| excerpt(&other.type_name));
        let messages = others.iter().map(|other| other.messages).sum::<Option<u64>>();
        warn!(
            topic = %spec.topic,
            read = %spec.type_name,
            left_out = %names.collect::<Vec<_>>().join(", "),
            types = others.len(),
            messages,
            "skipped the messages of other types in a topic"
        );
    }

    /// Returns the definitions of a topic; if it has several types, those of `type_name`, or of the
    /// one with the most messages.
    pub fn definitions(
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
