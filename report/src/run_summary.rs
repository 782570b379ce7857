//! Reads `summary.json` of a replay or of a live run, and `signals.json`.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{ByteSize, Exit, Explain, NotPlain, PlainFile};
use gleaner_lambda::manifest::{ConfigValue, LambdaKind};
use gleaner_lambda::results::{SIGNALS_MAX, SUMMARY_MAX};
use gleaner_lambda::signals::{Curve, Signals};
use gleaner_protocol::link::{RecordedTopic, RecorderStatus};
use gleaner_protocol::{LiveStatus, RecordingCounts, ReplaySummary};
use serde::de::DeserializeOwned;

use crate::format::cut;
use crate::results::ResultsError;

/// Maximum number of topics in a summary. A lambda has fewer, but the file is untrusted.
const TOPICS_MAX: usize = 256;
const DRIVES_MAX: usize = 50;
const NAME_CHARS: usize = 300;
const CONFIG_MAX: usize = 200;
/// Maximum number of characters of a reason or an error.
const WHY_CHARS: usize = 2_000;

#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    #[error("`{}` does not hold results", out.display())]
    None {
        out: PathBuf,
        /// Subfolders that hold results.
        inside: Vec<PathBuf>,
        source: FileError,
    },
    #[error("`{}` is not a result file of this gleaner", path.display())]
    Invalid { path: PathBuf, source: FileError },
    #[error(transparent)]
    Lines(#[from] ResultsError),
}

#[derive(Debug, thiserror::Error)]
pub enum FileError {
    #[error("cannot read `{name}`")]
    Read { name: &'static str, source: io::Error },
    #[error("cannot parse `{name}`")]
    Json { name: &'static str, source: serde_json::Error },
}

impl FileError {
    /// Returns whether the file is a link or a pipe, or too long. No run writes such a file.
    fn is_suspicious(&self) -> bool {
        matches!(self, Self::Read { source, .. } if NotPlain::of(source).is_some())
    }

    fn is_absent(&self) -> bool {
        matches!(self, Self::Read { source, .. } if source.kind() == io::ErrorKind::NotFound)
    }
}

impl Explain for OutputError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::None { inside, .. } if !inside.is_empty() => {
                let names: Vec<_> =
                    inside.iter().map(|folder| format!("`{}`", folder.display())).collect();
                format!("name one of its subfolders: {}", names.join(", "))
            }
            Self::None { .. } => {
                "name the result folder of `gleaner replay` or `gleaner run`; it has a \
                 summary.json when they have ended"
                    .to_owned()
            }
            Self::Lines(error) => return error.help(),
            Self::Invalid { .. } => "replay again with this version of gleaner".to_owned(),
        })
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

#[derive(Debug)]
pub(crate) enum RunSummary {
    Replay(Box<ReplaySummary>),
    Live(Box<LiveStatus>),
}

#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub(crate) struct TopicCounts {
    pub(crate) input: String,
    pub(crate) topic: String,
    pub(crate) type_name: String,
    pub(crate) received: u64,
    /// Lost upstream; `None` if unknown.
    pub(crate) lost: Option<u64>,
    pub(crate) no_slot: u64,
    pub(crate) too_big: u64,
    /// Live only.
    pub(crate) malformed: Option<u64>,
    /// Evicted from the ring by newer samples. That is no loss.
    pub(crate) overwritten: u64,
}

impl RunSummary {
    fn of(out: &Path) -> Result<Self, OutputError> {
        let text = match read_bounded(out, "summary.json", SUMMARY_MAX) {
            Ok(text) => text,
            Err(source) if source.is_absent() => {
                return Err(OutputError::None {
                    out: out.to_owned(),
                    inside: outputs_in(out),
                    source,
                });
            }
            Err(source) => {
                return Err(OutputError::Invalid { path: out.join("summary.json"), source });
            }
        };
        // A key that only live summaries have decides, so that parse errors are about the right
        // type.
        let is_live = serde_json::from_slice::<serde_json::Value>(&text)
            .is_ok_and(|value| value.get("up_s").is_some());
        let summary = if is_live {
            parsed("summary.json", &text).map(Self::Live)
        } else {
            parsed("summary.json", &text).map(Self::Replay)
        };
        summary.map_err(|source| OutputError::Invalid { path: out.join("summary.json"), source })
    }

