//! Lets the vehicle run what the cloud wants, step by step. The newest wish counts: between two
//! steps an older one is given up.

use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, RateLimit};
use gleaner_fleet::{Desired, WantedProblem};
use gleaner_lambda::manifest::{ItemName, Sha256};
use gleaner_protocol::supervision::EventKind;
use gleaner_protocol::vehicle_api::{DeployReply, DeployRequest};
use gleaner_trust::{Deployment, Payload, Revision, sha256};
use tokio::sync::{Mutex, watch};
use tokio::time::sleep;

use super::download::Download;
use super::http::CloudHttp;
use super::plan::{Step, plan};
use crate::orchestrator::Orchestrator;
use crate::state::DesiredDeployment;

/// Pause before the steps that failed are taken again; it doubles up to the longest. Each
/// failure makes an event.
const PAUSE: Duration = Duration::from_secs(10);
const PAUSE_MAX: Duration = Duration::from_secs(1800);
/// Events per second and at once about steps that failed: a hostile cloud can cause any number.
const EVENTS: RateLimit = RateLimit::of(0.1, 100.0);
/// Number of times that missing files are fetched: another deployment may remove some in between.
const ROUNDS: u32 = 5;

const CLOUD: &str = "the cloud";

/// A desired state, and the cloud that has its files.
#[derive(Clone)]
pub(super) struct Order {
    pub(super) desired: Desired,
    pub(super) http: CloudHttp,
    /// SHA-256 of the certificate of the cloud's authority.
    pub(super) authority: String,
}

/// The outcome of a desired state.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Handled {
    pub(super) generation: u64,
    /// The reasons why parts of it are not applied.
    pub(super) problems: Vec<WantedProblem>,
}

/// The task that follows the desired states.
pub(super) struct Reconciler {
    pub(super) core: Arc<Orchestrator>,
    pub(super) orders: watch::Receiver<Option<Order>>,
    pub(super) handled: watch::Sender<Handled>,
    /// Held by the thread that takes a step.
    pub(super) step: Arc<Mutex<()>>,
}

impl Order {
    /// Returns whether `order` is no order, or one of another state.
    fn is_other(order: Option<&Self>, desired: &Desired) -> bool {
        order.is_none_or(|order| order.desired != *desired)
    }
}

impl Reconciler {
    /// Runs until the sender of desired states is dropped.
    pub(super) async fn run(mut self) {
        let (mut pause, mut before, mut events) = (PAUSE, None, EVENTS);
        loop {
            let order = self.orders.borrow_and_update().clone();
            let Some(Order { desired, http, authority }) = order else {
                if self.orders.changed().await.is_err() {
                    return;
                }
                continue;
            };
            if before.as_ref() != Some(&desired) {
                pause = PAUSE;
            }
            let problems = self.follow(&desired, &authority, &http, &mut events).await;
            let (is_done, generation) = (problems.is_empty(), desired.generation);
            self.handled.send_replace(Handled { generation, problems });
            let desired = &*before.insert(desired);
            // The same state comes with each connection: it does not shorten the pause.
            let late = async {
                match is_done {
                    true => std::future::pending().await,
                    false => sleep(pause).await,
                }
            };
            let other = self.orders.wait_for(|order| Order::is_other(order.as_ref(), desired));
            tokio::select! {
                changed = other => if changed.is_err() { return },
                () = late => pause = (pause * 2).min(PAUSE_MAX),
            }
        }
    }

    /// Takes the steps to a desired state; returns the reasons why parts of it are not applied.
    async fn follow(
        &self,
        desired: &Desired,
        authority: &str,
        http: &CloudHttp,
        events: &mut RateLimit,
    ) -> Vec<WantedProblem> {
        let mut note = |kind, problem: &WantedProblem| {
            if events.take(1.0, Instant::now()) {
                let text = format!("`{}`: {}", problem.deployment, problem.describe());
                self.core.event(kind, None, &text);
            }
        };
        // A step of an earlier state, which was given up, may still end in its thread: what it
        // changes counts for the plan.
        let name = authority.to_owned();
        if let Err(failure) = self.blocking(move |core| core.leave_other_cloud(&name)).await {
            return vec![problem(String::new(), String::new(), failure)];
        }
        let deployed = self.core.lock().state.deployments.clone();
        let (mut steps, mut problems) = plan(&desired.deployments, &deployed);
        if desired.keeps || desired.generation < self.core.followed(authority) {
            problems.extend(steps.extract_if(.., |step| step.takes_away()).map(kept));
        }
        // Before the steps, which may take hours: a cloud that is restored meanwhile is older.
        let (name, generation) = (authority.to_owned(), desired.generation);
        let noted = self.blocking(move |core| core.note_followed(name, generation)).await;
        if let Err(failure) = noted {
            problems.push(problem(String::new(), String::new(), failure));
        }
        for problem in &problems {
            note(kind_of(problem), problem);
        }
        // Files are many, and each handshake would take longer than most of them.
        let http = &http.keeping();
        for step in steps {
            let (id, envelope) = (step.id().clone(), step.envelope());
            let mut orders = self.orders.clone();
            // A newer state does not wait for the files of an older one.
            let taken = tokio::select! {
                taken = self.take(step, http) => taken,
                _ = orders.wait_for(|order| Order::is_other(order.as_ref(), desired)) => break,
            };
            if let Err(failure) = taken {
                // One that fails blocks no other one.
                let problem = problem(id.to_string(), envelope, failure);
                note(kind_of(&problem), &problem);
                problems.push(problem);
            }
        }
        problems
    }

