//! Rollouts in waves while the cloud is killed: one release after the other reaches all vehicles,
//! and waits for a person on its way. The audit trail must have each step once.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use gleaner_fleet::people::{AuditEntry, FleetDeployment, ListPage};
use gleaner_fleet::waves::{OnFailure, WavePlan, WaveState};
use hyper::Method;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, timeout};

use crate::administrator::Administrator;
use crate::release::{DEPLOYMENT, SignedRelease};

/// Shares of the waves before the last one, in percent.
const SHARES: [u8; 3] = [10, 30, 60];
/// The wave after whose opening the waves pause.
const PAUSE_AT: u64 = 2;
/// Time of a pause: without it, the next wave would open meanwhile.
const PAUSE: Duration = Duration::from_secs(5);
/// Time between looks, and for the answer to a request.
const LOOK: Duration = Duration::from_millis(300);
const ANSWER: Duration = Duration::from_secs(10);
/// Longest time in which nothing is answered, and longest time of a rollout.
const PATIENCE: Duration = Duration::from_secs(60);
const ROLLOUT: Duration = Duration::from_secs(240);

/// Rollouts that go on beside the kills.
pub struct Rollouts {
    is_stopping: Arc<AtomicBool>,
    task: JoinHandle<Result<FinishedRollouts, String>>,
}

/// The history that the rollouts must have had.
#[derive(Default)]
pub struct FinishedRollouts {
    /// Actions of the audit trail, in their order.
    pub steps: Vec<String>,
    /// The envelopes that each vehicle must have got, in their order.
    pub envelopes: Vec<String>,
}

impl Rollouts {
    /// Begins, for a fleet of `vehicles`.
    pub fn start(people: SocketAddr, token: &str, vehicles: usize) -> Self {
        let is_stopping = Arc::<AtomicBool>::default();
        let worker = RolloutWorker { people, token: token.to_owned(), vehicles: vehicles as u64 };
        let task = tokio::spawn(worker.run(Arc::clone(&is_stopping)));
        Self { is_stopping, task }
    }

    /// Waits for the end of the rollout that is under way.
    pub async fn finish(self) -> Result<FinishedRollouts, String> {
        self.is_stopping.store(true, Relaxed);
        self.task.await.map_err(|error| error.to_string())?
    }
}

impl FinishedRollouts {
    /// Returns the number of steps that were not taken exactly once, or not in their order.
    pub async fn wrong_steps(&self, administrator: &mut Administrator) -> Result<f64, String> {
        let (mut taken, mut after) = (Vec::new(), String::new());
        loop {
            let path = format!("/v1/audit{after}");
            let page: ListPage<AuditEntry> = administrator.get(&path).await?;
            let steps = page.items.into_iter().filter(|entry| entry.subject == DEPLOYMENT);
            taken.extend(steps.map(|entry| entry.action));
            let Some(next) = page.next else { break };
            after = format!("?after={next}");
        }
        taken.reverse();
        let wrong = differences(&self.steps, &taken);
        if wrong > 0 {
            eprintln!("error: these steps were due: {:?}\n  taken: {taken:?}", self.steps);
        }
        Ok(wrong as f64)
    }

    /// Returns the number of releases that a vehicle did not get exactly once, or not in order.
    pub fn wrong_releases(&self, wanted: &[String]) -> usize {
        differences(&self.envelopes, wanted)
    }
}

/// Returns the number of entries that only one of both has, and 1 for another order.
fn differences(expected: &[String], found: &[String]) -> usize {
    let mut others = found.to_vec();
    let mut missing = 0;
    for entry in expected {
        match others.iter().position(|other| other == entry) {
            Some(index) => drop(others.remove(index)),
            None => missing += 1,
        }
    }
    (missing + others.len()).max(usize::from(expected != found))
}

/// The person who deploys.
struct RolloutWorker {
    people: SocketAddr,
    token: String,
    vehicles: u64,
}

