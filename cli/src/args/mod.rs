//! The command line, checked as far as it can be without looking at a file.

use std::ffi::OsString;
use std::net::IpAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use clap_complete::Shell;
use gleaner_lambda::manifest::Kind;
use gleaner_protocol::DriveTime;

/// Small functions next to the sensors, that keep the data worth keeping.
#[derive(Parser, Debug)]
#[command(name = "gleaner", version, propagate_version = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What `gleaner` can do.
#[derive(Subcommand, Debug)]
pub enum Command {
    /// Show what is in a recorded drive: topics, rates, gaps, sizes, and the inputs to paste into a
    /// manifest
    Inspect(InspectArgs),
    /// Make the folder of a new lambda, with its SDK, a test, and something to begin with
    New(NewArgs),
    /// Make the build folder DIR/build of a lambda
    Build(BuildArgs),
    /// Load a built lambda as on a vehicle, run its init, and say what it will need
    ///
    /// Finds inputs and fields that are not there, and shows how much memory and disk it takes.
    Check(CheckArgs),
    /// Run a built lambda over recorded drives
    ///
    /// Writes OUT/decisions.jsonl, OUT/log.jsonl, OUT/summary.json, the clips that the manifest
    /// asks for, and OUT/report.html, and shows a summary.
    Replay(ReplayArgs),
    /// Write OUT/report.html, the page about a replay or a live run, from the files in OUT
    Report(ReportArgs),
    /// Show what differs between the results of two runs
    ///
    /// Ends with 0 if the decisions are the same, and with 4 if they are not.
    Diff(DiffArgs),
    /// Build and replay a lambda whenever one of its sources is saved, and show what that changed
    /// in its decisions
    Dev(DevArgs),
    /// Make the decisions in a clip again, and compare them with its journal
    ///
    /// Ends with 0 if all are the same, and with 4 at the first that is not.
    Verify(VerifyArgs),
    /// Run a built lambda on the live topics of this vehicle, until ctrl-C
    ///
    /// Records the clips that the manifest asks for, and writes OUT/decisions.jsonl, OUT/log.jsonl
    /// and OUT/summary.json.
    Run(RunArgs),
    /// Show the live topics that are there
    Topics(TopicsArgs),
    /// Play recorded drives as live topics; see `gleaner play --help`
    #[command(disable_help_flag = true)]
    Play {
        /// Handed to gleaner-player as they are
        #[arg(value_name = "ARGUMENTS", trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<OsString>,
    },
    /// Look for what would keep lambdas from running well on this machine
    Doctor(DoctorArgs),
    /// Print what a shell needs to complete these commands
    Completions {
        /// The shell
        shell: Shell,
    },
    /// Write a man page for each command into a folder
    Man {
        /// The folder, as in ~/.local/share/man/man1
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
}

/// Which lambda, with which settings.
#[derive(Args, Debug, Clone)]
pub struct AskedArgs {
    /// The lambda's folder, built by `gleaner build DIR`
    #[arg(value_name = "DIR")]
    pub lambda: PathBuf,
    /// Another value for a key of the config table, as in brake_mps2=-1.4
    #[arg(long, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<String>,
    /// Another name for a topic of the manifest, as in /imu/data:=/car/imu
    #[arg(long, value_name = "FROM:=TO", value_parser = remap)]
    pub remap: Vec<String>,
    /// The configuration of the vehicle, whose limits hold where they are smaller than those of the
    /// manifest; see docs/limits.md
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
}

impl AskedArgs {
    /// The settings, as our programs take them.
    pub(crate) fn settings(&self) -> Vec<OsString> {
        let settings = [("--set", &self.set), ("--remap", &self.remap)];
        let vehicle =
            self.vehicle.iter().flat_map(|file| [OsString::from("--vehicle"), file.into()]);
        settings
            .iter()
            .flat_map(|(flag, values)| {
                values.iter().flat_map(move |value| [OsString::from(*flag), value.into()])
            })
            .chain(vehicle)
            .collect()
    }
}

/// Which network to join.
#[derive(Args, Debug, Clone, Default)]
pub struct NetworkArgs {
    /// The domain of DDS [default: ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=232))]
    pub domain: Option<u16>,
    /// The address of an interface to use; may be repeated [default: all]
    #[arg(long, value_name = "ADDRESS")]
    pub interface: Vec<IpAddr>,
}

impl NetworkArgs {
    /// The same, as our programs take it.
    pub(crate) fn to_args(&self) -> impl Iterator<Item = OsString> {
        let domain = self.domain.map(|domain| format!("--domain={domain}"));
        let interfaces = self.interface.iter().map(|address| format!("--interface={address}"));
        domain.into_iter().chain(interfaces).map(OsString::from)
    }
}

/// Arguments of `gleaner run`.
#[derive(Args, Debug)]
pub struct RunArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub asked: AskedArgs,
    /// Where the results go [default: DIR/live]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Write every decision, not only those with a trigger or a fault
    #[arg(long)]
    pub all: bool,
    /// Leave out the clips that the table `record` of the manifest asks for
    #[arg(long)]
    pub no_record: bool,
    /// Show how the lambda and its topics are doing, every second
    #[arg(long)]
    pub stats: bool,
    /// Stop after so many seconds
    #[arg(long = "for", value_name = "SECONDS", value_parser = clap::value_parser!(u32).range(1..))]
    pub last: Option<u32>,
    /// Answer each wake on this topic with the stamps of input and decision, as
    /// sensor_msgs/msg/TimeReference
    #[arg(long, value_name = "TOPIC")]
    pub rtt: Option<String>,
    /// Publish decisions with a trigger or a fault on this topic, as std_msgs/msg/String with JSON
    #[arg(long, value_name = "TOPIC")]
    pub decisions: Option<String>,
    /// Take commands to record from this topic, as std_msgs/msg/String with JSON; see docs/clips.md
    #[arg(long, value_name = "TOPIC")]
    pub commands: Option<String>,
    /// Bytes of the disk that stay free: below, no clip is begun [default: 1 GiB]
    #[arg(long, value_name = "BYTES")]
    pub disk_floor: Option<u64>,
    /// Most clips that are kept; of more, the oldest that nobody fetched are deleted, and counted
    #[arg(long, value_name = "N")]
    pub clips_max: Option<u64>,
    /// Most bytes of clips that are kept, likewise
    #[arg(long, value_name = "BYTES")]
    pub bytes_max: Option<u64>,
    /// Give the lambda's process a control group of its own in this folder of cgroup v2, delegated
    /// to this user
    #[arg(long, value_name = "DIR")]
    pub cgroup: Option<PathBuf>,
    /// Print what is reported as JSON, an object a line
    #[arg(long, conflicts_with = "stats")]
    pub json: bool,
    #[command(flatten)]
    #[allow(missing_docs)]
    pub network: NetworkArgs,
}

