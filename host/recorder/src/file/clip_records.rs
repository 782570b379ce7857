//! The statements of a clip about itself: its line in the list, and the metadata records in the
//! file. `claims` checks them against the content, by building the records again.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Display;
use std::path::PathBuf;
use std::sync::Arc;

use gleaner_journal::{FileDigest, JournalHeader};
use gleaner_lambda::{Clip, ClipLambda, ClipTopic, Moment};

use super::written::{Written, WrittenTopic, crc32};
use super::{ClipHeader, ClipTrailer};

/// The program that writes clips, in their header.
pub(super) const LIBRARY: &str = concat!("gleaner ", env!("CARGO_PKG_VERSION"));
/// The record before the messages.
pub(super) const BEGIN: &str = "gleaner.begin";
pub(super) const CLIP_RECORD: &str = "gleaner.clip";
pub(super) const TOPIC_RECORD: &str = "gleaner.topic";
pub(super) const LAMBDA_RECORD: &str = "gleaner.lambda";
pub(super) const DECISION_RECORD: &str = "gleaner.decision";
pub(super) const THUMBNAIL: &str = "thumbnail.jpg";
/// Key of [`CLIP_RECORD`]: the line of the list, without fields that only the finished file has.
pub(super) const LINE: &str = "line";
/// Key of [`CLIP_RECORD`]: the unfinished file that a clip was recovered from.
const RECOVERED_FROM: &str = "recovered_from";

/// In `incomplete`: the previous clip has the earlier messages.
pub(crate) const CONTINUES: &str = "continues the clip before";

const UNKNOWN: &str = "unknown";

pub(super) type MetadataRecord = (String, BTreeMap<String, String>);

/// Returns the line of a clip, except for its length.
pub(super) fn clip(
    trailer: &ClipTrailer,
    written: &Written,
    file: PathBuf,
    thumbnail: Option<PathBuf>,
) -> Clip {
    Clip {
        file,
        thumbnail,
        bytes: 0,
        from_ns: trailer.from_ns,
        to_ns: trailer.to_ns,
        first_ns: written.span.map(|span| span.0),
        last_ns: written.span.map(|span| span.1),
        lambdas: trailer.lambdas.clone(),
        triggers: trailer.triggers,
        moments: trailer.moments.iter().take(Clip::MOMENTS_MAX).cloned().collect(),
        topics: topics(trailer, written),
        incomplete: trailer.incomplete.clone(),
        recovered: None,
    }
}

/// Returns the topics that the recorder names, then those that it forgot but whose messages are in
/// the file.
fn topics(trailer: &ClipTrailer, written: &Written) -> Vec<ClipTopic> {
    let mut topics = Vec::new();
    for counts in &trailer.topics {
        let found = written.topic(&counts.topic);
        topics.push(ClipTopic {
            topic: counts.topic.clone(),
            type_name: counts
                .type_name
                .clone()
                .or_else(|| found.map(|found| found.type_name.clone())),
            messages: found.map_or(0, |found| found.messages),
            received: counts.received,
            lost: counts.lost,
            overwritten: counts.overwritten,
            too_big: counts.too_big,
        });
    }
    let named: HashSet<&str> = trailer.topics.iter().map(|counts| counts.topic.as_str()).collect();
    for found in written.topics().iter().filter(|found| !named.contains(found.name.as_str())) {
        topics.push(ClipTopic {
            topic: found.name.clone(),
            type_name: Some(found.type_name.clone()),
            messages: found.messages,
            received: None,
            lost: None,
            overwritten: None,
            too_big: None,
        });
    }
    topics
}

pub(super) fn journal(name: &str) -> String {
    format!("journal/{name}.journal")
}

/// Returns the record before the messages, of a clip that `library` writes.
pub(super) fn begin(clip_header: &ClipHeader, library: &str) -> MetadataRecord {
    let metadata = pairs([
        ("clock", clip_header.clock.clone()),
        ("from_ns", clip_header.from_ns.to_string()),
        ("lambdas", json(&clip_header.lambdas)),
        ("library", library.to_owned()),
        ("moment", json(&clip_header.moment)),
    ]);
    (BEGIN.to_owned(), metadata)
}

/// Parses a record of [`begin`]; the error is the malformed key.
pub(super) fn read_begin(metadata: &BTreeMap<String, String>) -> Result<ClipHeader, &'static str> {
    Ok(ClipHeader {
        clock: value(metadata, "clock")?.clone(),
        from_ns: value(metadata, "from_ns")?.parse().map_err(|_| "from_ns")?,
        lambdas: serde_json::from_str(value(metadata, "lambdas")?).map_err(|_| "lambdas")?,
        moment: serde_json::from_str(value(metadata, "moment")?).map_err(|_| "moment")?,
    })
}

/// Returns the line of a complete clip, from its record [`CLIP_RECORD`].
pub(super) fn read_line(metadata: &BTreeMap<String, String>) -> Option<Clip> {
    serde_json::from_str(metadata.get(LINE)?).ok()
}

/// Returns the unfinished file that a clip was recovered from, from its record [`CLIP_RECORD`].
pub(super) fn read_recovered_from(metadata: &BTreeMap<String, String>) -> Option<&str> {
    metadata.get(RECOVERED_FROM).map(String::as_str)
}

