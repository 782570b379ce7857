//! What the files of an output tell as a whole: `summary.json` of a replay or of a live run, and
//! `signals.json`.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{ByteSize, Exit, Explain, NotPlain, PlainFile};
use gleaner_lambda::manifest::{ConfigValue, Kind};
use gleaner_lambda::results::{SIGNALS_MAX, SUMMARY_MAX};
use gleaner_lambda::signals::{Curve, Signals};
use gleaner_protocol::link::{RecordedTopic, RecorderStatus};
use gleaner_protocol::{Live, Recording, Summary};
use serde::de::DeserializeOwned;

use crate::results::ResultsError;
use crate::words::cut;

/// Most topics of a summary, and drives of it: a lambda has fewer, but the file may be by others.
/// Most characters of their names, and of what else a summary says in a word.
const TOPICS_MAX: usize = 256;
const DRIVES_MAX: usize = 50;
const NAME_CHARS: usize = 300;
/// Most values of a config.
const CONFIG_MAX: usize = 200;
/// Most characters of why something is not whole.
const WHY_CHARS: usize = 2_000;

/// Why a folder is no output.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// It has no `summary.json`.
    #[error("`{}` holds no results", out.display())]
    None {
        /// The folder.
        out: PathBuf,
        /// Folders in it that hold results.
        inside: Vec<PathBuf>,
        /// Why not.
        source: FileError,
    },
    /// Its `summary.json` or `signals.json` is none of ours.
    #[error("`{}` is not what gleaner writes", path.display())]
    Summary {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: FileError,
    },
    /// A file of lines that no run of ours has left so.
    #[error(transparent)]
    Lines(#[from] ResultsError),
}

/// Why a file of an output cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// It cannot be opened or read.
    #[error("cannot read `{name}`")]
    Read {
        /// Its name in the folder.
        name: &'static str,
        /// Why not.
        source: io::Error,
    },
    /// It is no JSON, or other JSON than ours.
    #[error("`{name}` cannot be understood")]
    Json {
        /// Its name in the folder.
        name: &'static str,
        /// Why not.
        source: serde_json::Error,
    },
}

impl FileError {
    /// Whether it is a link or a pipe, or too long: no run leaves such a file.
    fn is_no_result(&self) -> bool {
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
                let names: Vec<_> = inside.iter().map(|folder| format!("`{}`", folder.display())).collect();
                format!("name a folder inside of it: {}", names.join(", "))
            }
            Self::None { .. } => {
                "name the folder that `gleaner replay` or `gleaner run` wrote to; it has a summary.json once they have ended"
                    .to_owned()
            }
            Self::Lines(error) => return error.help(),
            Self::Summary { .. } => "replay again, with the gleaner that is to read it".to_owned(),
        })
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

/// What a run did as a whole.
#[derive(Debug)]
pub(crate) enum RunSummary {
    /// It was a replay.
    Replay(Box<Summary>),
    /// It was live.
    Live(Box<Live>),
}

/// A topic's samples, by what became of them.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub(crate) struct Losses {
    pub(crate) input: String,
    pub(crate) topic: String,
    pub(crate) type_name: String,
    pub(crate) received: u64,
    /// Before they reached us; `None` if nobody knows.
    pub(crate) lost: Option<u64>,
    pub(crate) no_slot: u64,
    pub(crate) too_big: u64,
    /// Live only.
    pub(crate) malformed: Option<u64>,
    /// Pushed out by newer ones: how a ring works, and no loss.
    pub(crate) overwritten: u64,
}

impl RunSummary {
    /// Reads `out/summary.json`.
    fn of(out: &Path) -> Result<Self, OutputError> {
        let text = match bounded(out, "summary.json", SUMMARY_MAX) {
            Ok(text) => text,
            Err(source) if source.is_absent() => {
                return Err(OutputError::None {
                    out: out.to_owned(),
                    inside: outputs_in(out),
                    source,
                });
            }
            Err(source) => {
                return Err(OutputError::Summary { path: out.join("summary.json"), source });
            }
        };
        // The two are told apart by a key that only one of them has, so that what is wrong with a
        // summary is said of the right one.
        let is_live = serde_json::from_slice::<serde_json::Value>(&text)
            .is_ok_and(|value| value.get("up_s").is_some());
        let told = if is_live {
            parsed("summary.json", &text).map(Self::Live)
        } else {
            parsed("summary.json", &text).map(Self::Replay)
        };
        told.map_err(|source| OutputError::Summary { path: out.join("summary.json"), source })
    }

