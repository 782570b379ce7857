//! Defines the command line, and checks arguments as far as possible without opening files.

mod authoring;
mod clips;
mod cloud;
mod signing;
mod vehicle;
mod verify;
mod waves;

use std::ffi::OsString;
use std::net::IpAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use clap_complete::Shell;
use gleaner_protocol::DriveTime;

pub use authoring::{BuildArgs, Language, NewArgs};
pub use clips::{
    ClipFilterArgs, ClipsArgs, ClipsCommand, ExportArgs, PolicyArgs, PullArgs, RemoveClipsArgs,
};
pub use cloud::{
    AuditArgs, CloudCommand, EnrolArgs, ListArgs, LoginArgs, NewTokenArgs, NewVehicleArgs,
    RemoveTokenArgs, SearchArgs, TokensArgs, TokensCommand, UnenrolArgs, UserArgs, UsersArgs,
    UsersCommand, VehiclesArgs, VehiclesCommand,
};
pub use signing::{KeysArgs, KeysCommand, PublishArgs, SignArgs};
pub use vehicle::{
    ChangeArgs, DeployArgs, LogsArgs, OnArgs, StatusArgs, StreamArgs, TopArgs, TrustArgs,
    TrustCommand, TrustInstallArgs, VehicleArgs,
};
pub use verify::VerifyArgs;
pub use waves::{FleetArgs, FleetCommand, WaveArgs};

/// Run small functions (lambdas) next to the sensors of a vehicle, and keep the data worth keeping
#[derive(Parser, Debug)]
#[command(name = "gleaner", version = gleaner_base::version(), propagate_version = true)]
pub struct Cli {
    /// The command
    #[command(subcommand)]
    pub command: CliCommand,
}

/// Commands of `gleaner`.
#[derive(Subcommand, Debug)]
pub enum CliCommand {
    /// Show topics, rates, gaps and sizes of a drive, and `[[input]]` tables for a manifest
    Inspect(InspectArgs),
    /// Create a folder with a new lambda: an example with a test and the SDK
    New(NewArgs),
    /// Build a lambda into DIR/build
    Build(BuildArgs),
    /// Load a built lambda as on a vehicle, run its init, and show its needs
    ///
    /// Reports missing inputs and fields, and shows how much memory and disk the lambda needs.
    Check(CheckArgs),
    /// Run a built lambda over recorded drives
    ///
    /// Writes OUT/decisions.jsonl, OUT/log.jsonl, OUT/summary.json, OUT/report.html and the clips
    /// of the manifest's table `record`, and shows a summary.
    Replay(ReplayArgs),
    /// Write OUT/report.html, the report of a replay or a live run, from the files in OUT
    Report(ReportArgs),
    /// Compare the results of two runs
    ///
    /// Exits with 0 if the decisions are identical, and with 4 if they differ.
    Diff(DiffArgs),
    /// Build and replay a lambda on each save of a source, and show changed decisions
    Dev(ReplayedArgs),
    /// Repeat the decisions of a clip, and compare them with its journal
    ///
    /// Exits with 0 if all are identical, and with 4 at the first difference; with --trust, with 3
    /// before that unless one of these vehicles signed exactly this file.
    Verify(VerifyArgs),
    /// Run built lambdas on the live topics of this vehicle, until Ctrl-C
    ///
    /// Records the clips of the manifests' tables `record`, and writes decisions.jsonl, log.jsonl
    /// and summary.json: of one lambda into OUT, of several into OUT/NAME.
    Run(RunArgs),
    /// List the live topics
    Topics(TopicsArgs),
    /// Play recorded drives as live topics; see `gleaner play --help`
    #[command(disable_help_flag = true)]
    Play {
        /// Arguments of gleaner-player
        #[arg(value_name = "ARGUMENTS", trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<OsString>,
    },
    /// Create or show a key that signs revisions, deployments and clips
    #[command(subcommand)]
    Keys(KeysCommand),
    /// Sign a built lambda: write `revision.json`, the signed list of its files
    Publish(PublishArgs),
    /// Sign or install a trust root: the keys that a vehicle accepts
    #[command(subcommand)]
    Trust(TrustCommand),
    /// Sign a deployment of a published lambda, send it to a vehicle or a fleet, and wait until it
    /// runs
    Deploy(DeployArgs),
    /// Run the fallback of a deployment
    Rollback(ChangeArgs),
    /// Start a deployment again that was stopped or failed too often
    Start(ChangeArgs),
    /// Stop a deployment, also after a restart of the vehicle
    Stop(ChangeArgs),
    /// Remove a deployment: its lambda ends, and its records stay for a while
    Remove(ChangeArgs),
    /// Show what runs on a vehicle
    Status(StatusArgs),
    /// Show the cost of each lambda of a vehicle, each second: CPU, memory, latencies, losses
    ///
    /// Keys: up and down or j and k select a lambda, s sorts by another column, q ends it.
    /// With --json, prints one object for each poll; docs/vehicle.md lists its keys.
    Top(TopArgs),
    /// Show decisions and log lines of a deployment
    Logs(LogsArgs),
    /// Show what happened on a vehicle
    Events(StreamArgs),
    #[command(flatten)]
    Cloud(CloudCommand),
    /// Check whether lambdas can run well on this machine
    Doctor(DoctorArgs),
    /// Print a completion script for a shell
    Completions {
        /// The shell
        shell: Shell,
    },
    /// Write a man page for each command into a folder
    Man {
        /// The folder, such as ~/.local/share/man/man1
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
}

/// A lambda and its settings.
#[derive(Args, Debug, Clone)]
pub struct LambdaArgs {
    /// The lambda's folder, built by `gleaner build DIR` (`gleaner dev` builds it itself)
    #[arg(value_name = "DIR")]
    pub lambda: PathBuf,
    /// Override a key of the config table, as in brake_mps2=-1.4
    #[arg(long, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<String>,
    /// Rename a topic of the manifest, as in /imu/data:=/car/imu
    #[arg(long, value_name = "FROM:=TO", value_parser = remap)]
    pub remap: Vec<String>,
    /// Configuration file of the vehicle. Its limits apply where they are smaller than those of the
    /// manifest; see docs/limits.md
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
}

impl LambdaArgs {
    pub(crate) fn settings(&self) -> Vec<OsString> {
        let pairs = |flag: &'static str, values: &[String]| {
            values.iter().flat_map(|value| [flag.into(), value.into()]).collect::<Vec<OsString>>()
        };
        let vehicle = self.vehicle.iter().flat_map(|file| ["--vehicle".into(), file.into()]);
        pairs("--set", &self.set)
            .into_iter()
            .chain(pairs("--remap", &self.remap))
            .chain(vehicle)
            .collect()
    }
}

