use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::{Network, Spread};
use gleaner_lambda::Clip;

/// One line of JSON that `gleaner-recorder` writes on its standard output for the program that started it.
///
/// The key `recorder` says which it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "recorder", rename_all = "snake_case")]
pub enum RecorderReport {
    /// It hears lambdas from now on.
    Ready,
    /// A clip of an earlier recorder, which did not end well, was saved.
    Recovered(Box<Clip>),
    /// A clip is whole.
    Clip(Box<Clip>),
    /// Something that was wanted is not there, or will not be.
    Loss(Loss),
    /// Sent once a second.
    Status(Box<RecorderStatus>),
    /// Sent once, last.
    Ended(Box<RecorderStatus>),
}

/// Something that was wanted and is not there: one line of `losses.jsonl`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "loss", rename_all = "snake_case")]
pub enum Loss {
    /// A clip was deleted that nobody had fetched.
    Deleted {
        /// When, in ns since 1970.
        at_ns: i64,
        /// The clip, as in `clips.jsonl`.
        file: PathBuf,
        /// Its length.
        bytes: u64,
        /// Why, in words.
        why: String,
    },
    /// A clip that should have been deleted to make room, and could not be: it is still there, whole or without its thumbnail,
    /// though a line before may say that it was deleted.
    NotDeleted {
        /// When, in ns since 1970.
        at_ns: i64,
        /// The clip, as in `clips.jsonl`.
        file: PathBuf,
        /// Its length.
        bytes: u64,
        /// Why, in words.
        why: String,
    },
    /// A clip could not be written. What there is of it is recovered by the next recorder.
    Failed {
        /// When, in ns on the clock of the clips.
        at_ns: i64,
        /// Why, in words.
        why: String,
    },
    /// Triggers that opened no window, as nothing was recorded.
    HeldBack {
        /// When, in ns on the clock of the clips.
        at_ns: i64,
        /// How many.
        triggers: u64,
        /// Why, in words.
        why: String,
    },
}

/// How the recorder is doing. Counts are since its start; the spread is since the report before, and in the last report since the
/// start.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RecorderStatus {
    /// Lambdas that it hears.
    pub lambdas: usize,
    /// Lambdas that it was told of and does not record for; the log says why.
    #[serde(default)]
    pub lambdas_refused: u64,
    /// Clips that are finished.
    pub clips: u64,
    /// Clips that could not be written.
    pub failed: u64,
    /// Clips that were deleted to make room, and that nobody had fetched.
    pub deleted: u64,
    /// Clips that should have been deleted to make room, and could not be.
    #[serde(default)]
    pub not_deleted: u64,
    /// Windows that triggers and commands opened.
    pub windows: u64,
    /// Whether a clip is open.
    pub recording: bool,
    /// Triggers that opened no window, as they came within the cooldown of another.
    pub in_cooldown: u64,
    /// Starts of a recording that was running, stops of none, and triggers beyond what one lambda may cause.
    pub ignored: u64,
    /// Triggers that opened no window, as the disk had too little room.
    pub held_back: u64,
    /// Wakes that did not reach the recorder, or that it refused: the journals of clips lack them.
    pub wakes_lost: u64,
    /// Bytes that the preroll holds.
    pub preroll_bytes: u64,
    /// The most that it may hold.
    pub preroll_bound: u64,
    /// Samples that it gave up too early, for want of bytes.
    pub pushed_out: u64,
    /// Samples that are larger than the preroll: they are in a clip only if it was open when they came.
    #[serde(default)]
    pub too_big: u64,
    /// Samples and wakes that were not taken, as their stamps were before 1970, or their topic was not known yet.
    #[serde(default)]
    pub refused: u64,
    /// Bytes on their way to the disk.
    pub in_flight: u64,
    /// From a decision with triggers to the opening of its windows. `None` without such.
    pub trigger_to_open: Option<Spread>,
    /// Commands; `None` where none are heard.
    #[serde(default)]
    pub commands: Option<CommandStatus>,
    /// Topics that are recorded.
    pub topics: Vec<RecordedTopic>,
    /// The network; `None` where there is none.
    pub network: Option<Network>,
    /// Bytes that are free on the disk of the clips.
    pub disk_free: Option<u64>,
    /// Resident memory, in bytes.
    pub rss_bytes: u64,
    /// CPU time of the process, in s.
    pub cpu_s: f64,
}

/// What came of commands.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CommandStatus {
    /// The topic over which they come.
    pub topic: String,
    /// Those that did something.
    pub accepted: u64,
    /// Those that make no sense, came too often, or were too long.
    pub refused: u64,
    /// Writers that are connected now.
    pub writers: Option<usize>,
    /// What keeps writers from being heard, in whole sentences.
    pub trouble: Vec<String>,
}

/// A topic that is recorded. `None` is unknown.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedTopic {
    /// The topic.
    pub topic: String,
    /// Its type; `None` until it is found.
    pub type_name: Option<String>,
    /// Writers that are connected now.
    pub writers: Option<usize>,
    /// Samples that reached the recorder.
    pub received: u64,
    /// Samples that were lost before they reached it.
    pub lost: Option<u64>,
    /// Samples that it had no room for, as it was busy.
    pub no_slot: u64,
    /// Samples that are larger than it can take.
    pub too_big: u64,
    /// Samples that could not be read at all.
    pub malformed: u64,
    /// What is asked of the writers, in words.
    pub qos: Option<String>,
    /// What keeps writers from being heard, in whole sentences.
    pub trouble: Vec<String>,
}
