//! Checks the statements of a finished clip about itself against its content. The file is
//! untrusted.
//!
//! The records are built again from their sources: the line of the clip, the header of a journal in
//! it, its messages. A statement without a source in the file has to be the same at each place.
//! `docs/clips.md` lists them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use gleaner_base::{excerpt, visible};
use gleaner_drives::{Attachment, Extras};
use gleaner_journal::JournalHeader;
use gleaner_lambda::{Clip, ClipLambda, ClipTopic, Moment};
use gleaner_trust::SIGNATURE;

use super::clip_dir::{CLIP, CLIPS, JPG, names};
use super::clip_records::{
    self, BEGIN, CLIP_RECORD, CONTINUES, DECISION_RECORD, LAMBDA_RECORD, LINE, THUMBNAIL,
    TOPIC_RECORD, json,
};
use super::list::plain_name;
use super::written::Written;
use super::{ClipHeader, read};
use crate::error::RecordError;
use crate::{LAMBDAS_MAX, lambda_digest};

type Values = BTreeMap<String, String>;

const RECORDS: [&str; 5] = [BEGIN, CLIP_RECORD, TOPIC_RECORD, LAMBDA_RECORD, DECISION_RECORD];

/// Number of bytes to show of the common part of two long texts, before their first difference.
const IN_COMMON: usize = 24;

/// A statement of a clip that the rest of the clip contradicts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClaimMismatch {
    /// The record and the key.
    pub what: String,
    pub stated: String,
    /// The value that follows from the rest of the clip.
    pub found: String,
}

impl ClaimMismatch {
    fn new(what: impl Into<String>, stated: &str, found: &str) -> Self {
        // For two texts that begin alike, the beginning is not informative.
        let alike = stated.bytes().zip(found.bytes()).take_while(|(a, b)| a == b).count();
        let from = (0..=alike.saturating_sub(IN_COMMON))
            .rev()
            .find(|at| stated.is_char_boundary(*at))
            .unwrap_or(0);
        let side = |text: &str| match from {
            0 => excerpt(text),
            from => format!("…{}", excerpt(&text[from..])),
        };
        Self { what: visible(&what.into()), stated: side(stated), found: side(found) }
    }

    fn count(what: impl Into<String>, stated: usize, found: usize) -> Self {
        let times = |n: usize| if n == 1 { "once".to_owned() } else { format!("{n} times") };
        Self::new(what, &times(stated), &times(found))
    }
}

/// The statements of a finished clip about itself.
#[derive(Debug)]
pub struct ClipStatements {
    clip: Clip,
    moments: Vec<Moment>,
    topics: BTreeMap<String, Values>,
}

