//! The first and the last block of a journal: its origin and its end.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use gleaner_base::text::{excerpt, visible};
use gleaner_lambda::manifest::{LambdaKind, Limits};

/// The origin of the decisions of a journal: its first block, as JSON.
///
/// Newer writers may add keys; readers ignore unknown ones.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct JournalHeader {
    /// Version of Gleaner that wrote it.
    pub gleaner: String,
    /// The engine of the lambda, for example `wasmtime 48.0.8` or `Python 3.12.3, numpy 2.1.0`.
    pub engine: String,
    /// The machine's architecture, for example `x86_64`.
    pub machine: String,
    pub lambda: String,
    pub version: String,
    pub kind: LambdaKind,
    /// The files of the lambda's build folder, by path.
    pub files: Vec<FileDigest>,
    pub models: Vec<FileDigest>,
    /// SHA-256 of the parts of the manifest on which a decision can depend, in hexadecimal digits:
    /// without `[record]` and descriptions, so that a clip can be verified after its preroll was
    /// tuned, and without `[limits]`, which are below.
    pub manifest: String,
    /// Effective limits of the lambda: those of the manifest, where the vehicle did not reduce
    /// them.
    #[serde(default)]
    pub limits: Limits,
    /// Inputs of the lambda, in the order of the manifest.
    pub inputs: Vec<JournalInput>,
    /// Index of the input that wakes the lambda; `None` for a periodic lambda.
    pub event_input: Option<usize>,
    /// Effective config of the lambda, in the order of the manifest.
    pub config: Map<String, Value>,
    /// Remapped topics, from and to.
    pub remaps: Vec<(String, String)>,
    /// The clock of all times, for example `log time of the drive`.
    pub clock: String,
    #[serde(default, skip_serializing_if = "TimeRange::is_all")]
    pub part: TimeRange,
    /// Number of wakes before the first one here: 0, except for the part of a journal in a clip.
    pub wakes_before: u64,
}

/// A range of log times of a drive, in ns since 1970.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimeRange {
    /// Start, inclusive; `None` for the start of the drive.
    pub from_ns: Option<i64>,
    /// End, exclusive; `None` for the end of the drive.
    pub to_ns: Option<i64>,
}

impl TimeRange {
    /// Returns whether it is the whole drive.
    pub fn is_all(&self) -> bool {
        *self == TimeRange::default()
    }

    fn describe(self) -> String {
        let time = |ns: Option<i64>, all: &str| ns.map_or(all.to_owned(), |ns| format!("{ns} ns"));
        format!("from {} to {}", time(self.from_ns, "its start"), time(self.to_ns, "its end"))
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct FileDigest {
    /// Path relative to the build folder.
    pub path: String,
    pub bytes: u64,
    /// SHA-256 of the file, in hexadecimal digits.
    pub sha256: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct JournalInput {
    /// Name of the input in the lambda's code.
    pub name: String,
    /// The topic, as the manifest names it.
    pub topic: String,
    /// The topic after remapping.
    pub wire_topic: String,
    pub type_name: String,
}

/// The last block of a complete journal, as JSON.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct JournalEnd {
    pub wakes: u64,
    /// Number of samples that arrived, for each input.
    pub samples: Vec<u64>,
    pub drives: Vec<DriveDigest>,
}

/// A file of a drive and its checksum. A CRC is enough to notice a changed file, and costs a replay
/// 1 or 2 %; a SHA-256 would cost 15 %.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct DriveDigest {
    /// Name of the file, without its folder.
    pub name: String,
    pub bytes: u64,
    /// CRC-32 of the whole file.
    pub crc32: u32,
}

/// A difference between a journal and a repetition of its run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The compared item, for example ``build file `main.py` ``.
    pub what: String,
    pub journal: String,
    pub now: String,
}

/// Returns the difference of `what`, if the two sides are not the same text.
pub(crate) fn differs(
    what: impl Into<String>,
    journal: impl ToString,
    now: impl ToString,
) -> Option<Difference> {
    let (journal, now) = (journal.to_string(), now.to_string());
    (journal != now).then(|| Difference {
        what: what.into(),
        journal: visible(&journal),
        now: visible(&now),
    })
}

