//! Waits until all vehicles of a deployment have followed a change, or reports why not.

use std::collections::BTreeMap;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, in_one_line, visible};
use gleaner_fleet::WantedProblem;
use gleaner_fleet::people::{VehicleState, VehicleSummary};
use gleaner_protocol::supervision::LambdaPhase;
use gleaner_protocol::vehicle_api::VehicleStatus;
use gleaner_report::format::counted;
use serde_json::json;

use super::plan::{FleetPlan, Selector, selects};
use super::{list, vehicles};
use crate::output::{print, print_json};
use crate::since_1970;
use crate::vehicle::VehicleClient;

const POLL_INTERVAL: Duration = Duration::from_millis(500);

/// Maximum number of vehicles in an error; `--json` has all.
const SHOWN: usize = 20;

/// A change of a deployment on the way to its vehicles.
pub(super) struct Rollout {
    pub(super) id: String,
    pub(super) selector: Selector,
    /// SHA-256 of the signed envelope that runs then; `None` if there may be several.
    pub(super) envelope: Option<String>,
    pub(super) goal: Goal,
    /// The vehicles that it concerns; those that match meanwhile count, too.
    pub(super) plan: FleetPlan,
}

/// The state of a deployment that a change requests.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Goal {
    Revision { release: u64 },
    Running,
    Fallback,
    Stopped,
    Removed,
}

impl Goal {
    fn describe(self) -> &'static str {
        match self {
            Self::Revision { .. } | Self::Running => "runs",
            Self::Fallback => "runs its fallback",
            Self::Stopped => "is stopped",
            Self::Removed => "is removed",
        }
    }
}

/// The state of a vehicle on the way to the goal, with a reason or a remark.
#[derive(Clone, Debug, PartialEq)]
enum Standing {
    Done(String),
    Pending(String),
    Failed(Exit, String),
}

impl Standing {
    fn parts(&self) -> (&'static str, &str) {
        match self {
            Self::Done(text) => ("done", text),
            Self::Pending(text) => ("pending", text),
            Self::Failed(_, text) => ("failed", text),
        }
    }

    fn is_done(&self) -> bool {
        matches!(self, Self::Done(_))
    }
}

/// Polls until there is an answer. After a lost connection it polls again, until `timeout` has
/// passed since `since`.
pub(super) fn answer<T>(
    since: Instant,
    timeout: Duration,
    poll: impl Fn() -> Result<T, Failure>,
) -> Result<T, Failure> {
    const HELP: &str = "it was sent, and goes on by itself: `gleaner fleet` shows it";
    loop {
        match poll() {
            Err(failure) if failure.exit != Exit::Unreachable => return Err(failure),
            Err(lost) if since.elapsed() >= timeout => return Err(lost.with_help(HELP)),
            Err(_) => thread::sleep(POLL_INTERVAL),
            answer => return answer,
        }
    }
}