impl ClipStatements {
    /// Reads the records of a clip that contains the journal with this header, and compares them
    /// with each other, with the header and with the attachments.
    ///
    /// # Errors
    ///
    /// The first [`ClaimMismatch`]: a record or an attachment that is missing, duplicated or of
    /// another kind, a value in another form than recorders write, or one that contradicts the
    /// rest.
    pub fn read(extras: &Extras, header: &JournalHeader) -> Result<Self, ClaimMismatch> {
        if let Some((name, _)) =
            extras.metadata.iter().find(|(name, _)| !RECORDS.contains(&name.as_str()))
        {
            return Err(ClaimMismatch::new(
                format!("record `{}`", excerpt(name)),
                "present",
                "not written by recorders",
            ));
        }
        let records = |kind: &'static str| {
            extras.metadata.iter().filter(move |(name, _)| name == kind).map(|(_, values)| values)
        };
        let only = |kind: &'static str| match records(kind).collect::<Vec<_>>()[..] {
            [values] => Ok(values),
            ref found => Err(ClaimMismatch::count(format!("record {kind}"), found.len(), 1)),
        };
        let clip = clip(only(CLIP_RECORD)?, &extras.attachments, header)?;
        lambdas(&records(LAMBDA_RECORD).collect::<Vec<_>>(), &clip, header)?;
        attachments(&extras.attachments, &clip)?;
        let moments = records(DECISION_RECORD).map(moment).collect::<Result<Vec<_>, _>>()?;
        decisions(&moments, &clip)?;
        begin(only(BEGIN)?, &clip, &moments, header)?;
        let topics = topics(records(TOPIC_RECORD), &clip)?;
        Ok(Self { clip, moments, topics })
    }

    /// Returns the clip as described by its line.
    pub fn clip(&self) -> &Clip {
        &self.clip
    }

    /// Returns the triggers and commands of the clip, or as many as were kept.
    pub fn moments(&self) -> &[Moment] {
        &self.moments
    }

    /// Returns the first statement that the messages of the clip, which is the file `path`,
    /// contradict.
    ///
    /// # Errors
    ///
    /// [`RecordError::Unreadable`] and [`RecordError::Topic`] if the messages cannot be read.
    pub fn contradicted(&self, path: &Path) -> Result<Option<ClaimMismatch>, RecordError> {
        let written = read::written(path)?;
        Ok(self.compare(&written).err())
    }

    fn compare(&self, written: &Written) -> Result<(), ClaimMismatch> {
        if let Some(found) =
            written.topics().iter().find(|found| !self.topics.contains_key(&found.name))
        {
            let what = format!("record {TOPIC_RECORD} of `{}`", excerpt(&found.name));
            return Err(ClaimMismatch::count(what, 0, 1));
        }
        for topic in &self.clip.topics {
            let found = written.topic(&topic.topic);
            let messages = found.map_or(0, |found| found.messages);
            let received = || {
                topic.received?;
                Some(messages.saturating_add(topic.overwritten?).saturating_add(topic.too_big?))
            };
            let expected = ClipTopic {
                type_name: found.map(|found| found.type_name.clone()),
                messages,
                received: received(),
                ..topic.clone()
            };
            let (_, expected) = clip_records::topic(&expected, found);
            let name = excerpt(&topic.topic);
            let what = format!("record {TOPIC_RECORD} of `{name}`");
            same(&what, &self.topics[&topic.topic], &expected)?;
            let what = format!("{LINE} of record {CLIP_RECORD}, topic `{name}`");
            same(&what, &clip_records::topic(topic, found).1, &expected)?;
        }
        let (first_ns, last_ns) = written.span.unzip();
        let stamp = |ns: Option<i64>| ns.map_or("none".to_owned(), |ns| ns.to_string());
        let Clip { from_ns, to_ns, .. } = self.clip;
        for (key, stated, found, is_false) in [
            ("first_ns", self.clip.first_ns, first_ns, self.clip.first_ns != first_ns),
            ("last_ns", self.clip.last_ns, last_ns, self.clip.last_ns != last_ns),
            ("from_ns", Some(from_ns), first_ns, first_ns.is_some_and(|first| first < from_ns)),
            ("to_ns", Some(to_ns), last_ns, last_ns.is_some_and(|last| last > to_ns)),
        ] {
            if is_false {
                return Err(ClaimMismatch::new(in_clip(key), &stamp(stated), &stamp(found)));
            }
        }
        Ok(())
    }
}

fn in_clip(key: &str) -> String {
    format!("`{key}` of record {CLIP_RECORD}")
}

/// Returns the program that wrote a clip, from the header of a journal by the same program.
fn library(header: &JournalHeader) -> String {
    format!("gleaner {}", header.gleaner)
}

/// Rejects a record whose values differ from `expected`.
fn same(record: &str, stated: &Values, expected: &Values) -> Result<(), ClaimMismatch> {
    let value = |values: &Values, key: &str| values.get(key).cloned();
    let keys = stated.keys().chain(expected.keys().filter(|key| !stated.contains_key(*key)));
    for key in keys {
        let (stated, expected) = (value(stated, key), value(expected, key));
        if stated != expected {
            let text = |value: Option<String>| value.unwrap_or_else(|| "missing".to_owned());
            return Err(ClaimMismatch::new(
                format!("`{}` of {record}", excerpt(key)),
                &text(stated),
                &text(expected),
            ));
        }
    }
    Ok(())
}

fn malformed(record: &str, key: &str, values: &Values) -> ClaimMismatch {
    let stated = values.get(key).map_or("missing", String::as_str);
    ClaimMismatch::new(
        format!("`{key}` of record {record}"),
        stated,
        "a value in the format of recorders",
    )
}

fn clip(
    values: &Values,
    attachments: &[Attachment],
    header: &JournalHeader,
) -> Result<Clip, ClaimMismatch> {
    let line = values.get(LINE).map_or("", String::as_str);
    let of_line = |expected: &str| ClaimMismatch::new(in_clip(LINE), line, expected);
    let clip = serde_json::from_str::<Clip>(line).map_err(|error| of_line(&error.to_string()))?;
    if json(&clip) != line {
        return Err(of_line(&json(&clip)));
    }
    let base =
        plain_name(&clip.file, CLIP).and_then(|name| name.strip_suffix(CLIP).map(str::to_owned));
    let base = base.ok_or_else(|| {
        ClaimMismatch::new(in_clip("file"), &clip.file.to_string_lossy(), "clips/NAME.mcap")
    })?;
    let thumbnail = attachments.iter().find(|attachment| attachment.name == THUMBNAIL);
    let picture = thumbnail.map(|_| format!("{CLIPS}/{base}{JPG}"));
    let stated = clip.thumbnail.as_ref().map(|path| path.to_string_lossy().into_owned());
    if stated != picture {
        let text = |path: Option<String>| path.unwrap_or_else(|| "none".to_owned());
        let what =
            format!("`thumbnail` in {LINE} of record {CLIP_RECORD}, by attachment `{THUMBNAIL}`");
        return Err(ClaimMismatch::new(what, &text(stated), &text(picture)));
    }
    if clip.bytes != 0 {
        return Err(ClaimMismatch::new(
            format!("`bytes` in {LINE} of record {CLIP_RECORD}"),
            &clip.bytes.to_string(),
            "0",
        ));
    }
    let picture = thumbnail.map(|attachment| attachment.data.as_slice());
    let (_, expected) =
        clip_records::about_clip(&clip, &header.clock, &library(header), picture, None);
    same(&format!("record {CLIP_RECORD}"), values, &expected)?;
    Ok(clip)
}