impl JournalHeader {
    /// Returns the most significant difference between the origin of this journal and `now`; `None`
    /// if build, config and inputs are equal, so that they do not explain a differing decision.
    ///
    /// `gleaner`, `engine`, `machine` and `wakes_before` are not compared: decisions should not
    /// depend on them.
    pub fn differs_from(&self, now: &JournalHeader) -> Option<Difference> {
        let manifest = "manifest lambda.toml, less [record] and [limits]";
        differs("lambda", &self.lambda, &now.lambda)
            .or_else(|| differs("version of the lambda", &self.version, &now.version))
            .or_else(|| differs("kind of the lambda", self.kind.as_str(), now.kind.as_str()))
            .or_else(|| files_differ("build file", &self.files, &now.files))
            .or_else(|| differs(manifest, &self.manifest, &now.manifest))
            .or_else(|| limits_differ(&self.limits, &now.limits))
            .or_else(|| files_differ("model", &self.models, &now.models))
            .or_else(|| config_differs(&self.config, &now.config))
            .or_else(|| inputs_differ(&self.inputs, &now.inputs))
            .or_else(|| differs("schedule of the lambda", self.woken_by(), now.woken_by()))
            .or_else(|| differs("remapped topics", self.remaps_in_words(), now.remaps_in_words()))
            .or_else(|| differs("clock", &self.clock, &now.clock))
            .or_else(|| differs("part of the drive", self.part.describe(), now.part.describe()))
    }

    fn woken_by(&self) -> String {
        let Some(index) = self.event_input else { return "the clock".to_owned() };
        let name = self.inputs.get(index).map_or("none", |input| &input.name);
        format!("samples of input `{name}`")
    }

    fn remaps_in_words(&self) -> String {
        let remaps: Vec<_> =
            self.remaps.iter().map(|(from, to)| format!("{from} is {to}")).collect();
        if remaps.is_empty() { "none".to_owned() } else { remaps.join(", ") }
    }
}

const MISSING: &str = "missing";

fn files_differ(what: &str, journal: &[FileDigest], now: &[FileDigest]) -> Option<Difference> {
    let by_path = |files: &'_ [FileDigest]| -> BTreeMap<String, String> {
        files.iter().map(|file| (file.path.clone(), file.sha256.clone())).collect()
    };
    let (journal, now) = (by_path(journal), by_path(now));
    // The relevant parts of the manifest have a digest of their own.
    let mut paths: Vec<_> =
        journal.keys().chain(now.keys()).filter(|path| *path != "lambda.toml").collect();
    paths.sort();
    paths.into_iter().find_map(|path| {
        let (journal, now) = (journal.get(path), now.get(path));
        if journal == now {
            return None;
        }
        // Sixteen digits show the difference, unless they were made equal on purpose.
        let start = |digest: &String| digest.get(..16).map(str::to_owned);
        let cut = journal.and_then(start) != now.and_then(start);
        let side = |digest: Option<&String>| match digest {
            None => MISSING.to_owned(),
            Some(digest) if cut && digest.len() > 16 => {
                format!("sha256 {}…", start(digest).unwrap_or_else(|| digest.clone()))
            }
            Some(digest) => format!("sha256 {digest}"),
        };
        differs(format!("{what} `{}`", excerpt(path)), side(journal), side(now))
    })
}

fn limits_differ(journal: &Limits, now: &Limits) -> Option<Difference> {
    let mut pairs = journal.describe().into_iter().zip(now.describe());
    pairs.find_map(|((key, journal), (_, now))| differs(format!("limit `{key}`"), journal, now))
}

/// Compares config values as text, so that `-0.0` differs from `0.0`, and 1 from 1.0.
fn config_differs(journal: &Map<String, Value>, now: &Map<String, Value>) -> Option<Difference> {
    let text = |value: Option<&Value>| value.map_or_else(|| MISSING.to_owned(), Value::to_string);
    let keys = journal.keys().chain(now.keys().filter(|key| !journal.contains_key(*key)));
    let mut sides = keys.map(|key| (key, text(journal.get(key)), text(now.get(key))));
    sides
        .find_map(|(key, journal, now)| differs(format!("config `{}`", excerpt(key)), journal, now))
}

fn inputs_differ(journal: &[JournalInput], now: &[JournalInput]) -> Option<Difference> {
    let side = |input: &JournalInput| {
        let JournalInput { name, topic, wire_topic, type_name } = input;
        let from = if wire_topic == topic { String::new() } else { format!(", from {wire_topic}") };
        format!("`{name}`: {topic}{from}, {type_name}")
    };
    let mut pairs = journal.iter().zip(now);
    differs("number of inputs", journal.len(), now.len())
        .or_else(|| pairs.find_map(|(journal, now)| differs("input", side(journal), side(now))))
}
