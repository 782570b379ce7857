//! Arguments of the commands for a vehicle: `deploy`, `status`, `logs`, `trust` and others.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand, value_parser};
use gleaner_base::parse_duration;
use gleaner_trust::{COUNTER_MAX, VehicleName};

use super::WaveArgs;

/// The orchestrator to talk to.
#[derive(Args, Debug, Clone)]
pub struct VehicleArgs {
    /// Folder of the sockets of gleaner-orchestrator [default: GLEANER_RUN, else /run/gleaner]
    #[arg(long, value_name = "DIR")]
    pub run_dir: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// The vehicle to look at.
#[derive(Args, Debug, Clone, Default)]
pub struct OnArgs {
    /// Name of a vehicle of the cloud, instead of this machine
    #[arg(long = "on", value_name = "VEHICLE", conflicts_with = "run_dir")]
    pub vehicle: Option<VehicleName>,
}

/// Arguments of `gleaner deploy`.
#[derive(Args, Debug)]
pub struct DeployArgs {
    /// The lambda's folder, with its build and the `revision.json` of `gleaner publish DIR`
    #[arg(value_name = "DIR")]
    pub lambda: PathBuf,
    /// Deploy to the orchestrator of this machine
    #[arg(long, required_unless_present = "fleet")]
    pub local: bool,
    /// Deploy to all vehicles of the cloud that have the labels
    #[arg(long, conflicts_with_all = ["local", "run_dir"])]
    pub fleet: bool,
    /// The key file of the deployer, made by `gleaner keys new FILE`
    #[arg(long, value_name = "FILE")]
    pub key: PathBuf,
    /// The file with the revision [default: DIR/revision.json]
    #[arg(long, value_name = "FILE")]
    pub revision: Option<PathBuf>,
    /// Id of the deployment [default: the name of the lambda]
    #[arg(long, value_name = "ID")]
    pub id: Option<String>,
    /// Number of the release, higher than all before [default: the next one after the signed
    /// deployment before]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(1..=COUNTER_MAX))]
    pub release: Option<u64>,
    /// Override a key of the config table, as in brake_mps2=-1.4
    #[arg(long, value_name = "KEY=VALUE", value_parser = super::assignment)]
    pub set: Vec<String>,
    /// Select only vehicles with this label, as in site=berlin
    #[arg(long, visible_alias = "selector", value_name = "NAME=VALUE", value_parser = super::assignment)]
    pub label: Vec<String>,
    /// Digest of the revision that runs if this one fails, or `none` [default: the one of the
    /// deployment before; if that has failed, its fallback, or none]
    #[arg(long, value_name = "SHA256")]
    pub fallback: Option<String>,
    /// The trust root with the keys of other deployers, of whom one may have signed the deployment
    /// before this one
    #[arg(long, value_name = "FILE")]
    pub trust: Option<PathBuf>,
    /// Deploy without a question, also if that takes the deployment away from vehicles, or none has
    /// the labels
    #[arg(long, requires = "fleet", conflicts_with = "local")]
    pub yes: bool,
    /// Time after which a vehicle no longer accepts the deployment for the first time
    #[arg(long, value_name = "DURATION", default_value = "90d", value_parser = days)]
    pub expires: Duration,
    /// The waves, for a fleet
    #[command(flatten)]
    pub waves: WaveArgs,
    /// Longest wait for the lambda to run
    #[arg(long, value_name = "DURATION", default_value = "1min", value_parser = parse_duration)]
    pub timeout: Duration,
    /// The orchestrator
    #[command(flatten)]
    pub vehicle: VehicleArgs,
}

/// Arguments of `gleaner rollback`, `start`, `stop` and `remove`.
#[derive(Args, Debug)]
pub struct ChangeArgs {
    /// Id of the deployment
    #[arg(value_name = "ID")]
    pub id: String,
    /// Longest wait for the lambda to run, or to end
    #[arg(long, value_name = "DURATION", default_value = "1min", value_parser = parse_duration)]
    pub timeout: Duration,
    /// Change the deployment of the cloud, on all its vehicles
    #[arg(long, conflicts_with = "run_dir")]
    pub fleet: bool,
    /// Change it on all these vehicles without a question
    #[arg(long, requires = "fleet")]
    pub yes: bool,
    /// The orchestrator
    #[command(flatten)]
    pub vehicle: VehicleArgs,
}

/// Arguments of `gleaner status`, and of other commands that read from a vehicle.
#[derive(Args, Debug)]
pub struct StatusArgs {
    /// The vehicle
    #[command(flatten)]
    pub on: OnArgs,
    /// The orchestrator
    #[command(flatten)]
    pub vehicle: VehicleArgs,
}

/// Arguments of `gleaner top`.
#[derive(Args, Debug)]
pub struct TopArgs {
    /// Print a table after two polls, and end; with --json, one object
    #[arg(long)]
    pub once: bool,
    /// The vehicle
    #[command(flatten)]
    pub source: StatusArgs,
}

/// Arguments of `gleaner logs` and `gleaner events`.
#[derive(Args, Debug)]
pub struct StreamArgs {
    /// Go on with new lines until Ctrl-C
    #[arg(long, short)]
    pub follow: bool,
    /// Number of the newest lines to begin with
    #[arg(long, short = 'n', value_name = "N", default_value_t = 100)]
    pub last: usize,
    /// The vehicle
    #[command(flatten)]
    pub source: StatusArgs,
}

/// Arguments of `gleaner logs`.
#[derive(Args, Debug)]
pub struct LogsArgs {
    /// Id of the deployment
    #[arg(value_name = "ID")]
    pub id: String,
    /// The records to show
    #[command(flatten)]
    pub stream: StreamArgs,
}

/// Commands of `gleaner trust`.
#[derive(Subcommand, Debug)]
pub enum TrustCommand {
    /// Sign a trust root: the keys that a vehicle accepts
    New(TrustArgs),
    /// Install a trust root on this machine: the first one, or one that follows the installed one
    Install(TrustInstallArgs),
}

/// Arguments of `gleaner trust new`.
#[derive(Args, Debug)]
pub struct TrustArgs {
    /// The file to write
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Key file that signs trust roots; several must all sign
    #[arg(long, value_name = "FILE", required = true)]
    pub root: Vec<PathBuf>,
    /// Key of a publisher: a key file or a public key, for the lambdas of a pattern or for all
    #[arg(long, value_name = "[PATTERN=]KEY", required = true)]
    pub publisher: Vec<String>,
    /// Key of a deployer, as a publisher's
    #[arg(long, value_name = "[PATTERN=]KEY", required = true)]
    pub deployer: Vec<String>,
    /// The trust root that this one follows, signed by the root keys of both
    #[arg(long, value_name = "FILE")]
    pub after: Option<PathBuf>,
    /// Key file of a root key of the former trust root that is no root key any more
    #[arg(long, value_name = "FILE", requires = "after")]
    pub former: Vec<PathBuf>,
    /// Time after which it accepts nothing for the first time
    #[arg(long, value_name = "DURATION", default_value = "730d", value_parser = days)]
    pub expires: Duration,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner trust install`.
#[derive(Args, Debug)]
pub struct TrustInstallArgs {
    /// The file of `gleaner trust new`
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// The orchestrator
    #[command(flatten)]
    pub vehicle: VehicleArgs,
}

/// Parses a duration that may be in days, as in `90d`.
fn days(text: &str) -> Result<Duration, String> {
    if let Some(days) = text.strip_suffix('d') {
        let days = days.parse::<u32>().ok().filter(|days| (1..=36_500).contains(days));
        let days = days.ok_or("give 1d to 36500d")?;
        return Ok(Duration::from_secs(u64::from(days) * 86_400));
    }
    parse_duration(text).map_err(|error| error.to_string())
}
