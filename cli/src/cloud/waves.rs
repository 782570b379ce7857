//! The waves of a deployment: shows them, and waits for them.

use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, format_duration, visible};
use gleaner_fleet::waves::{WaveProgress, WaveState};
use gleaner_report::format::counted;

use super::fleet::deployments;
use super::rollout::answer;
use crate::args::DeployArgs;
use crate::output::{print, show};
use crate::vehicle::VehicleClient;

/// Interval of looks at the waves, which open within seconds at best.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

pub(super) fn describe(waves: &WaveProgress) -> String {
    let WaveProgress { wave, waves: all, state, reason, vehicles, running, failed, .. } = waves;
    let reason = match reason.split(' ').next() {
        // Who or what it was.
        Some("by" | "as") => format!(" {}", visible(reason)),
        _ => format!(": {}", visible(reason)),
    };
    let state = match state {
        WaveState::Running => String::new(),
        WaveState::Paused => format!(" paused{reason}"),
        WaveState::Aborted => format!(" aborted{reason}"),
    };
    let vehicles = counted(*vehicles, "vehicle");
    format!("wave {wave} of {all}{state}; running on {running} of {vehicles}, {failed} failed")
}

/// Shows the waves of a deployment, and with `--watch` waits for the last one; returns whether it
/// has opened.
///
/// # Errors
///
/// A [`Failure`] if the waves have stopped, or another release has replaced this one.
pub(super) fn wait(
    client: &VehicleClient,
    id: &str,
    envelope: &str,
    args: &DeployArgs,
) -> Result<bool, Failure> {
    let mut shown = String::new();
    loop {
        let all = answer(Instant::now(), args.timeout, || deployments(client))?;
        let found = all.into_iter().find(|it| it.id == id);
        let Some(deployment) = found.filter(|it| it.envelope == envelope) else {
            let message = format!("this deployment of `{id}` was replaced or removed meanwhile");
            return Err(Failure::new(Exit::Differs, message).with_help("`gleaner fleet` lists all"));
        };
        let Some(waves) = &deployment.waves else { return Ok(true) };
        let text = describe(waves);
        if text != shown && !args.vehicle.json {
            print(&format!("{text}\n"))?;
        }
        shown = text;
        if waves.state != WaveState::Running {
            return Err(Failure::new(Exit::Differs, format!("`{id}`: {shown}")).with_help(
                "`gleaner fleet resume ID` goes on, `abort ID` ends the waves, and `gleaner \
                 rollback ID --fleet` lets their vehicles run the fallback",
            ));
        }
        if !args.waves.watch {
            show(args.vehicle.json, &deployment, |_| {
                format!(
                    "the next wave opens after {} once {} % run it: `gleaner fleet` shows them\n",
                    format_duration(args.waves.soak),
                    waves.plan.success,
                )
            })?;
            return Ok(false);
        }
        thread::sleep(POLL_INTERVAL);
    }
}