pub(super) fn records<'a>(
    trailer: &'a ClipTrailer,
    clip: &'a Clip,
    written: &'a Written,
    clock: &str,
    recovered_from: Option<&str>,
) -> impl Iterator<Item = MetadataRecord> + 'a {
    let header = |index: usize| trailer.headers.get(index).map(Arc::as_ref);
    let lambdas =
        clip.lambdas.iter().enumerate().map(move |(index, entry)| lambda(entry, header(index)));
    std::iter::once(about_clip(clip, clock, LIBRARY, trailer.thumbnail.as_deref(), recovered_from))
        .chain(clip.topics.iter().map(|entry| topic(entry, written.topic(&entry.topic))))
        .chain(lambdas)
        .chain(trailer.moments.iter().map(decision))
}

pub(super) fn about_clip(
    clip: &Clip,
    clock: &str,
    library: &str,
    thumbnail: Option<&[u8]>,
    recovered_from: Option<&str>,
) -> MetadataRecord {
    let mut metadata = pairs([
        ("clock", clock.to_owned()),
        ("file", clip.file.display().to_string()),
        ("first_ns", known(clip.first_ns)),
        ("from_ns", clip.from_ns.to_string()),
        ("last_ns", known(clip.last_ns)),
        ("library", library.to_owned()),
        (LINE, json(clip)),
        ("incomplete", clip.incomplete.join("; ")),
        ("thumbnail", known(thumbnail.map(crc32))),
        ("to_ns", clip.to_ns.to_string()),
        ("triggers", clip.triggers.to_string()),
    ]);
    if let Some(recovered) = &clip.recovered {
        metadata.insert("recovered".to_owned(), recovered.note.clone());
        metadata.insert("recovered_lost_bytes".to_owned(), recovered.lost_bytes.to_string());
    }
    if let Some(from) = recovered_from {
        metadata.insert(RECOVERED_FROM.to_owned(), from.to_owned());
    }
    (CLIP_RECORD.to_owned(), metadata)
}

/// Returns the record of a topic; `found` is its content.
pub(super) fn topic(topic: &ClipTopic, found: Option<&WrittenTopic>) -> MetadataRecord {
    let metadata = pairs([
        (
            "checksum",
            found.map_or_else(|| WrittenTopic::default().checksum(), WrittenTopic::checksum),
        ),
        ("definitions", known(found.and_then(WrittenTopic::definitions))),
        ("lost", known(topic.lost)),
        ("messages", topic.messages.to_string()),
        ("overwritten", known(topic.overwritten)),
        ("received", known(topic.received)),
        ("too_big", known(topic.too_big)),
        ("topic", topic.topic.clone()),
        ("type", known(topic.type_name.as_deref())),
    ]);
    (TOPIC_RECORD.to_owned(), metadata)
}

pub(super) fn lambda(lambda: &ClipLambda, header: Option<&JournalHeader>) -> MetadataRecord {
    let model = |model: &FileDigest| format!("{}={}", model.path, model.sha256);
    let metadata = pairs([
        ("config", known(header.map(|header| json(&header.config)))),
        ("digest", lambda.digest.clone()),
        ("engine", known(header.map(|header| &header.engine))),
        ("gleaner", known(header.map(|header| &header.gleaner))),
        ("kind", lambda.kind.as_str().to_owned()),
        (
            "models",
            known(
                header.map(|header| header.models.iter().map(model).collect::<Vec<_>>().join(", ")),
            ),
        ),
        ("name", lambda.name.clone()),
        ("version", lambda.version.clone()),
        ("windows", lambda.windows.to_string()),
    ]);
    (LAMBDA_RECORD.to_owned(), metadata)
}

pub(super) fn decision(moment: &Moment) -> MetadataRecord {
    let mut metadata = pairs([
        ("at_ns", moment.at_ns.to_string()),
        ("kind", moment.kind.as_str().to_owned()),
        ("label", moment.label.clone()),
        ("lambda", moment.lambda.clone()),
    ]);
    // A trigger without a score has no unknown score.
    if let Some(score) = moment.score {
        metadata.insert("score".to_owned(), score.to_string());
    }
    if let Some(source) = &moment.source {
        metadata.insert("source".to_owned(), source.clone());
    }
    metadata.insert(
        "attributes".to_owned(),
        moment.attributes.as_ref().map_or(UNKNOWN.to_owned(), json),
    );
    (DECISION_RECORD.to_owned(), metadata)
}

/// Parses a record of [`decision`]; the error is the malformed key.
pub(super) fn read_decision(metadata: &BTreeMap<String, String>) -> Result<Moment, &'static str> {
    let score =
        metadata.get("score").map(|score| score.parse::<f64>()).transpose().map_err(|_| "score")?;
    let attributes = match value(metadata, "attributes")?.as_str() {
        UNKNOWN => None,
        text => Some(serde_json::from_str(text).map_err(|_| "attributes")?),
    };
    Ok(Moment {
        lambda: value(metadata, "lambda")?.clone(),
        kind: serde_json::from_value(value(metadata, "kind")?.as_str().into())
            .map_err(|_| "kind")?,
        label: value(metadata, "label")?.clone(),
        score,
        attributes,
        at_ns: value(metadata, "at_ns")?.parse().map_err(|_| "at_ns")?,
        source: metadata.get("source").cloned(),
    })
}

fn value<'a>(
    metadata: &'a BTreeMap<String, String>,
    key: &'static str,
) -> Result<&'a String, &'static str> {
    metadata.get(key).ok_or(key)
}

fn known(value: Option<impl Display>) -> String {
    value.map_or_else(|| UNKNOWN.to_owned(), |value| value.to_string())
}

pub(super) fn json(value: &impl serde::Serialize) -> String {
    serde_json::to_string(value).expect("a clip is plain data")
}

fn pairs<const N: usize>(pairs: [(&str, String); N]) -> BTreeMap<String, String> {
    pairs.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}