/// Arguments of `gleaner inspect`.
#[derive(Args, Debug)]
pub struct InspectArgs {
    /// MCAP files, .db3 files and directories of rosbag2; several are one drive
    #[arg(value_name = "DRIVE", required = true)]
    pub drives: Vec<PathBuf>,
    /// Read all of a drive that is larger than 256 MiB, not only three parts of it
    #[arg(long)]
    pub all: bool,
    /// Print what is found as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner topics`.
#[derive(Args, Debug)]
pub struct TopicsArgs {
    /// How long to listen, in seconds [default: 2]
    #[arg(long, value_name = "SECONDS")]
    pub wait: Option<f64>,
    /// Print the topics as one JSON object
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    #[allow(missing_docs)]
    pub network: NetworkArgs,
}

/// Arguments of `gleaner doctor`.
#[derive(Args, Debug)]
pub struct DoctorArgs {
    /// Print the findings as JSON, an object a line
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner new`.
#[derive(Args, Debug)]
pub struct NewArgs {
    /// The folder to make; its name becomes the lambda's
    #[arg(value_name = "DIR")]
    pub path: PathBuf,
    /// What it is written in
    #[arg(long, value_enum, default_value = "rust")]
    pub kind: Language,
    /// Replace the SDK in the folder of a lambda by that of this gleaner, and nothing else
    #[arg(long, conflicts_with = "kind")]
    pub update: bool,
}

/// What a lambda is written in.
#[derive(ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Language {
    Rust,
    Python,
}

impl From<Language> for Kind {
    fn from(language: Language) -> Self {
        match language {
            Language::Rust => Self::Wasm,
            Language::Python => Self::Python,
        }
    }
}

/// Arguments of `gleaner build`.
#[derive(Args, Debug)]
pub struct BuildArgs {
    /// Compile a Rust lambda where its build scripts and macros reach no network and no files but
    /// its own; see docs/security.md
    #[arg(long)]
    pub sandboxed: bool,
    /// The lambda's folder, with its lambda.toml
    #[arg(value_name = "DIR")]
    pub lambda: PathBuf,
}

/// Arguments of `gleaner check`.
#[derive(Args, Debug)]
pub struct CheckArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub asked: AskedArgs,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner replay`.
#[derive(Args, Debug)]
pub struct ReplayArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub asked: AskedArgs,
    /// MCAP files, .db3 files and directories of rosbag2, packed with zstd or not; several are
    /// merged by time
    #[arg(value_name = "DRIVE", required = true)]
    pub drives: Vec<PathBuf>,
    /// Replay from this time on: seconds after the drive's start, as in 12.5 or 2min, or since
    /// 1970, as in @1700000000.5
    #[arg(long, value_name = "TIME", value_parser = drive_time)]
    pub from: Option<String>,
    /// Replay until before this time, given likewise
    #[arg(long, value_name = "TIME", value_parser = drive_time)]
    pub to: Option<String>,
    /// Where the results go [default: DIR/out]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Write every decision, not only those with a trigger or a fault
    #[arg(long)]
    pub all: bool,
    /// Leave out the clips that the table `record` of the manifest asks for
    #[arg(long)]
    pub no_record: bool,
    /// Have clips hold these topics of the drive instead of those of the table `record`, as in '*'
    /// or '/camera/*'
    #[arg(long, value_name = "PATTERN", conflicts_with_all = ["no_record", "verify"])]
    pub topics: Vec<String>,
    /// Write a journal: of every wake, what the lambda saw and decided
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Make every decision of a journal again and compare, instead of writing results; exit code 4
    /// at the first difference
    #[arg(long, value_name = "FILE", conflicts_with_all = ["from", "to", "out", "all", "no_record", "journal"])]
    pub verify: Option<PathBuf>,
    /// Leave out OUT/report.html
    #[arg(long)]
    pub no_report: bool,
    /// Print the summary as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner report`.
#[derive(Args, Debug)]
pub struct ReportArgs {
    /// The folder that `gleaner replay` or `gleaner run` wrote to
    pub out: PathBuf,
}

/// Arguments of `gleaner diff`.
#[derive(Args, Debug)]
pub struct DiffArgs {
    /// The folder of the first run
    #[arg(value_name = "OUT1")]
    pub a: PathBuf,
    /// The folder of the second run
    #[arg(value_name = "OUT2")]
    pub b: PathBuf,
    /// Print the differences as one JSON object
    #[arg(long)]
    pub json: bool,
    /// Write a page with both runs, their differences marked
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
}

/// Arguments of `gleaner dev`.
#[derive(Args, Debug)]
pub struct DevArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub asked: AskedArgs,
    /// MCAP files, .db3 files and directories of rosbag2; several are merged by time
    #[arg(value_name = "DRIVE", required = true)]
    pub drives: Vec<PathBuf>,
    /// Replay from this time on, as in `gleaner replay`
    #[arg(long, value_name = "TIME", value_parser = drive_time)]
    pub from: Option<String>,
    /// Replay until before this time
    #[arg(long, value_name = "TIME", value_parser = drive_time)]
    pub to: Option<String>,
    /// Where the results go [default: DIR/out]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Leave out the clips that the table `record` of the manifest asks for: a replay is faster
    /// without
    #[arg(long)]
    pub no_record: bool,
}

/// Arguments of `gleaner verify`.
#[derive(Args, Debug)]
pub struct VerifyArgs {
    /// A clip that gleaner made
    pub clip: PathBuf,
    /// The lambda's folder, built by `gleaner build DIR`
    #[arg(long, value_name = "DIR")]
    pub lambda: PathBuf,
    /// The configuration of the vehicle [default: the limits that the journal names]
    #[arg(long, value_name = "FILE")]
    pub vehicle: Option<PathBuf>,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

// All are passed on as they are: the runtime takes them apart. Here they are only refused early.

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

#[cfg(test)]
mod tests;