    /// Reads the summary as `of`, cut to what fits on a page. Adds to `notes` what is omitted.
    pub(crate) fn bounded(out: &Path, notes: &mut Vec<String>) -> Result<Self, OutputError> {
        let mut run = Self::of(out)?;
        let mut note_omitted = |what: &str, found: usize, max: usize| {
            if found > max {
                notes.push(format!("`summary.json`: {} of {found} {what} omitted", found - max));
            }
        };
        match &mut run {
            Self::Replay(summary) => {
                note_omitted("drives", summary.drive.len(), DRIVES_MAX);
                note_omitted("topics", summary.topics.len(), TOPICS_MAX);
                summary.drive.truncate(DRIVES_MAX);
                summary
                    .drive
                    .iter_mut()
                    .for_each(|drive| *drive = cut(&drive.to_string_lossy(), NAME_CHARS).into());
                summary.damaged = summary.damaged.as_deref().map(|why| cut(why, WHY_CHARS));
                summary.stopped = summary.stopped.as_deref().map(|why| cut(why, WHY_CHARS));
                summary.topics.truncate(TOPICS_MAX);
                let topics = summary.topics.iter_mut();
                let names = topics
                    .flat_map(|topic| [&mut topic.name, &mut topic.topic, &mut topic.type_name]);
                shorten(names.chain([&mut summary.lambda, &mut summary.version]));
            }
            Self::Live(live) => {
                note_omitted("topics", live.topics.len(), TOPICS_MAX);
                live.topics.truncate(TOPICS_MAX);
                let topics = live.topics.iter_mut();
                let names = topics.flat_map(|topic| {
                    [&mut topic.name, &mut topic.topic, &mut topic.type_name]
                        .into_iter()
                        .chain(&mut topic.qos_warnings)
                });
                shorten(names.chain([&mut live.lambda, &mut live.version]));
            }
        }
        Ok(run)
    }

    /// Returns name, version and kind of the lambda.
    pub(crate) fn lambda(&self) -> (&str, &str, LambdaKind) {
        match self {
            Self::Replay(summary) => (&summary.lambda, &summary.version, summary.kind),
            Self::Live(live) => (&live.lambda, &live.version, live.kind),
        }
    }

    /// Returns the numbers of wakes, triggers and faults.
    pub(crate) fn wakes(&self) -> [(&'static str, u64); 3] {
        let [wakes, triggers, faults] = match self {
            Self::Replay(summary) => [summary.wakes, summary.triggers, summary.faults],
            Self::Live(live) => [live.wakes, live.triggers, live.faults],
        };
        [("wakes", wakes), ("triggers", triggers), ("faults", faults)]
    }

    /// Returns the counts of losses and omissions, except samples of topics.
    pub(crate) fn missed(&self) -> Vec<(&'static str, u64)> {
        let shared = |skipped, ticks, log, refused, backed_off| {
            vec![
                ("event samples skipped", skipped),
                ("ticks missed", ticks),
                ("log lines over the rate limit", log),
                ("triggers refused, over `events_per_minute`", refused),
                ("wakes skipped while backing off after faults", backed_off),
            ]
        };
        match self {
            Self::Replay(summary) => {
                let mut counts = shared(
                    summary.skipped,
                    summary.missed_ticks,
                    summary.log_dropped,
                    summary.triggers_refused,
                    summary.backed_off,
                );
                counts.push(("messages out of order in the drive", summary.out_of_order));
                counts.push(("malformed messages of the drive", summary.malformed.values().sum()));
                counts.extend(by_cause(&summary.recording));
                counts
            }
            Self::Live(live) => {
                let mut counts = shared(
                    live.skipped,
                    live.missed_ticks,
                    live.log_dropped,
                    live.triggers_refused,
                    live.backed_off,
                );
                counts.push(("decisions and log lines not written", live.unwritten));
                counts.push(("messages not sent, of `--rtt` and `--decisions`", live.unsent));
                counts.push(("datagrams dropped, socket buffer full", live.network.socket_drops));
                counts.push(("hostile datagrams dropped", live.network.filtered));
                counts.extend(live.recorder_link.iter().flat_map(|recorder| {
                    [
                        ("wakes not sent to the recorder", recorder.wakes_dropped),
                        ("triggers not sent to the recorder", recorder.triggers_lost),
                        ("ends of the recorder", recorder.recorders_ended),
                    ]
                }));
                counts.extend(live.recording.iter().flat_map(|status| recorded(status)));
                counts
            }
        }
    }

    pub(crate) fn topics(&self) -> Vec<TopicCounts> {
        match self {
            Self::Replay(summary) => summary.topics.iter().map(TopicCounts::from).collect(),
            Self::Live(live) => live.topics.iter().map(TopicCounts::from).collect(),
        }
    }
}

/// Returns the counts of what a recorder did not record, by cause.
fn by_cause(recording: &RecordingCounts) -> impl Iterator<Item = (&'static str, u64)> {
    recording.by_cause().into_iter().map(|counted| (counted.label, counted.count))
}

/// Returns the counts of what a live recorder did not record, with the losses of the network.
fn recorded(status: &RecorderStatus) -> Vec<(&'static str, u64)> {
    let sum = |count: fn(&RecordedTopic) -> u64| {
        status.topics.iter().map(count).fold(0, u64::saturating_add)
    };
    let (network, commands) = (status.network.as_ref(), status.commands.as_ref());
    let mut counts: Vec<_> = by_cause(&status.recording).collect();
    counts.extend([
        ("samples to record, lost upstream", sum(|topic| topic.lost.unwrap_or(0))),
        ("samples to record, no free slot: recorder busy", sum(|topic| topic.no_slot)),
        ("samples to record, larger than the recorder accepts", sum(|topic| topic.too_big)),
        ("samples to record, malformed", sum(|topic| topic.malformed)),
        ("commands refused", commands.map_or(0, |commands| commands.refused)),
        (
            "datagrams dropped, socket buffer of the recorder full",
            network.map_or(0, |network| network.socket_drops),
        ),
        (
            "hostile datagrams dropped by the recorder",
            network.map_or(0, |network| network.filtered),
        ),
    ]);
    counts
}

fn shorten<'a>(texts: impl Iterator<Item = &'a mut String>) {
    texts.for_each(|text| *text = cut(text, NAME_CHARS));
}