/// The network to join.
#[derive(Args, Debug, Clone, Default)]
pub struct NetworkArgs {
    /// DDS domain [default: ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=232))]
    pub domain: Option<u16>,
    /// Address of a network interface to use; may be repeated [default: all]
    #[arg(long, value_name = "ADDRESS", value_parser = address)]
    pub interface: Vec<IpAddr>,
}

impl NetworkArgs {
    pub(crate) fn to_args(&self) -> impl Iterator<Item = OsString> {
        let domain = self.domain.map(|domain| format!("--domain={domain}"));
        let interfaces = self.interface.iter().map(|address| format!("--interface={address}"));
        domain.into_iter().chain(interfaces).map(OsString::from)
    }
}

/// Arguments of `gleaner run`.
#[derive(Args, Debug)]
pub struct RunArgs {
    /// Folders of lambdas, built by `gleaner build DIR`
    #[arg(value_name = "DIR", required = true)]
    pub lambdas: Vec<PathBuf>,
    /// Override a key of the config table, as in brake_mps2=-1.4; with several lambdas, of the
    /// lambda NAME: NAME.KEY=VALUE
    #[arg(long, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<String>,
    /// Rename a topic in every manifest that has it, as in /imu/data:=/car/imu
    #[arg(long, value_name = "FROM:=TO", value_parser = remap)]
    pub remap: Vec<String>,
    /// Configuration file of the vehicle. Its limits apply where they are smaller than those of the
    /// manifest; see docs/limits.md
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
    /// Result folder [default: DIR/live; with several lambdas, ./live with a folder for each]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Play this recorded drive once instead of joining the network: an MCAP file, a rosbag2 .db3
    /// file or a directory; several have to be of one drive
    #[arg(long, value_name = "DRIVE", conflicts_with_all = ["domain", "interface"])]
    pub drive: Vec<PathBuf>,
    /// Merge all files by time, even if they are separate drives
    #[arg(long, requires = "drive")]
    pub merge: bool,
    /// Play the drive this many times as fast as it was recorded [default: 1]
    #[arg(long, value_name = "X", value_parser = rate, requires = "drive")]
    pub rate: Option<f64>,
    /// Write every decision, not only those with a trigger or a fault
    #[arg(long)]
    pub all: bool,
    /// Do not record the clips of the manifest's table `record`
    #[arg(long)]
    pub no_record: bool,
    /// Show statistics of the lambdas and their topics every second
    #[arg(long)]
    pub stats: bool,
    /// Stop after this many seconds
    #[arg(long = "for", value_name = "SECONDS", value_parser = whole_seconds)]
    pub last: Option<u32>,
    /// Publish the stamps of input and decision of each wake on this topic, as
    /// sensor_msgs/msg/TimeReference
    #[arg(long, value_name = "TOPIC")]
    pub rtt: Option<String>,
    /// Publish decisions with a trigger or a fault on this topic, as std_msgs/msg/String with JSON
    #[arg(long, value_name = "TOPIC")]
    pub decisions: Option<String>,
    /// Accept recording commands on this topic, as std_msgs/msg/String with JSON; see docs/clips.md
    #[arg(long, value_name = "TOPIC")]
    pub commands: Option<String>,
    /// Start no clip if the disk has fewer free bytes [default: 1 GiB]
    #[arg(long, value_name = "BYTES", value_parser = bytes)]
    pub disk_floor: Option<u64>,
    /// Maximum number of clips to keep; the oldest ones are deleted and counted
    #[arg(long, value_name = "N")]
    pub clips_max: Option<u64>,
    /// Maximum total size of clips to keep; the oldest ones are deleted and counted
    #[arg(long, value_name = "BYTES", value_parser = bytes)]
    pub bytes_max: Option<u64>,
    #[command(flatten)]
    pub sign: SignArgs,
    /// Receive with real-time priority, where the system permits it; see docs/live-network.md
    #[arg(long, conflicts_with = "drive")]
    pub real_time: bool,
    /// Create a control group for each lambda's process in this cgroup v2 folder, which must be
    /// delegated to this user
    #[arg(long, value_name = "DIR")]
    pub cgroup: Option<PathBuf>,
    /// Print reports as JSON, one object per line
    #[arg(long, conflicts_with = "stats")]
    pub json: bool,
    #[command(flatten)]
    pub network: NetworkArgs,
}