    /// As `of`, within what a page has room for. What is left out is said in `notes`.
    pub(crate) fn bounded(out: &Path, notes: &mut Vec<String>) -> Result<Self, OutputError> {
        let mut told = Self::of(out)?;
        let mut left_out = |what: &str, found: usize, most: usize| {
            if found > most {
                notes.push(format!("`summary.json`: {} of {found} {what} left out", found - most));
            }
        };
        match &mut told {
            Self::Replay(summary) => {
                left_out("drives", summary.drive.len(), DRIVES_MAX);
                left_out("topics", summary.topics.len(), TOPICS_MAX);
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
                left_out("topics", live.topics.len(), TOPICS_MAX);
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
        Ok(told)
    }

    /// Name, version and kind of the lambda.
    pub(crate) fn lambda(&self) -> (&str, &str, Kind) {
        match self {
            Self::Replay(summary) => (&summary.lambda, &summary.version, summary.kind),
            Self::Live(live) => (&live.lambda, &live.version, live.kind),
        }
    }

    /// Wakes, triggers and faults.
    pub(crate) fn wakes(&self) -> [(&'static str, u64); 3] {
        let [wakes, triggers, faults] = match self {
            Self::Replay(summary) => [summary.wakes, summary.triggers, summary.faults],
            Self::Live(live) => [live.wakes, live.triggers, live.faults],
        };
        [("wakes", wakes), ("triggers", triggers), ("faults", faults)]
    }

    /// What did not happen or was thrown away, beside samples of topics.
    pub(crate) fn missed(&self) -> Vec<(&'static str, u64)> {
        let shared = |skipped, ticks, log, refused, passed| {
            vec![
                ("event samples that woke nobody", skipped),
                ("ticks missed", ticks),
                ("log lines over the rate limit", log),
                ("triggers refused, over `events_per_minute`", refused),
                ("wakes passed over after repeated faults", passed),
            ]
        };
        match self {
            Self::Replay(told) => {
                let mut counts = shared(
                    told.skipped,
                    told.missed_ticks,
                    told.log_dropped,
                    told.triggers_refused,
                    told.backed_off,
                );
                counts.push(("messages out of order in the drive", told.out_of_order));
                counts.extend(by_cause(&told.recording));
                counts
            }
            Self::Live(told) => {
                let mut counts = shared(
                    told.skipped,
                    told.missed_ticks,
                    told.log_dropped,
                    told.triggers_refused,
                    told.backed_off,
                );
                counts.push(("decisions and log lines not written", told.unwritten));
                counts.push(("messages not sent, of `--rtt` and `--decisions`", told.unsent));
                counts.push(("datagrams dropped by full sockets", told.network.socket_drops));
                counts.push(("hostile datagrams dropped", told.network.filtered));
                counts.extend(told.recorder.iter().flat_map(|recorder| {
                    [
                        ("wakes not told to the recorder", recorder.wakes_dropped),
                        ("triggers not told to the recorder", recorder.triggers_lost),
                    ]
                }));
                counts.extend(told.recording.iter().flat_map(|status| recorded(status)));
                counts
            }
        }
    }

    /// What became of the samples of each input.
    pub(crate) fn topics(&self) -> Vec<Losses> {
        match self {
            Self::Replay(summary) => summary.topics.iter().map(Losses::from).collect(),
            Self::Live(live) => live.topics.iter().map(Losses::from).collect(),
        }
    }
}

/// What a recorder did not record.
fn by_cause(recording: &Recording) -> impl Iterator<Item = (&'static str, u64)> {
    recording.by_cause().into_iter().map(|counted| (counted.label, counted.count))
}

/// The same live, where there is more on the way to it.
fn recorded(status: &RecorderStatus) -> Vec<(&'static str, u64)> {
    let sum = |count: fn(&RecordedTopic) -> u64| {
        status.topics.iter().map(count).fold(0, u64::saturating_add)
    };
    let (network, commands) = (status.network.as_ref(), status.commands.as_ref());
    let mut counts: Vec<_> = by_cause(&status.recording).collect();
    counts.extend([
        (
            "samples to be recorded, lost before they reached the recorder",
            sum(|topic| topic.lost.unwrap_or(0)),
        ),
        (
            "samples to be recorded, without room as the recorder was busy",
            sum(|topic| topic.no_slot),
        ),
        ("samples to be recorded, larger than the recorder can take", sum(|topic| topic.too_big)),
        ("samples to be recorded, malformed", sum(|topic| topic.malformed)),
        ("commands refused", commands.map_or(0, |commands| commands.refused)),
        (
            "datagrams dropped by full sockets of the recorder",
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

impl From<&gleaner_protocol::TopicReport> for Losses {
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

impl From<&gleaner_protocol::LiveTopic> for Losses {
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

/// What the lambda read; `None` if the run left no `signals.json`, as a live one does not.
///
/// What is more than it may be is cut, and curves whose numbers do not belong together are left
/// out; `notes` says so.
///
/// # Errors
///
/// If the file is a link, or something else that no run leaves.
pub(crate) fn signals(out: &Path, notes: &mut Vec<String>) -> Result<Option<Signals>, OutputError> {
    let read = bounded(out, "signals.json", SIGNALS_MAX)
        .and_then(|text| parsed::<Signals>("signals.json", &text));
    let mut signals = match read {
        Ok(signals) => signals,
        Err(error) if error.is_absent() => return Ok(None),
        Err(source) if source.is_no_result() => {
            return Err(OutputError::Summary { path: out.join("signals.json"), source });
        }
        Err(error) => {
            // It may quote what was found there.
            notes.push(cut(&in_words(&error), WHY_CHARS));
            return Ok(None);
        }
    };
    let found = signals.curves.len();
    signals.curves.truncate(Signals::CURVES_MAX);
    signals.curves.retain(is_whole);
    let dropped = found - signals.curves.len();
    if dropped > 0 {
        notes.push(format!("`signals.json`: {dropped} of {found} curves are not as gleaner writes them, and left out"));
    }
    signals.pictures.truncate(Signals::PICTURES_MAX);
    Ok(Some(signals))
}

/// What a page shows of a config; it is compared whole.
pub(crate) fn shown_config(
    config: &BTreeMap<String, ConfigValue>,
    notes: &mut Vec<String>,
) -> BTreeMap<String, ConfigValue> {
    if config.len() > CONFIG_MAX {
        notes.push(format!(
            "`signals.json`: {} of {} config values left out",
            config.len() - CONFIG_MAX,
            config.len()
        ));
    }
    let value = |value: &ConfigValue| match value {
        ConfigValue::Text(text) => ConfigValue::Text(cut(text, NAME_CHARS)),
        other => other.clone(),
    };
    config.iter().take(CONFIG_MAX).map(|(key, of)| (cut(key, NAME_CHARS), value(of))).collect()
}

fn is_whole(curve: &Curve) -> bool {
    let points = curve.at_ns.len();
    points <= Signals::POINTS_MAX && curve.min.len() == points && curve.max.len() == points
}

/// An error and its causes in one line.
pub(crate) fn in_words(error: &dyn std::error::Error) -> String {
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

/// The file `name` of `out`.
fn bounded(out: &Path, name: &'static str, most: ByteSize) -> Result<Vec<u8>, FileError> {
    let read = PlainFile::result(&out.join(name), most).and_then(PlainFile::read_whole);
    read.map_err(|source| FileError::Read { name, source })
}

/// Folders in `out` that hold results: a vehicle has one for each lambda.
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
