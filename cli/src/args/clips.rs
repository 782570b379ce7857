//! Arguments of `gleaner clips`.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand};
use gleaner_base::{ByteSize, parse_duration};
use gleaner_fleet::clips::{ClipId, UploadedClips};

/// Arguments of `gleaner clips`.
#[derive(Args, Debug)]
#[command(args_conflicts_with_subcommands = true)]
pub struct ClipsArgs {
    /// The action; without one, the clips are listed
    #[command(subcommand)]
    pub command: Option<ClipsCommand>,
    #[command(flatten)]
    pub filter: ClipFilterArgs,
    /// Number of the clips to list, the last announced ones
    #[arg(long, short = 'n', value_name = "N", default_value_t = 100)]
    pub last: usize,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// A choice of clips.
#[derive(Args, Debug, Default)]
pub struct ClipFilterArgs {
    /// Only clips of this vehicle
    #[arg(long, value_name = "NAME")]
    pub vehicle: Option<String>,
    /// Only clips with windows of this lambda
    #[arg(long, value_name = "NAME")]
    pub lambda: Option<String>,
    /// Only clips with a trigger of this label
    #[arg(long, value_name = "LABEL")]
    pub label: Option<String>,
    /// Only clips that ended within this time before now, as in 2h
    #[arg(long, value_name = "DURATION", value_parser = parse_duration)]
    pub since: Option<Duration>,
}

/// Commands of `gleaner clips`.
#[derive(Subcommand, Debug)]
pub enum ClipsCommand {
    /// Fetch clips from their vehicles, and download them
    Pull(PullArgs),
    /// Download clips that are in the cloud, with a table of their events
    Export(ExportArgs),
    /// Remove clips from the cloud; those on vehicles stay there
    Remove(RemoveClipsArgs),
    /// Show or change which clips vehicles send, and which ones the cloud keeps
    Policy(PolicyArgs),
}

/// Arguments of `gleaner clips remove`.
#[derive(Args, Debug)]
pub struct RemoveClipsArgs {
    /// Ids of the clips, as in brake-20260802T083451.136Z@car-7
    #[arg(value_name = "ID", required = true)]
    pub ids: Vec<ClipId>,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner clips pull`.
#[derive(Args, Debug)]
pub struct PullArgs {
    /// Ids of the clips, as in brake-20260802T083451.136Z@car-7
    #[arg(value_name = "ID", required = true)]
    pub ids: Vec<ClipId>,
    /// Folder for the files: DIR/VEHICLE/NAME.mcap
    #[arg(long, value_name = "DIR", default_value = ".")]
    pub to: PathBuf,
    /// Longest wait for the vehicles
    #[arg(long, value_name = "DURATION", default_value = "1h", value_parser = parse_duration)]
    pub timeout: Duration,
    /// Do not wait: the vehicles send the clips when they can
    #[arg(long)]
    pub no_wait: bool,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner clips export`.
#[derive(Args, Debug)]
pub struct ExportArgs {
    #[command(flatten)]
    pub filter: ClipFilterArgs,
    /// Folder for the files: DIR/events.jsonl and DIR/VEHICLE/NAME.mcap
    #[arg(long, value_name = "DIR")]
    pub to: PathBuf,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner clips policy`.
#[derive(Args, Debug)]
pub struct PolicyArgs {
    /// The clips that vehicles send: all, on-demand or none
    #[arg(value_name = "CLIPS")]
    pub upload: Option<UploadedClips>,
    /// Bytes that each vehicle sends in a day of UTC, as in 2GiB
    #[arg(long, value_name = "SIZE", requires = "upload")]
    pub budget: Option<ByteSize>,
    /// Time after which the cloud removes a clip, as in 720h; 0s without a bound
    #[arg(long, value_name = "DURATION", requires = "upload", value_parser = parse_duration)]
    pub keep: Option<Duration>,
    /// Size of all clips above which the cloud removes the oldest, as in 500GiB; 0B without a bound
    #[arg(long, value_name = "SIZE", requires = "upload")]
    pub keep_size: Option<ByteSize>,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}