impl From<&gleaner_protocol::TopicReport> for TopicCounts {
    fn from(topic: &gleaner_protocol::TopicReport) -> Self {
        Self {
            input: topic.name.clone(),
            topic: topic.topic.clone(),
            type_name: topic.type_name.clone(),
            received: topic.received,
            lost: topic.lost,
            no_slot: topic.no_slot,
            too_big: topic.too_big,
            malformed: None,
            overwritten: topic.overwritten,
        }
    }
}

impl From<&gleaner_protocol::LiveTopic> for TopicCounts {
    fn from(topic: &gleaner_protocol::LiveTopic) -> Self {
        Self {
            input: topic.name.clone(),
            topic: topic.topic.clone(),
            type_name: topic.type_name.clone(),
            received: topic.received,
            lost: topic.lost,
            no_slot: topic.no_slot,
            too_big: topic.too_big,
            malformed: Some(topic.malformed),
            overwritten: topic.overwritten,
        }
    }
}

/// Reads `signals.json`, the fields that the lambda read; `None` if the file is missing, as after a
/// live run.
///
/// Lists beyond their bounds are cut, and inconsistent curves are omitted. Both is added to
/// `notes`.
///
/// # Errors
///
/// [`OutputError::Invalid`] if the file is a link or a pipe, or too long.
pub(crate) fn signals(out: &Path, notes: &mut Vec<String>) -> Result<Option<Signals>, OutputError> {
    let read = read_bounded(out, "signals.json", SIGNALS_MAX)
        .and_then(|text| parsed::<Signals>("signals.json", &text));
    let mut signals = match read {
        Ok(signals) => signals,
        Err(error) if error.is_absent() => return Ok(None),
        Err(source) if source.is_suspicious() => {
            return Err(OutputError::Invalid { path: out.join("signals.json"), source });
        }
        Err(error) => {
            // The error may quote a text of the file.
            notes.push(cut(&describe(&error), WHY_CHARS));
            return Ok(None);
        }
    };
    let found = signals.curves.len();
    signals.curves.truncate(Signals::CURVES_MAX);
    signals.curves.retain(is_consistent);
    let dropped = found - signals.curves.len();
    if dropped > 0 {
        notes.push(format!("`signals.json`: {dropped} of {found} inconsistent curves omitted"));
    }
    signals.pictures.truncate(Signals::PICTURES_MAX);
    Ok(Some(signals))
}

/// Cuts a config to what fits on a page. [`Diff`](crate::Diff) compares it whole.
pub(crate) fn shown_config(
    config: &BTreeMap<String, ConfigValue>,
    notes: &mut Vec<String>,
) -> BTreeMap<String, ConfigValue> {
    if config.len() > CONFIG_MAX {
        notes.push(format!(
            "`signals.json`: {} of {} config values omitted",
            config.len() - CONFIG_MAX,
            config.len()
        ));
    }
    let value = |value: &ConfigValue| match value {
        ConfigValue::Text(text) => ConfigValue::Text(cut(text, NAME_CHARS)),
        other => other.clone(),
    };
    config.iter().take(CONFIG_MAX).map(|(key, set)| (cut(key, NAME_CHARS), value(set))).collect()
}

fn is_consistent(curve: &Curve) -> bool {
    let points = curve.at_ns.len();
    points <= Signals::POINTS_MAX && curve.min.len() == points && curve.max.len() == points
}

/// Formats an error and its causes in one line.
pub(crate) fn describe(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        text = format!("{text}: {error}");
        source = error.source();
    }
    text
}

fn parsed<T: DeserializeOwned>(name: &'static str, text: &[u8]) -> Result<T, FileError> {
    serde_json::from_slice(text).map_err(|source| FileError::Json { name, source })
}

fn read_bounded(out: &Path, name: &'static str, max: ByteSize) -> Result<Vec<u8>, FileError> {
    let read = PlainFile::result(&out.join(name), max).and_then(PlainFile::read_whole);
    read.map_err(|source| FileError::Read { name, source })
}

/// Returns the subfolders of `out` that hold results: a vehicle has one for each lambda.
fn outputs_in(out: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(out).into_iter().flatten().flatten();
    let mut folders: Vec<_> = entries
        .map(|entry| entry.path())
        .filter(|path| path.join("summary.json").is_file())
        .take(8)
        .collect();
    folders.sort();
    folders
}