/// Arguments of `gleaner inspect`.
#[derive(Args, Debug)]
pub struct InspectArgs {
    /// MCAP files, rosbag2 .db3 files and directories; separate drives are shown one by one
    #[arg(value_name = "DRIVE", required = true)]
    pub drives: Vec<PathBuf>,
    /// Merge all files by time, even if they are separate drives
    #[arg(long)]
    pub merge: bool,
    /// Read a drive of more than 256 MiB completely, not only three parts of it
    #[arg(long)]
    pub all: bool,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner topics`.
#[derive(Args, Debug)]
pub struct TopicsArgs {
    /// Time to wait for topics, in seconds [default: 2]
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub wait: Option<f64>,
    /// Print the topics as one JSON object
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub network: NetworkArgs,
}

/// Arguments of `gleaner doctor`.
#[derive(Args, Debug)]
pub struct DoctorArgs {
    /// Print the findings as JSON, one object per line
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner check`.
#[derive(Args, Debug)]
pub struct CheckArgs {
    #[command(flatten)]
    pub target: LambdaArgs,
    /// Only build the engines of its models for TensorRT, which takes minutes for each
    #[arg(long)]
    pub build_engines: bool,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// A lambda, drives and the part of them to replay.
#[derive(Args, Clone, Debug)]
pub struct ReplayedArgs {
    #[command(flatten)]
    pub target: LambdaArgs,
    /// MCAP files, rosbag2 .db3 files and directories, plain or compressed with zstd; separate
    /// drives are replayed one by one, each with results in a folder of OUT/drives
    #[arg(value_name = "DRIVE", required = true)]
    pub drives: Vec<PathBuf>,
    /// Merge all files by time, even if they are separate drives
    #[arg(long)]
    pub merge: bool,
    /// Start at this time: seconds after the start of the drive, as in 12.5 or 2min, or since 1970,
    /// as in @1700000000.5
    #[arg(long, value_name = "TIME", value_parser = drive_time)]
    pub from: Option<String>,
    /// Stop before this time, in the same form
    #[arg(long, value_name = "TIME", value_parser = drive_time)]
    pub to: Option<String>,
    /// Result folder [default: DIR/out]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Do not record the clips of the manifest's table `record`, which makes a replay faster
    #[arg(long)]
    pub no_record: bool,
}

impl ReplayedArgs {
    /// Returns the result folder.
    pub(crate) fn out(&self) -> PathBuf {
        self.out.clone().unwrap_or_else(|| self.target.lambda.join("out"))
    }
}

/// Arguments of `gleaner replay`.
#[derive(Args, Clone, Debug)]
pub struct ReplayArgs {
    #[command(flatten)]
    pub replayed: ReplayedArgs,
    /// Write every decision, not only those with a trigger or a fault
    #[arg(long)]
    pub all: bool,
    /// Record these topics of the drive instead of those of the table `record`, as in '*' or
    /// '/camera/*'
    #[arg(long, value_name = "PATTERN", conflicts_with_all = ["no_record", "verify"])]
    pub topics: Vec<String>,
    /// Write a journal with the inputs and decisions of every wake
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Repeat every decision of a journal and compare, instead of writing results; exit with 4 at
    /// the first difference
    #[arg(
        long,
        value_name = "FILE",
        conflicts_with_all = ["from", "to", "out", "all", "no_record", "journal"]
    )]
    pub verify: Option<PathBuf>,
    /// Do not write OUT/report.html
    #[arg(long)]
    pub no_report: bool,
    /// Print the summary as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner report`.
#[derive(Args, Debug)]
pub struct ReportArgs {
    /// Result folder of `gleaner replay` or `gleaner run`
    pub out: PathBuf,
}

/// Arguments of `gleaner diff`.
#[derive(Args, Debug)]
pub struct DiffArgs {
    /// Result folder of the first run
    #[arg(value_name = "OUT1")]
    pub a: PathBuf,
    /// Result folder of the second run
    #[arg(value_name = "OUT2")]
    pub b: PathBuf,
    /// Print the differences as one JSON object
    #[arg(long)]
    pub json: bool,
    /// Write a report page of both runs with their differences
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
}

/// Bounds of `--rate`: beyond, a drive of an hour takes longer than a day, or is over at once.
const RATE_MIN: f64 = 0.01;
const RATE_MAX: f64 = 1000.0;

// Early checks only: the texts are passed on unchanged, and the runtime parses them.

fn assignment(text: &str) -> Result<String, String> {
    match text.split_once('=') {
        Some((key, _)) if !key.trim().is_empty() => Ok(text.to_owned()),
        _ => Err("write KEY=VALUE, as in brake_mps2=-1.4".to_owned()),
    }
}

fn remap(text: &str) -> Result<String, String> {
    match text.split_once(":=") {
        Some((from, to)) if !from.trim().is_empty() && !to.trim().is_empty() => Ok(text.to_owned()),
        _ => Err("write FROM:=TO, as in /imu/data:=/car/imu".to_owned()),
    }
}

pub(crate) fn drive_time(text: &str) -> Result<String, String> {
    text.parse::<DriveTime>().map(|_| text.to_owned()).map_err(|error| error.to_string())
}

fn address(text: &str) -> Result<IpAddr, String> {
    text.parse().map_err(|_| "write the IP address of the interface, as in 192.168.1.10".to_owned())
}

fn bytes(text: &str) -> Result<u64, String> {
    text.parse().map_err(|_| "write a number of bytes without a unit, as in 1073741824".to_owned())
}

fn seconds(text: &str) -> Result<f64, String> {
    text.parse().map_err(|_| "write a number of seconds without a unit, as in 2.5".to_owned())
}

fn rate(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|rate| (RATE_MIN..=RATE_MAX).contains(rate))
        .ok_or_else(|| format!("write a number from {RATE_MIN} to {RATE_MAX}, as in 2"))
}

fn whole_seconds(text: &str) -> Result<u32, String> {
    text.parse()
        .ok()
        .filter(|seconds| *seconds > 0)
        .ok_or_else(|| "write a whole number of seconds, 1 or more, as in 60".to_owned())
}

#[cfg(test)]
mod tests;