impl Rollout {
    /// Waits until no vehicle is on the way any more, and shows the result.
    ///
    /// # Errors
    ///
    /// A [`Failure`] with the reason of each vehicle that has not reached the goal.
    pub(super) fn wait(
        &self,
        client: &VehicleClient,
        json: bool,
        timeout: Duration,
    ) -> Result<Exit, Failure> {
        let started = Instant::now();
        let mut standings: BTreeMap<String, Standing> = BTreeMap::new();
        loop {
            let vehicles = || list::all::<VehicleSummary>(client, "/v1/vehicles", &[]);
            let vehicles = answer(started, timeout, vehicles)?;
            let mut former = std::mem::take(&mut standings);
            for vehicle in vehicles.iter().filter(|vehicle| self.concerns(vehicle)) {
                let standing = match former.remove(&vehicle.name).filter(Standing::is_done) {
                    Some(done) => done,
                    None => {
                        let standing = || self.standing(client, vehicle);
                        let standing = answer(started, timeout, standing)?;
                        if standing.is_done() && !json {
                            let (name, (_, text)) = (visible(&vehicle.name), standing.parts());
                            print(&format!("{name}: {text}\n"))?;
                        }
                        standing
                    }
                };
                standings.insert(vehicle.name.clone(), standing);
            }
            let is_on_the_way = |it: &Standing| matches!(it, Standing::Pending(_));
            if !standings.values().any(is_on_the_way) || started.elapsed() >= timeout {
                return self.result(&standings, json);
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    fn concerns(&self, vehicle: &VehicleSummary) -> bool {
        selects(&self.selector, vehicle) || self.plan.names(&vehicle.name)
    }

    fn goal_of(&self, vehicle: &VehicleSummary) -> Goal {
        let is_removal = self.plan.removes(&vehicle.name) && self.goal != Goal::Stopped;
        if is_removal { Goal::Removed } else { self.goal }
    }

    fn standing(
        &self,
        client: &VehicleClient,
        vehicle: &VehicleSummary,
    ) -> Result<Standing, Failure> {
        let standing = if vehicle.handled < vehicle.wanted {
            Standing::Pending("has not applied the change yet".to_owned())
        } else {
            match client.get(&format!("/v1/vehicles/{}/status", vehicle.name)) {
                Ok(status) => self.judge(self.goal_of(vehicle), &status, &vehicle.problems),
                Err(failure) if [Exit::Unreachable, Exit::Denied].contains(&failure.exit) => {
                    return Err(failure);
                }
                Err(failure) => Standing::Pending(visible(&failure.message)),
            }
        };
        Ok(match standing {
            Standing::Pending(reason) if vehicle.state == VehicleState::Offline => {
                let now = since_1970().as_secs();
                let seen = vehicle.seen.map(|seen| vehicles::seen_before(now, seen));
                let seen = seen.map(|seen| format!(", seen {seen}")).unwrap_or_default();
                Standing::Pending(format!("offline{seen}; {reason}"))
            }
            standing => standing,
        })
    }

    /// Compares a status, and the problems with the desired state, with the goal.
    fn judge(&self, goal: Goal, status: &VehicleStatus, problems: &[WantedProblem]) -> Standing {
        let pending = |text: &str| Standing::Pending(text.to_owned());
        let standing = match goal {
            Goal::Stopped | Goal::Removed => {
                let found = status.deployments.iter().find(|it| it.id == self.id);
                let is_applied = found.is_none_or(|it| goal == Goal::Stopped && !it.is_wanted);
                let lambdas = status.supervisor.as_ref().map(|supervisor| &supervisor.lambdas);
                match lambdas.map(|lambdas| lambdas.iter().any(|it| it.id == self.id)) {
                    _ if !is_applied => pending("has not applied the change yet"),
                    Some(false) => Standing::Done(goal.describe().to_owned()),
                    Some(true) => pending("its lambda is still stopping"),
                    None => pending("its supervisor does not report"),
                }
            }
            _ => self.judge_running(status),
        };
        // Those of a former deployment of this id are of another envelope.
        let mut mine = problems.iter().filter(|problem| {
            let is_same = |envelope: &String| *envelope == problem.envelope;
            problem.deployment == self.id
                && (problem.envelope.is_empty() || self.envelope.as_ref().is_none_or(is_same))
        });
        match (standing, mine.next()) {
            (Standing::Pending(_), Some(problem)) => {
                // With its help, and without the id, which this command has named.
                let reason =
                    WantedProblem { deployment: String::new(), ..problem.clone() }.explained();
                match problem.is_pending {
                    true => Standing::Pending(reason),
                    false => Standing::Failed(Exit::Denied, reason),
                }
            }
            (standing, _) => standing,
        }
    }

    fn judge_running(&self, status: &VehicleStatus) -> Standing {
        let pending = |text: &str| Standing::Pending(text.to_owned());
        let Some(it) = status.deployments.iter().find(|it| it.id == self.id) else {
            return pending("does not have the deployment yet");
        };
        if it.envelope.is_empty() && self.envelope.is_some() {
            return pending("its gleaner is too old to report what it runs: update gleaner there");
        }
        if self.envelope.as_ref().is_some_and(|envelope| *envelope != it.envelope) {
            let text = format!("has another deployment, with release {}", it.release);
            return match self.goal {
                Goal::Revision { release } if it.release > release => {
                    Standing::Failed(Exit::Differs, text)
                }
                _ => Standing::Pending(text),
            };
        }
        if let Some(refused) = &it.refused {
            return Standing::Failed(Exit::Denied, format!("refused: {}", visible(refused)));
        }
        let fallback = it.fallback.as_ref().filter(|_| it.runs_fallback);
        let version = visible(&fallback.unwrap_or(&it.revision).version);
        match (self.goal, fallback) {
            (Goal::Revision { .. }, Some(_)) => {
                let reason = it.failed.as_deref().map(|it| format!(": {}", in_one_line(it)));
                let reason = reason.unwrap_or_default();
                let text = format!("runs its fallback {version}{reason}");
                return Standing::Failed(Exit::LambdaFaulted, text);
            }
            (Goal::Fallback, None) if it.fallback.is_none() => {
                let text = format!("keeps release {}, which has no fallback", it.release);
                return Standing::Failed(Exit::Differs, text);
            }
            (Goal::Fallback, None) if it.is_wanted => return pending("runs its revision"),
            _ if !it.is_wanted => return pending("is stopped"),
            _ => {}
        }
        let lambda = it.status.as_ref().filter(|lambda| lambda.attempt >= it.attempt);
        let on_probation =
            lambda.filter(|lambda| !it.is_proven && lambda.phase == LambdaPhase::Running);
        if let Some(faults) = on_probation.and_then(|lambda| lambda.recent.faulty()) {
            let text = format!("runs {version}, but {faults}");
            return Standing::Failed(Exit::LambdaFaulted, text);
        }
        match lambda.map(|lambda| lambda.phase) {
            Some(LambdaPhase::Running) => Standing::Done(format!("runs {version}")),
            Some(LambdaPhase::Quarantined) => {
                let end = lambda.and_then(|it| it.last_end.as_deref()).map(visible);
                let reason = end.map(|end| format!(": {end}")).unwrap_or_default();
                let text = format!("does not run, and is not restarted{reason}");
                Standing::Failed(Exit::LambdaFaulted, text)
            }
            Some(phase) => Standing::Pending(format!("its lambda is {}", phase.as_str())),
            None => pending("has not confirmed the start yet"),
        }
    }

    fn result(&self, standings: &BTreeMap<String, Standing>, json: bool) -> Result<Exit, Failure> {
        let done = standings.values().filter(|it| it.is_done()).count();
        let all = counted(standings.len() as u64, "vehicle");
        let (id, words) = (&self.id, self.goal.describe());
        if json {
            let vehicles = standings.iter().map(|(name, standing)| {
                let (state, reason) = standing.parts();
                json!({ "name": name, "state": state, "reason": reason })
            });
            let vehicles = vehicles.collect::<Vec<_>>();
            let plan = self.plan.json();
            print_json(&json!({
                "id": id, "selector": self.selector, "plan": plan, "vehicles": vehicles,
            }))?;
        }
        let text = match done == standings.len() {
            true if standings.is_empty() => match self.goal {
                Goal::Revision { .. } => {
                    "no vehicle matches the labels yet: any that connects with them gets it\n"
                }
                _ => "no vehicle matches the labels: there is nothing to wait for\n",
            }
            .to_owned(),
            true => format!("`{id}` {words} on {all}\n"),
            false => return Err(self.failure(standings, &format!("{done} of {all}"))),
        };
        if !json {
            print(&text)?;
        }
        Ok(Exit::Ok)
    }

    fn failure(&self, standings: &BTreeMap<String, Standing>, count: &str) -> Failure {
        let others = || standings.iter().filter(|(_, standing)| !standing.is_done());
        let exits = || {
            others().filter_map(|(_, it)| match it {
                Standing::Failed(exit, _) => Some(*exit),
                _ => None,
            })
        };
        let exit = [Exit::Denied, Exit::LambdaFaulted]
            .into_iter()
            .find(|exit| exits().any(|it| it == *exit))
            .unwrap_or(Exit::Differs);
        let message = format!("`{}` {} on {count}", self.id, self.goal.describe());
        let mut failure = Failure::new(exit, message);
        let cause = |(name, standing): (&String, &Standing)| {
            format!("{}: {}", visible(name), standing.parts().1)
        };
        failure.causes = others().take(SHOWN).map(cause).collect();
        if let Some(more) = others().count().checked_sub(SHOWN).filter(|more| *more > 0) {
            failure.causes.push(format!("{more} more: --json lists all"));
        }
        failure.with_help(
            "vehicles that are only late go on: `gleaner vehicles`, and `gleaner status --on NAME`",
        )
    }
}

#[cfg(test)]
mod tests;