impl RolloutWorker {
    async fn run(self, is_stopping: Arc<AtomicBool>) -> Result<FinishedRollouts, String> {
        let mut finished = FinishedRollouts::default();
        while finished.envelopes.is_empty() || !is_stopping.load(Relaxed) {
            let number = finished.envelopes.len() as u64 + 1;
            let rollout = timeout(ROLLOUT, self.roll_out(number, &mut finished)).await;
            rollout.map_err(|_| format!("release {number} does not reach all vehicles"))??;
        }
        Ok(finished)
    }

    /// Deploys a release, and returns once all vehicles run it.
    async fn roll_out(&self, number: u64, finished: &mut FinishedRollouts) -> Result<(), String> {
        let plan = WavePlan {
            shares: SHARES.to_vec(),
            success: 95,
            failures: 5,
            soak_s: 1,
            deadline_s: 3600,
            on_failure: OnFailure::Pause,
        };
        let release = &SignedRelease::new(number, Some(plan))?;
        self.persistent(|mut it| async move { release.deploy(&mut it).await }).await?;
        let mut paused_at = None;
        loop {
            let FleetDeployment { waves, running, .. } = self.deployment().await?;
            match waves {
                Some(waves) if paused_at.is_none() && waves.wave >= PAUSE_AT => {
                    paused_at = self.pause().await?;
                }
                None if running == self.vehicles => break,
                _ => sleep(LOOK).await,
            }
        }
        finished.envelopes.push(release.envelope.clone());
        let steps = &mut finished.steps;
        steps.push(format!("deploy release {number}"));
        for wave in 1..=SHARES.len() as u64 {
            if wave > 1 {
                steps.push(format!("open wave {wave} of release {number}"));
            }
            if paused_at == Some(wave) {
                steps.extend(["pause waves", "resume waves"].map(str::to_owned));
            }
        }
        steps.push(format!("open release {number} to all"));
        Ok(())
    }

    /// Lets the waves pause for a while; returns the wave that was open, unless all are by now.
    async fn pause(&self) -> Result<Option<u64>, String> {
        let paused_at = self.steer("pause", WaveState::Paused).await?;
        if paused_at.is_some() {
            sleep(PAUSE).await;
            self.steer("resume", WaveState::Running).await?;
        }
        Ok(paused_at)
    }

    /// Brings the waves into a state, by one change; returns the wave that is open then, or `None`
    /// if all are.
    async fn steer(&self, change: &str, state: WaveState) -> Result<Option<u64>, String> {
        let path = format!("/v1/deployments/{DEPLOYMENT}/{change}");
        loop {
            let FleetDeployment { version, waves, .. } = self.deployment().await?;
            let Some(waves) = waves else { return Ok(None) };
            if waves.state == state {
                return Ok(Some(waves.wave));
            }
            // It is refused if a wave has opened meanwhile. If the answer is lost, the next look
            // shows whether it was carried out.
            let tag = Some(("if-match", format!("\"{version}\"")));
            let changed = async {
                let mut administrator = Administrator::connect(self.people, &self.token).await?;
                administrator.bytes(Method::POST, &path, tag, Vec::new()).await
            };
            let _ = timeout(ANSWER, changed).await;
        }
    }

    async fn deployment(&self) -> Result<FleetDeployment, String> {
        let path = &format!("/v1/deployments/{DEPLOYMENT}");
        self.persistent(|mut it| async move { it.get(path).await }).await
    }

    /// Repeats a request over further connections until it succeeds: all may be down for a while.
    async fn persistent<T, R>(
        &self,
        request: impl Fn(Administrator) -> R + Sync,
    ) -> Result<T, String>
    where
        R: Future<Output = Result<T, String>> + Send,
    {
        let begun = Instant::now();
        loop {
            let tried =
                async { request(Administrator::connect(self.people, &self.token).await?).await };
            let tried = timeout(ANSWER, tried).await;
            match tried.unwrap_or_else(|_| Err("no answer within 10 s".to_owned())) {
                Ok(answer) => return Ok(answer),
                Err(reason) if begun.elapsed() > PATIENCE => return Err(reason),
                Err(_) => sleep(LOOK).await,
            }
        }
    }
}
