//! Arguments of replays and comparisons, and the options that both have.

use std::path::PathBuf;

use clap::Args;
use gleaner_drives::Unpacked;
use gleaner_protocol::{DriveTime, PASSES_INFERENCE};

use super::time_range::RequestedRange;
use crate::session_setup::{ConfiguredLambda, LambdaArgs};

/// Arguments of `replay`.
#[derive(Args, Clone, Debug)]
pub struct ReplayArgs {
    #[command(flatten)]
    pub lambda_args: LambdaArgs,
    /// MCAP files, databases and directories of rosbag2. Separate drives are reported, and not
    /// replayed.
    #[arg(required = true)]
    pub drives: Vec<PathBuf>,
    /// Merge all files by time, even if they are separate drives.
    #[arg(long)]
    pub merge: bool,
    /// Replay from this time on: seconds after the drive's start, or since 1970 after an `@`.
    #[arg(long, value_name = "TIME")]
    pub from: Option<DriveTime>,
    /// Replay until before this time, in the same format.
    #[arg(long, value_name = "TIME")]
    pub to: Option<DriveTime>,
    /// Folder of the results; `DIR/out` if not given.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Write every decision, not only those with a trigger or a fault.
    #[arg(long)]
    pub all: bool,
    /// Write no clips, even if the manifest has a table `record`.
    #[arg(long)]
    pub no_record: bool,
    /// Record these topics of the drive in clips, instead of those of the manifest; a `*` stands
    /// for any letters.
    #[arg(long, value_name = "PATTERN", conflicts_with_all = ["no_record", "verify"])]
    pub topics: Vec<String>,
    /// Write a journal of every wake.
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Reproduce every decision of this journal and compare, instead of writing results.
    #[arg(long, value_name = "FILE", 
        conflicts_with_all = ["from", "to", "out", "all", "no_record", "journal", "repeat"])]
    pub verify: Option<PathBuf>,
    /// Number of replays in this process, each from the start.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub repeat: u32,
}

/// Arguments of `verify`.
#[derive(Args, Clone, Debug)]
pub struct VerifyArgs {
    /// A clip, which contains its part of the journal.
    pub clip: PathBuf,
    /// The lambda's folder, built by `gleaner build`.
    #[arg(long, value_name = "DIR")]
    pub lambda: PathBuf,
    /// The configuration of the vehicle; by default, the limits are those of the journal.
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
    /// Standard input is a socket of the starter, which passes the connection to gleaner-inference.
    #[arg(long = PASSES_INFERENCE, hide = true)]
    pub starter_passes_inference: bool,
}

pub struct ReplayOptions {
    pub lambda: ConfiguredLambda,
    /// The drives, merged by time.
    pub drives: Drives,
    /// Set if drives that overlap in time may have a topic in common.
    pub merge: bool,
    pub range: RequestedRange,
    /// Patterns of the topics that clips hold; empty for those of the manifest.
    pub topics: Vec<String>,
    /// The folder for the contents of packed drives, if this process may write to one.
    pub unpack_in: Option<PathBuf>,
    /// Contents of packed drives that are open already.
    pub unpacked: Vec<Unpacked>,
}

/// Drives: the paths that the user named, and their files.
pub struct Drives {
    /// Files and directories.
    pub named: Vec<PathBuf>,
    /// The named files, and those in the named directories.
    pub files: Vec<PathBuf>,
}