/// Rejects attachments other than one journal of each lambda, one thumbnail and one signature,
/// which is checked on request only, by the keys that a user trusts.
fn attachments(attachments: &[Attachment], clip: &Clip) -> Result<(), ClaimMismatch> {
    let mut known = BTreeSet::from([THUMBNAIL, SIGNATURE].map(str::to_owned));
    for lambda in &clip.lambdas {
        // A restarted lambda has another journal.
        let mut journals = names(&lambda.name).map(|name| clip_records::journal(&name));
        known.extend(journals.find(|journal| !known.contains(journal)));
    }
    let mut found = BTreeSet::new();
    for attachment in attachments {
        let what = || format!("attachment `{}`", excerpt(&attachment.name));
        if !known.contains(&attachment.name) {
            return Err(ClaimMismatch::new(what(), "present", "not written by recorders"));
        }
        if !found.insert(attachment.name.as_str()) {
            return Err(ClaimMismatch::count(what(), 2, 1));
        }
    }
    Ok(())
}

fn lambdas(records: &[&Values], clip: &Clip, header: &JournalHeader) -> Result<(), ClaimMismatch> {
    if records.len() != clip.lambdas.len() {
        return Err(ClaimMismatch::count(
            format!("record {LAMBDA_RECORD}"),
            records.len(),
            clip.lambdas.len(),
        ));
    }
    if clip.lambdas.len() > LAMBDAS_MAX {
        let what = format!("number of lambdas in {LINE} of record {CLIP_RECORD}");
        return Err(ClaimMismatch::new(
            what,
            &clip.lambdas.len().to_string(),
            &format!("{LAMBDAS_MAX} at most"),
        ));
    }
    if !clip.lambdas.iter().any(|lambda| lambda.name == header.lambda) {
        let stated =
            clip.lambdas.iter().map(|lambda| lambda.name.as_str()).collect::<Vec<_>>().join(", ");
        return Err(ClaimMismatch::new(
            format!("lambdas in {LINE} of record {CLIP_RECORD}"),
            &stated,
            &header.lambda,
        ));
    }
    for (values, lambda) in records.iter().zip(&clip.lambdas) {
        let record = format!("record {LAMBDA_RECORD} of `{}`", excerpt(&lambda.name));
        let (expected_lambda, header) = match lambda.name == header.lambda {
            true => (by_header(lambda, header), Some(header)),
            false => (lambda.clone(), None),
        };
        let (_, mut expected) = clip_records::lambda(&expected_lambda, header);
        if header.is_none() {
            // The journal of this lambda has no other source.
            for (key, value) in &mut expected {
                let stated = values.get(key).filter(|_| {
                    !["name", "version", "kind", "digest", "windows"].contains(&key.as_str())
                });
                value.clone_from(stated.unwrap_or(&value.clone()));
            }
        }
        same(&record, values, &expected)?;
        let what = format!("{LINE} of record {CLIP_RECORD}, lambda `{}`", excerpt(&lambda.name));
        same(
            &what,
            &clip_records::lambda(lambda, header).1,
            &clip_records::lambda(&expected_lambda, header).1,
        )?;
    }
    Ok(())
}

fn by_header(lambda: &ClipLambda, header: &JournalHeader) -> ClipLambda {
    let digest = lambda_digest(&header.files);
    ClipLambda { version: header.version.clone(), kind: header.kind, digest, ..lambda.clone() }
}

fn moment(values: &Values) -> Result<Moment, ClaimMismatch> {
    let moment = clip_records::read_decision(values)
        .map_err(|key| malformed(DECISION_RECORD, key, values))?;
    let record = format!("record {DECISION_RECORD} at {} ns", moment.at_ns);
    same(&record, values, &clip_records::decision(&moment).1)?;
    Ok(moment)
}

