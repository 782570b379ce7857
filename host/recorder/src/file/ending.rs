//! What a clip says of itself: its line in the list, and the metadata records in the file.

use std::collections::BTreeMap;
use std::collections::HashMap;
use std::fmt::Display;
use std::path::PathBuf;
use std::sync::Arc;

use gleaner_protocol::journal::{FileDigest, Header};
use gleaner_protocol::{Clip, ClipLambda, ClipTopic, Moment};

use super::{About, Ending};

/// The program that writes clips, as their header names it.
pub(super) const LIBRARY: &str = concat!("gleaner ", env!("CARGO_PKG_VERSION"));
/// The record in front of the messages.
pub(super) const BEGIN: &str = "gleaner.begin";
/// The record with the line of the list.
pub(super) const CLIP_RECORD: &str = "gleaner.clip";
/// Key of [`CLIP_RECORD`]: the line of the list, without what only the finished file knows.
const LINE: &str = "line";
/// Key of [`CLIP_RECORD`]: the unfinished file that a recovered clip was saved from.
const RECOVERED_FROM: &str = "recovered_from";

const UNKNOWN: &str = "unknown";

/// A metadata record.
pub(super) type Record = (String, BTreeMap<String, String>);

/// What was written of the messages.
#[derive(Default)]
pub(super) struct Written {
    /// In the order of their first messages: name, type, messages.
    pub(super) topics: Vec<(String, String, u64)>,
    /// Stamps of the first and the last message.
    pub(super) span: Option<(i64, i64)>,
}

impl Written {
    pub(super) fn add_topic(&mut self, name: &str, type_name: &str) -> usize {
        self.topics.push((name.to_owned(), type_name.to_owned(), 0));
        self.topics.len() - 1
    }

    pub(super) fn count(&mut self, topic: usize, at_ns: i64) {
        self.topics[topic].2 += 1;
        let (first, last) = self.span.unwrap_or((at_ns, at_ns));
        self.span = Some((first.min(at_ns), last.max(at_ns)));
    }

    pub(super) fn messages(&self) -> u64 {
        self.topics.iter().map(|(_, _, messages)| messages).sum()
    }
}

/// The line of a clip, but for its length.
pub(super) fn clip(ending: &Ending, written: &Written, file: PathBuf, thumbnail: Option<PathBuf>) -> Clip {
    Clip {
        file,
        thumbnail,
        bytes: 0,
        from_ns: ending.from_ns,
        to_ns: ending.to_ns,
        first_ns: written.span.map(|span| span.0),
        last_ns: written.span.map(|span| span.1),
        lambdas: ending.lambdas.clone(),
        triggers: ending.triggers,
        moments: ending.moments.iter().take(Clip::MOMENTS_MAX).cloned().collect(),
        topics: topics(ending, written),
        short: ending.short.clone(),
        recovered: None,
    }
}

/// The topics that the recorder names, then those that it forgot: their messages are in the file all the same.
fn topics(ending: &Ending, written: &Written) -> Vec<ClipTopic> {
    let mut left: HashMap<&str, (&str, u64)> = written
        .topics
        .iter()
        .map(|(name, type_name, messages)| (name.as_str(), (type_name.as_str(), *messages)))
        .collect();
    let mut topics = Vec::new();
    for counts in &ending.topics {
        let (type_name, messages) = left.remove(counts.topic.as_str()).unzip();
        topics.push(ClipTopic {
            topic: counts.topic.clone(),
            type_name: counts.type_name.clone().or_else(|| type_name.map(str::to_owned)),
            messages: messages.unwrap_or(0),
            received: counts.received,
            lost: counts.lost,
            overwritten: counts.overwritten,
            too_big: counts.too_big,
        });
    }
    for (name, type_name, messages) in &written.topics {
        if left.contains_key(name.as_str()) {
            topics.push(ClipTopic {
                topic: name.clone(),
                type_name: Some(type_name.clone()),
                messages: *messages,
                received: None,
                lost: None,
                overwritten: None,
                too_big: None,
            });
        }
    }
    topics
}

/// The record in front of the messages.
pub(super) fn begin(about: &About) -> Record {
    let metadata = pairs([
        ("clock", about.clock.clone()),
        ("from_ns", about.from_ns.to_string()),
        ("lambdas", json(&about.lambdas)),
        ("library", LIBRARY.to_owned()),
        ("moment", json(&about.moment)),
    ]);
    (BEGIN.to_owned(), metadata)
}

/// What [`begin`] says, as far as it can be read.
pub(super) fn read_begin(metadata: &BTreeMap<String, String>) -> Option<About> {
    Some(About {
        clock: metadata.get("clock")?.clone(),
        from_ns: metadata.get("from_ns")?.parse().ok()?,
        lambdas: serde_json::from_str(metadata.get("lambdas")?).ok()?,
        moment: serde_json::from_str(metadata.get("moment")?).ok()?,
    })
}