    async fn take(&self, step: Step, http: &CloudHttp) -> Result<(), Failure> {
        match step {
            Step::Remove(id) => self.blocking(move |core| core.remove(id.as_str(), CLOUD)).await,
            Step::Stop(id, wish) => {
                self.blocking(move |core| {
                    core.set_wanted(id.as_str(), false, CLOUD)?;
                    core.note_wish(&id, &wish)
                })
                .await
            }
            Step::RollBack(id, wish) => self.roll_back(id, wish).await,
            Step::Start(id, wish) => {
                self.blocking(move |core| {
                    if !core.runs(&id) {
                        core.set_wanted(id.as_str(), true, CLOUD)?;
                    }
                    core.note_wish(&id, &wish)
                })
                .await
            }
            Step::Deploy { id, wish, rolls_back } => {
                // The request for the fallback is followed once that runs, also after a kill.
                let rollback = if rolls_back { 0 } else { wish.rollback };
                self.deploy(&id, &DesiredDeployment { rollback, ..wish.clone() }, http).await?;
                if rolls_back { self.roll_back(id, wish).await } else { Ok(()) }
            }
        }
    }

    async fn roll_back(&self, id: ItemName, wish: DesiredDeployment) -> Result<(), Failure> {
        self.blocking(move |core| {
            let deployed = core.lock().state.deployments.get(&id).cloned();
            let before = deployed.as_ref().and_then(|it| it.cloud.as_ref());
            if before.is_some_and(|before| wish.start > before.start) && !core.runs(&id) {
                core.set_wanted(id.as_str(), true, CLOUD)?;
            }
            if !deployed.is_some_and(|it| it.runs_fallback) {
                core.roll_back(id.as_str(), "rolled back by the cloud")?;
            }
            core.note_wish(&id, &wish)
        })
        .await
    }

    async fn deploy(
        &self,
        id: &ItemName,
        wish: &DesiredDeployment,
        http: &CloudHttp,
    ) -> Result<(), Failure> {
        let path = format!("/v1/deployments/{}", wish.envelope);
        let envelope = http.get(&path, Deployment::MAX.bytes()).await?;
        if sha256(&envelope).as_str() != wish.envelope {
            let message = "the cloud sent another deployment than it wants";
            return Err(Failure::new(Exit::Denied, message));
        }
        let refused = |refusal| Failure::because("the deployment is refused", &refusal);
        let wanted = self.core.trust(|trust| {
            trust.verifier()?.deployment(&envelope).map_err(refused).map(|it| it.payload().clone())
        })?;
        if wanted.id != *id {
            let message = format!("the cloud names deployment `{}` `{id}`", wanted.id);
            return Err(Failure::new(Exit::Denied, message));
        }
        let mut revisions = Vec::new();
        for digest in std::iter::once(&wanted.revision).chain(&wanted.fallback) {
            if !self.core.store.has(digest) {
                let path = format!("/v1/revisions/{digest}");
                revisions.push(text(http.get(&path, Revision::MAX.bytes()).await?)?);
            }
        }
        let request = Arc::new(DeployRequest { deployment: text(envelope)?, revisions });
        for _ in 0..ROUNDS {
            let (sent, wish) = (Arc::clone(&request), wish.clone());
            match self.blocking(move |core| core.deploy(&sent, Some(&wish))).await? {
                DeployReply::Accepted { .. } => return Ok(()),
                DeployReply::Missing { objects } => {
                    for object in objects {
                        let digest: Sha256 = object.sha256.parse().map_err(|error| {
                            Failure::caused_by(Exit::Internal, "a digest is invalid", &error)
                        })?;
                        // A user may have deployed the same files meanwhile.
                        let Ok(length) = self.core.expected(&digest) else { break };
                        let target = self.core.store.object(&digest);
                        Download { http, sha256: &digest, length, target }.run().await?;
                    }
                }
            }
        }
        Err(Failure::new(Exit::Internal, "files are missing again after they were fetched"))
    }

    /// Calls `work`, which waits for the disk, in a thread for that.
    async fn blocking<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Orchestrator) -> Result<T, Failure> + Send + 'static,
    ) -> Result<T, Failure> {
        let core = Arc::clone(&self.core);
        let step = Arc::clone(&self.step).lock_owned().await;
        let done = tokio::task::spawn_blocking(move || {
            let done = work(&core);
            drop(step);
            done
        })
        .await;
        done.map_err(|_| Failure::new(Exit::Internal, "a step of the deployment was interrupted"))?
    }
}

/// Returns the problem of a step that is not taken, as the cloud has lost newer states.
fn kept(step: Step) -> WantedProblem {
    WantedProblem {
        deployment: step.id().to_string(),
        envelope: step.envelope(),
        title: "it stays on this vehicle, although the cloud does not want it".to_owned(),
        is_pending: true,
        causes: vec!["the cloud has an older state than this vehicle has applied".to_owned()],
        help: "after a restored backup, `gleaner vehicles agree NAME` lets the vehicle follow it"
            .to_owned(),
    }
}

fn kind_of(problem: &WantedProblem) -> EventKind {
    if problem.is_pending { EventKind::Warning } else { EventKind::Refused }
}

fn problem(deployment: String, envelope: String, failure: Failure) -> WantedProblem {
    let Failure { exit, message, causes, help } = failure;
    WantedProblem {
        deployment,
        envelope,
        title: message,
        is_pending: exit == Exit::Unreachable,
        causes,
        help: help.unwrap_or_default(),
    }
}

/// Envelopes are text.
fn text(bytes: Vec<u8>) -> Result<String, Failure> {
    String::from_utf8(bytes).map_err(|error| {
        Failure::caused_by(Exit::Denied, "the cloud sent an envelope that is not text", &error)
    })
}