/// Compares the decisions with the line, which has the first of them. Their number is compared with
/// the journal later.
fn decisions(moments: &[Moment], clip: &Clip) -> Result<(), ClaimMismatch> {
    let kept = &moments[..moments.len().min(Clip::MOMENTS_MAX)];
    let of_line = format!("moments in {LINE} of record {CLIP_RECORD}");
    for (index, (record, line)) in kept.iter().zip(&clip.moments).enumerate() {
        if let Some((key, [record, line])) = record.differs_from(line) {
            let what = format!(
                "`{key}` of record {DECISION_RECORD} number {}, by the {of_line}",
                index + 1
            );
            return Err(ClaimMismatch::new(what, &record, &line));
        }
    }
    if kept.len() != clip.moments.len() {
        let what = format!("number of records {DECISION_RECORD}, by the {of_line}");
        return Err(ClaimMismatch::new(
            what,
            &kept.len().to_string(),
            &clip.moments.len().to_string(),
        ));
    }
    if (moments.len() as u64) > clip.triggers {
        return Err(ClaimMismatch::new(
            in_clip("triggers"),
            &clip.triggers.to_string(),
            &moments.len().to_string(),
        ));
    }
    let outside =
        moments.iter().find(|moment| !(clip.from_ns..=clip.to_ns).contains(&moment.at_ns));
    outside.map_or(Ok(()), |moment| {
        let window = format!("{} to {}", clip.from_ns, clip.to_ns);
        Err(ClaimMismatch::new(
            format!("`at_ns` of record {DECISION_RECORD}"),
            &moment.at_ns.to_string(),
            &window,
        ))
    })
}

/// Compares the record before the messages: later windows may have added lambdas and windows since.
/// Triggers of several lambdas may come out of order, so a later window may also reach further
/// back.
fn begin(
    values: &Values,
    clip: &Clip,
    moments: &[Moment],
    header: &JournalHeader,
) -> Result<(), ClaimMismatch> {
    let clip_header =
        clip_records::read_begin(values).map_err(|key| malformed(BEGIN, key, values))?;
    let latest = if clip.lambdas.len() > 1 { clip.to_ns } else { clip.from_ns };
    let from_ns = clip_header.from_ns.min(latest).max(clip.from_ns);
    let expected = ClipHeader { clock: header.clock.clone(), from_ns, ..clip_header };
    same(&format!("record {BEGIN}"), values, &clip_records::begin(&expected, &library(header)).1)?;
    let was_there = |lambda: &ClipLambda| {
        clip.lambdas.iter().any(|now| {
            lambda.windows <= now.windows
                && *lambda == ClipLambda { windows: lambda.windows, ..now.clone() }
        })
    };
    let max_count = clip.lambdas.len();
    if let Some(lambda) = expected
        .lambdas
        .iter()
        .enumerate()
        .find_map(|(n, lambda)| (n >= max_count || !was_there(lambda)).then_some(lambda))
    {
        return Err(ClaimMismatch::new(
            format!("`lambdas` of record {BEGIN}"),
            &json(lambda),
            &json(&clip.lambdas),
        ));
    }
    let opening = json(&expected.moment);
    let is_of_another_clip = clip.incomplete.iter().any(|why| why == CONTINUES);
    let is_among_them = || moments.iter().any(|moment| json(moment) == opening);
    if is_of_another_clip || (moments.len() as u64) < clip.triggers || is_among_them() {
        return Ok(());
    }
    let first = moments.first().map_or("none".to_owned(), json);
    Err(ClaimMismatch::new(format!("`moment` of record {BEGIN}"), &opening, &first))
}

/// Returns the records of the topics: one for each topic of the line.
fn topics<'a>(
    records: impl Iterator<Item = &'a Values>,
    clip: &Clip,
) -> Result<BTreeMap<String, Values>, ClaimMismatch> {
    let what = |topic: &str| format!("record {TOPIC_RECORD} of `{}`", excerpt(topic));
    let mut topics = BTreeMap::new();
    for values in records {
        let topic = values.get("topic").ok_or_else(|| malformed(TOPIC_RECORD, "topic", values))?;
        if topics.insert(topic.clone(), values.clone()).is_some() {
            return Err(ClaimMismatch::count(what(topic), 2, 1));
        }
    }
    let mut named = BTreeSet::new();
    for topic in &clip.topics {
        if !named.insert(topic.topic.as_str()) {
            let what =
                format!("topic `{}` in {LINE} of record {CLIP_RECORD}", excerpt(&topic.topic));
            return Err(ClaimMismatch::count(what, 2, 1));
        }
        if !topics.contains_key(&topic.topic) {
            return Err(ClaimMismatch::count(what(&topic.topic), 0, 1));
        }
    }
    match topics.keys().find(|topic| !named.contains(topic.as_str())) {
        Some(topic) => Err(ClaimMismatch::count(what(topic), 1, 0)),
        None => Ok(topics),
    }
}
