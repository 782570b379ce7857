//! Arguments of `gleaner deploy` with waves, and of `gleaner fleet`.

use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use gleaner_base::parse_duration;
use gleaner_fleet::waves::{OnFailure, WavePlan};

/// The waves of a deployment to a fleet.
#[derive(Args, Debug, Clone)]
pub struct WaveArgs {
    /// Share of the vehicles that a wave reaches, as in 5%; once for each wave, a last one reaches
    /// all
    #[arg(long, visible_alias = "canary", value_name = "PERCENT", value_parser = percent,
        requires = "fleet", conflicts_with = "local")]
    pub wave: Vec<u8>,
    /// Share of a wave's vehicles that must run it before the next one opens
    #[arg(long, value_name = "PERCENT", value_parser = percent, default_value = "95%", requires = "wave")]
    pub success: u8,
    /// Share of a wave's vehicles that may fail
    #[arg(long, value_name = "PERCENT", value_parser = percent, default_value = "5%", requires = "wave")]
    pub max_failed: u8,
    /// Action when more fail
    #[arg(long, value_name = "ACTION", default_value = "pause", requires = "wave")]
    pub on_failure: FailureAction,
    /// Shortest time that a wave is open before the next one
    #[arg(long, value_name = "DURATION", default_value = "10min", value_parser = parse_duration, requires = "wave")]
    pub soak: Duration,
    /// Time after which a wave that has not succeeded is paused
    #[arg(long, value_name = "DURATION", default_value = "24h", value_parser = parse_duration, requires = "wave")]
    pub wave_deadline: Duration,
    /// Wait for all waves, or until they stop
    #[arg(long, requires = "wave")]
    pub watch: bool,
}

/// The action when too many vehicles fail.
#[derive(ValueEnum, Debug, Clone, Copy)]
pub enum FailureAction {
    /// No wave opens until `gleaner fleet resume`, or another deployment
    Pause,
    /// The vehicles of the waves run the fallback, and no others get the release
    Rollback,
}

impl WaveArgs {
    /// Returns the plan; `None` without waves.
    pub fn plan(&self) -> Option<WavePlan> {
        (!self.wave.is_empty()).then(|| WavePlan {
            shares: self.wave.clone(),
            success: self.success,
            failures: self.max_failed,
            soak_s: self.soak.as_secs(),
            deadline_s: self.wave_deadline.as_secs(),
            on_failure: match self.on_failure {
                FailureAction::Pause => OnFailure::Pause,
                FailureAction::Rollback => OnFailure::Rollback,
            },
        })
    }
}

/// Arguments of `gleaner fleet`.
#[derive(Args, Debug)]
pub struct FleetArgs {
    /// The change of waves; without one, the deployments are listed
    #[command(subcommand)]
    pub command: Option<FleetCommand>,
    /// Print the result as JSON
    #[arg(long, global = true)]
    pub json: bool,
}

/// Commands of `gleaner fleet`.
#[derive(Subcommand, Debug)]
pub enum FleetCommand {
    /// Pause the waves of a deployment: no further one opens
    Pause(FleetIdArgs),
    /// Resume the waves of a deployment; its failure count is reset
    Resume(FleetIdArgs),
    /// End the waves of a deployment: vehicles that have it keep it, and no others get it
    Abort(FleetIdArgs),
}

/// The deployment whose waves change.
#[derive(Args, Debug)]
pub struct FleetIdArgs {
    /// Id of the deployment
    #[arg(value_name = "ID")]
    pub id: String,
}

fn percent(text: &str) -> Result<u8, String> {
    let number = text.strip_suffix('%').unwrap_or(text).parse::<u8>().ok();
    let refused = || format!("`{}` is not a percentage, as in 5%", gleaner_base::excerpt(text));
    number.filter(|number| *number <= 100).ok_or_else(refused)
}