/// The line of a whole clip, by its record [`CLIP_RECORD`].
pub(super) fn read_line(metadata: &BTreeMap<String, String>) -> Option<Clip> {
    serde_json::from_str(metadata.get(LINE)?).ok()
}

/// The unfinished file that a clip was saved from, by its record [`CLIP_RECORD`].
pub(super) fn read_recovered_from(metadata: &BTreeMap<String, String>) -> Option<&str> {
    metadata.get(RECOVERED_FROM).map(String::as_str)
}

/// The records behind the messages.
pub(super) fn records<'a>(
    ending: &'a Ending,
    clip: &'a Clip,
    clock: &str,
    recovered_from: Option<&str>,
) -> impl Iterator<Item = Record> + 'a {
    let header = |index: usize| ending.headers.get(index).map(Arc::as_ref);
    let lambdas = clip.lambdas.iter().enumerate().map(move |(index, of)| lambda(of, header(index)));
    std::iter::once(about_clip(clip, clock, recovered_from))
        .chain(clip.topics.iter().map(topic))
        .chain(lambdas)
        .chain(ending.moments.iter().map(decision))
}

fn about_clip(clip: &Clip, clock: &str, recovered_from: Option<&str>) -> Record {
    let mut metadata = pairs([
        ("clock", clock.to_owned()),
        ("file", clip.file.display().to_string()),
        ("first_ns", known(clip.first_ns)),
        ("from_ns", clip.from_ns.to_string()),
        ("last_ns", known(clip.last_ns)),
        ("library", LIBRARY.to_owned()),
        (LINE, json(clip)),
        ("short", clip.short.join("; ")),
        ("to_ns", clip.to_ns.to_string()),
        ("triggers", clip.triggers.to_string()),
    ]);
    if let Some(recovered) = &clip.recovered {
        metadata.insert("recovered".to_owned(), recovered.what.clone());
        metadata.insert("recovered_lost_bytes".to_owned(), recovered.lost_bytes.to_string());
    }
    if let Some(from) = recovered_from {
        metadata.insert(RECOVERED_FROM.to_owned(), from.to_owned());
    }
    (CLIP_RECORD.to_owned(), metadata)
}

fn topic(topic: &ClipTopic) -> Record {
    let metadata = pairs([
        ("lost", known(topic.lost)),
        ("messages", topic.messages.to_string()),
        ("overwritten", known(topic.overwritten)),
        ("received", known(topic.received)),
        ("too_big", known(topic.too_big)),
        ("topic", topic.topic.clone()),
        ("type", known(topic.type_name.as_deref())),
    ]);
    ("gleaner.topic".to_owned(), metadata)
}

fn lambda(lambda: &ClipLambda, header: Option<&Header>) -> Record {
    let model = |model: &FileDigest| format!("{}={}", model.path, model.sha256);
    let metadata = pairs([
        ("config", known(header.map(|header| json(&header.config)))),
        ("digest", lambda.digest.clone()),
        ("engine", known(header.map(|header| &header.engine))),
        ("gleaner", known(header.map(|header| &header.gleaner))),
        ("kind", lambda.kind.as_str().to_owned()),
        ("models", known(header.map(|header| header.models.iter().map(model).collect::<Vec<_>>().join(", ")))),
        ("name", lambda.name.clone()),
        ("version", lambda.version.clone()),
        ("windows", lambda.windows.to_string()),
    ]);
    ("gleaner.lambda".to_owned(), metadata)
}

fn decision(moment: &Moment) -> Record {
    let mut metadata = pairs([
        ("at_ns", moment.at_ns.to_string()),
        ("kind", moment.kind.as_str().to_owned()),
        ("label", moment.label.clone()),
        ("lambda", moment.lambda.clone()),
    ]);
    // A trigger need not have a score: none is not an unknown one.
    if let Some(score) = moment.score {
        metadata.insert("score".to_owned(), score.to_string());
    }
    if let Some(source) = &moment.source {
        metadata.insert("source".to_owned(), source.clone());
    }
    metadata.insert("attributes".to_owned(), moment.attributes.as_ref().map_or(UNKNOWN.to_owned(), json));
    ("gleaner.decision".to_owned(), metadata)
}

fn known(value: Option<impl Display>) -> String {
    value.map_or_else(|| UNKNOWN.to_owned(), |value| value.to_string())
}

fn json(value: &impl serde::Serialize) -> String {
    serde_json::to_string(value).expect("what a clip says is plain data")
}

fn pairs<const N: usize>(pairs: [(&str, String); N]) -> BTreeMap<String, String> {
    pairs.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}
