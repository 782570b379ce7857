//! The state of the vehicle, and the operations that change it. Each is durable before it counts.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::Vehicle;
use gleaner_lambda::manifest::{ItemName, Sha256};
use gleaner_protocol::supervision::{
    DesiredState, EventKind, LAMBDAS_MAX, LambdaPhase, SupervisorStatus, VehicleEvent,
};
use gleaner_protocol::vehicle_api::{
    DeployReply, DeployRequest, DeploymentStatus, GrantStatus, RevisionStatus,
};
use gleaner_supervisor::EventLog;
use gleaner_trust::{Revision, Trusted};
use tokio::sync::watch;

use crate::admission::{self, MemoryBudget};
use crate::checked::SignedDeployment;
use crate::compile;
use crate::durable::DurableFile;
use crate::layout::Layout;
use crate::state::{Deployed, VehicleState};
use crate::store::RevisionStore;
use crate::trust::VehicleTrust;

/// The vehicle.
pub(crate) struct Core {
    pub(crate) vehicle: Vehicle,
    pub(crate) store: RevisionStore,
    /// Folder of native code.
    cache: PathBuf,
    memory: MemoryBudget,
    events: EventLog,
    desired: watch::Sender<DesiredState>,
    inner: Mutex<Inner>,
    /// Held by the operation that changes the store.
    deploying: Mutex<()>,
}

struct Inner {
    trust: VehicleTrust,
    state: VehicleState,
    state_file: DurableFile,
    /// The deployments of the state that were verified, or the reasons why they do not run.
    signed: BTreeMap<ItemName, Result<SignedDeployment, String>>,
    /// Files that the deployment needs that was offered last, and their lengths.
    expected: BTreeMap<Sha256, u64>,
    /// Memory that each wanted lambda may take.
    memory: BTreeMap<ItemName, u64>,
    status: Option<SupervisorStatus>,
}

impl Core {
    /// Loads the state, and verifies every deployment in it.
    ///
    /// # Errors
    ///
    /// A failure if state, trust root or floors are damaged.
    pub(crate) fn open(layout: &Layout, vehicle: Vehicle) -> Result<Self, Failure> {
        let events = EventLog::open(&layout.spool(), "orchestrator")?;
        let (trust, damage) = VehicleTrust::load(layout, vehicle.identity.labels.clone())?;
        let state_file = DurableFile::new(layout.state_file());
        let loaded = state_file.load::<VehicleState>()?;
        let inner = Inner {
            trust,
            state: loaded.value.unwrap_or_default(),
            state_file,
            signed: BTreeMap::new(),
            expected: BTreeMap::new(),
            memory: BTreeMap::new(),
            status: None,
        };
        let core = Self {
            store: RevisionStore::open(layout)?,
            cache: layout.cache(),
            memory: MemoryBudget::of(&vehicle),
            events,
            desired: watch::Sender::new(DesiredState::default()),
            inner: Mutex::new(inner),
            deploying: Mutex::new(()),
            vehicle,
        };
        core.event(EventKind::Started, None, "the orchestrator has started");
        for (file, damage) in [("floors", damage), ("state", loaded.damage)] {
            if let Some(damage) = damage {
                let text = format!("one of the two copies of the {file} is damaged: {damage}");
                core.event(EventKind::Warning, None, &text);
            }
        }
        let mut inner = core.lock();
        // What was repaired is written again.
        core.verify(&mut inner);
        core.save(&mut inner)?;
        core.collect(&inner);
        drop(inner);
        Ok(core)
    }

    /// Returns the wanted state, as it changes.
    pub(crate) fn desired(&self) -> watch::Receiver<DesiredState> {
        self.desired.subscribe()
    }

    /// Adds an event to the spool of the orchestrator.
    pub(crate) fn event(&self, event: EventKind, lambda: Option<&ItemName>, text: &str) {
        self.events.add(&VehicleEvent {
            event,
            lambda: lambda.map(ItemName::to_string),
            revision: None,
            text: gleaner_base::visible(text),
        });
    }

    /// Calls `read` with the trust of the vehicle.
    pub(crate) fn trust<T>(&self, read: impl FnOnce(&VehicleTrust) -> T) -> T {
        read(&self.lock().trust)
    }

    /// Moves the trusted time to that of the clock.
    pub(crate) fn observe_time(&self) {
        if let Err(failure) = self.lock().trust.observe_time() {
            self.event(EventKind::Warning, None, &failure.to_string());
        }
    }

    /// Installs a trust root, and verifies all deployments by it.
    ///
    /// # Errors
    ///
    /// A failure with the reason; nothing has changed.
    pub(crate) fn install_root(&self, envelope: &[u8]) -> Result<(), Failure> {
        let mut inner = self.lock();
        inner.trust.install(envelope)?;
        let version = inner.trust.status().map_or(0, |status| status.version);
        self.event(EventKind::Deployed, None, &format!("trust root {version} is installed"));
        self.verify(&mut inner);
        self.save(&mut inner)
    }

    /// Checks a deployment and runs it, or returns the files that are missing for it.
    ///
    /// # Errors
    ///
    /// A failure with the reason; what ran before goes on.
    pub(crate) fn deploy(&self, request: &DeployRequest) -> Result<DeployReply, Failure> {
        let reply = self.try_deploy(request);
        if let Err(failure) = &reply {
            self.event(EventKind::Refused, None, &failure.to_string());
        }
        reply
    }

    fn try_deploy(&self, request: &DeployRequest) -> Result<DeployReply, Failure> {
        let _deploying = self.deploying.lock().unwrap_or_else(PoisonError::into_inner);
        let mut inner = self.lock();
        let sent = inner.revisions(request)?;
        let verifier = inner.trust.verifier()?;
        let find = |digest: &Sha256| {
            let sent = sent.get(digest).map(|envelope| envelope.as_bytes().to_vec());
            sent.or_else(|| self.store.envelope(digest).ok())
        };
        let mut signed = SignedDeployment::verify(&verifier, request.deployment.as_bytes(), find)?;
        inner.check_name(&signed)?;
        let new: Vec<_> = signed.revisions().filter(|it| !self.store.has(it.digest())).collect();
        let missing = new.iter().flat_map(|revision| self.store.missing(revision.payload()));
        let objects: Vec<_> = missing.collect();
        inner.expected = expected(&new);
        drop(inner);
        if !objects.is_empty() {
            return Ok(DeployReply::Missing { objects });
        }
        for digest in signed.digests() {
            if let Some(envelope) = sent.get(digest) {
                self.store.add(digest, envelope.as_bytes())?;
            }
        }
        let manifests = signed.check_manifests(&self.store)?;
        let mut inner = self.lock();
        let memory = admission::memory(&manifests);
        self.memory.admit(signed.id(), memory, &inner.wanted_memory())?;
        drop(inner);
        for digest in signed.digests() {
            compile::component(&self.store.folder(digest), &self.cache)?;
        }
        inner = self.lock();
        inner.trust.accept(&signed.deployment, &signed.revision)?;
        let accepted = self.accept(&mut inner, signed, &request.deployment, memory)?;
        self.collect(&inner);
        Ok(accepted)
    }

    fn accept(
        &self,
        inner: &mut Inner,
        signed: SignedDeployment,
        envelope: &str,
        memory: u64,
    ) -> Result<DeployReply, Failure> {
        let id = signed.id().clone();
        let before = inner.state.deployments.get(&id);
        let is_same = before.is_some_and(|before| before.envelope == *envelope && before.is_wanted);
        if !is_same {
            let running = before.map(|_| inner.signed.get(&id)).and_then(|it| it?.as_ref().ok());
            let history = match (before, running) {
                (Some(before), Some(running)) => before.next_history(running.revision.digest()),
                (Some(before), None) => before.history.clone(),
                (None, _) => Vec::new(),
            };
            // The same envelope again is a start after a stop.
            let kept = before.filter(|before| before.envelope == *envelope);
            let deployed = Deployed {
                envelope: envelope.to_owned(),
                attempt: before.map_or(0, |before| before.attempt) + 1,
                is_wanted: true,
                runs_fallback: kept.is_some_and(|kept| kept.runs_fallback),
                is_proven: kept.is_some_and(|kept| kept.is_proven),
                failed: kept.and_then(|kept| kept.failed.clone()),
                history,
            };
            let revision = signed.revision.payload();
            let text = format!(
                "deployed release {} with {} {}",
                signed.deployment.payload().release,
                revision.name,
                revision.version
            );
            let mut state = inner.state.clone();
            state.deployments.insert(id.clone(), deployed);
            self.change(inner, state)?;
            inner.signed.insert(id.clone(), Ok(signed));
            inner.memory.insert(id.clone(), memory);
            self.publish(inner);
            self.event(EventKind::Deployed, Some(&id), &text);
        }
        inner.expected.clear();
        let attempt = inner.state.deployments.get(&id).map_or(0, |deployed| deployed.attempt);
        let generation = inner.state.generation;
        Ok(DeployReply::Accepted { id: id.to_string(), attempt, generation })
    }

    /// Returns the length of a file that is expected.
    ///
    /// # Errors
    ///
    /// A failure if no deployment that was offered needs it.
    pub(crate) fn expected(&self, sha256: &Sha256) -> Result<u64, Failure> {
        self.lock().expected.get(sha256).copied().ok_or_else(|| {
            Failure::new(Exit::Usage, format!("no deployment needs the file {sha256}"))
                .with_help("send the deployment first, and then the files that are missing")
        })
    }

    /// Stops a lambda, or starts it, also after a quarantine.
    ///
    /// # Errors
    ///
    /// A failure if there is no such deployment, or the disk is full.
    pub(crate) fn set_wanted(&self, id: &str, is_wanted: bool) -> Result<u64, Failure> {
        let (admitted, memory) = {
            let inner = self.lock();
            (inner.wanted_memory(), inner.memory.clone())
        };
        self.update(id, |deployed, signed| {
            if is_wanted && !deployed.is_wanted {
                let memory = memory.get(signed.id()).copied().unwrap_or(0);
                self.memory.admit(signed.id(), memory, &admitted)?;
            }
            deployed.is_wanted = is_wanted;
            deployed.attempt += u64::from(is_wanted);
            Ok(if is_wanted {
                (EventKind::Started, "started by a user".to_owned())
            } else {
                (EventKind::Stopped, "stopped by a user".to_owned())
            })
        })
    }

    /// Runs the fallback of a deployment.
    ///
    /// # Errors
    ///
    /// A failure if there is none, or it runs already.
    pub(crate) fn roll_back(&self, id: &str, reason: &str) -> Result<u64, Failure> {
        self.update(id, |deployed, signed| {
            let Some(fallback) = &signed.fallback else {
                let message = format!("deployment `{id}` has no fallback");
                return Err(Failure::new(Exit::Usage, message).with_help(
                    "deploy the earlier revision again: a deployer key has to sign that",
                ));
            };
            if deployed.runs_fallback {
                let message = format!("deployment `{id}` runs its fallback already");
                return Err(Failure::new(Exit::Usage, message));
            }
            deployed.runs_fallback = true;
            deployed.is_proven = true;
            deployed.is_wanted = true;
            deployed.attempt += 1;
            deployed.failed = Some(reason.to_owned());
            let version = &fallback.payload().version;
            Ok((EventKind::RolledBack, format!("runs its fallback {version}: {reason}")))
        })
    }

    fn update(
        &self,
        id: &str,
        change: impl FnOnce(&mut Deployed, &SignedDeployment) -> Result<(EventKind, String), Failure>,
    ) -> Result<u64, Failure> {
        let mut inner = self.lock();
        let mut state = inner.state.clone();
        let found = id.parse::<ItemName>().ok().and_then(|id| {
            let deployed = state.deployments.get_mut(&id)?;
            Some((deployed, inner.signed.get(&id)?, id))
        });
        let Some((deployed, signed, id)) = found else {
            let known: Vec<_> = inner.state.deployments.keys().map(ItemName::to_string).collect();
            let message = format!("there is no deployment `{}`", gleaner_base::excerpt(id));
            let help = match known.is_empty() {
                true => "`gleaner deploy --local DIR` makes one".to_owned(),
                false => format!("the deployments are `{}`", known.join("`, `")),
            };
            return Err(Failure::new(Exit::Usage, message).with_help(help));
        };
        let signed = signed.as_ref().map_err(|reason| {
            let mut failure = Failure::new(Exit::Denied, format!("deployment `{id}` is refused"));
            failure.causes = vec![reason.clone()];
            failure
        })?;
        let (kind, text) = change(deployed, signed)?;
        let attempt = deployed.attempt;
        self.change(&mut inner, state)?;
        self.publish(&mut inner);
        self.event(kind, Some(&id), &text);
        Ok(attempt)
    }

    /// Handles a status of the supervisor: a revision that failed in its probation is replaced by
    /// its fallback.
    pub(crate) fn observe(&self, status: SupervisorStatus) {
        let mut inner = self.lock();
        let mut proven = BTreeSet::new();
        let mut failed = Vec::new();
        for lambda in &status.lambdas {
            let Ok(id) = lambda.id.parse::<ItemName>() else { continue };
            let Some(deployed) = inner.state.deployments.get(&id) else { continue };
            if deployed.is_proven || deployed.attempt != lambda.attempt {
                continue;
            }
            let has_run = lambda.phase_s >= self.vehicle.deployments.probation.as_secs_f64();
            match lambda.phase {
                LambdaPhase::Running if has_run => {
                    proven.insert(id);
                }
                LambdaPhase::Quarantined => {
                    let signed = inner.signed.get(&id).and_then(|signed| signed.as_ref().ok());
                    if !deployed.runs_fallback && signed.is_some_and(|it| it.fallback.is_some()) {
                        let reason = lambda.last_end.clone().unwrap_or_default();
                        failed.push((id, reason));
                    }
                }
                _ => {}
            }
        }
        if !proven.is_empty() {
            let mut state = inner.state.clone();
            let all = state.deployments.iter_mut().filter(|(id, _)| proven.contains(*id));
            all.for_each(|(_, deployed)| deployed.is_proven = true);
            // On a full disk it is tried again with the next status.
            if inner.state_file.save(&state).is_ok() {
                inner.state = state;
            }
        }
        inner.status = Some(status);
        drop(inner);
        for (id, reason) in failed {
            // On a full disk it is tried again with the next status.
            let _ = self.roll_back(id.as_str(), &reason);
        }
    }

    /// Notes that the supervisor cannot be reached.
    pub(crate) fn lost_supervisor(&self) {
        self.lock().status = None;
    }

    /// Returns the status of all deployments, and that of the processes.
    pub(crate) fn status(&self) -> (Vec<DeploymentStatus>, Option<SupervisorStatus>, u64) {
        let inner = self.lock();
        let status = inner.state.deployments.iter().map(|(id, deployed)| {
            let lambdas = inner.status.iter().flat_map(|status| &status.lambdas);
            let lambda = lambdas.into_iter().find(|lambda| lambda.id == id.as_str()).cloned();
            let mut status = match inner.signed.get(id) {
                Some(Ok(signed)) => signed.status(deployed),
                Some(Err(reason)) => refused(id, deployed, reason),
                None => refused(id, deployed, "it was not checked"),
            };
            status.status = lambda;
            status
        });
        (status.collect(), inner.status.clone(), inner.state.generation)
    }

    /// Returns the memory that all wanted lambdas may take, and its limit.
    pub(crate) fn capacity(&self) -> Vec<gleaner_protocol::vehicle_api::Capacity> {
        let inner = self.lock();
        vec![self.memory.capacity(inner.wanted_memory().values().sum())]
    }

    /// Verifies all deployments of the state again.
    fn verify(&self, inner: &mut Inner) {
        let (mut signed, mut memory) = (BTreeMap::new(), BTreeMap::new());
        for (id, deployed) in &inner.state.deployments {
            let checked = inner.trust.verifier().and_then(|verifier| {
                let find = |digest: &Sha256| self.store.envelope(digest).ok();
                let envelope = deployed.envelope.as_bytes();
                let mut signed = SignedDeployment::verify(&verifier, envelope, find)?;
                let manifests = signed.check_manifests(&self.store)?;
                memory.insert(id.clone(), admission::memory(&manifests));
                Ok(signed)
            });
            if let Err(failure) = &checked {
                self.event(EventKind::Refused, Some(id), &failure.to_string());
            }
            signed.insert(id.clone(), checked.map_err(|failure| failure.to_string()));
        }
        (inner.signed, inner.memory) = (signed, memory);
    }

    /// Writes the state as it is, with the next generation, and publishes what is wanted.
    fn save(&self, inner: &mut Inner) -> Result<(), Failure> {
        let state = inner.state.clone();
        self.change(inner, state)?;
        self.publish(inner);
        Ok(())
    }

    fn change(&self, inner: &mut Inner, mut state: VehicleState) -> Result<(), Failure> {
        state.generation += 1;
        inner.state_file.save(&state)?;
        inner.state = state;
        Ok(())
    }

    fn publish(&self, inner: &mut Inner) {
        let wanted = inner.state.deployments.iter().filter(|(_, deployed)| deployed.is_wanted);
        let signed = wanted.filter_map(|(id, deployed)| {
            Some(inner.signed.get(id)?.as_ref().ok()?.desired(deployed, &self.store))
        });
        let (generation, lambdas) = (inner.state.generation, signed.collect());
        self.desired.send_replace(DesiredState { generation, lambdas });
    }

    /// Removes revisions that no deployment names, nor ran before.
    fn collect(&self, inner: &Inner) {
        let mut kept = BTreeSet::new();
        for (id, deployed) in &inner.state.deployments {
            match inner.signed.get(id) {
                Some(Ok(signed)) => kept.extend(signed.digests().cloned()),
                // Its revisions are unknown: nothing is removed.
                _ => return,
            }
            kept.extend(deployed.history.iter().cloned());
        }
        let expected = inner.expected.keys().cloned().collect();
        if let Err(failure) = self.store.collect(&kept, &expected) {
            self.event(EventKind::Warning, None, &failure.to_string());
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    /// Returns the memory that each wanted lambda may take.
    fn wanted_memory(&self) -> BTreeMap<ItemName, u64> {
        let is_wanted = |id: &ItemName| {
            self.state.deployments.get(id).is_some_and(|deployed| deployed.is_wanted)
        };
        let wanted = self.memory.iter().filter(|(id, _)| is_wanted(id));
        wanted.map(|(id, bytes)| (id.clone(), *bytes)).collect()
    }

    /// Returns the envelopes of a request, by the digests of their revisions.
    fn revisions(&self, request: &DeployRequest) -> Result<BTreeMap<Sha256, String>, Failure> {
        let verifier = self.trust.verifier()?;
        let digest = |envelope: &String| {
            let verified = verifier
                .revision(envelope.as_bytes())
                .map_err(|it| Failure::because("a revision is refused", &it))?;
            Ok((verified.digest().clone(), envelope.clone()))
        };
        request.revisions.iter().take(2).map(digest).collect()
    }

    /// Checks that the lambda of the deployment runs by no other deployment: clips and recordings
    /// know lambdas by their names.
    fn check_name(&self, signed: &SignedDeployment) -> Result<(), Failure> {
        let (id, name) = (signed.id(), &signed.revision.payload().name);
        let same_name = |(other, it): &(&ItemName, &Result<SignedDeployment, String>)| {
            *other != id && it.as_ref().is_ok_and(|it| it.revision.payload().name == *name)
        };
        if let Some((other, _)) = self.signed.iter().find(same_name) {
            let message = format!("lambda `{name}` runs already by deployment `{other}`");
            let help = format!("deploy it as `{other}`, or give the lambda another name");
            return Err(Failure::new(Exit::Usage, message).with_help(help));
        }
        let deployments = &self.state.deployments;
        if deployments.len() >= LAMBDAS_MAX && !deployments.contains_key(id) {
            let message = format!("a vehicle has at most {LAMBDAS_MAX} deployments");
            return Err(Failure::new(Exit::Denied, message));
        }
        Ok(())
    }
}

fn expected(revisions: &[&Trusted<Revision>]) -> BTreeMap<Sha256, u64> {
    let files = revisions.iter().flat_map(|revision| &revision.payload().files);
    files.map(|file| (file.sha256.clone(), file.bytes)).collect()
}

/// Returns the status of a deployment whose envelope counts no more.
fn refused(id: &ItemName, deployed: &Deployed, reason: &str) -> DeploymentStatus {
    let revision = RevisionStatus { digest: String::new(), version: String::new(), release: 0 };
    DeploymentStatus {
        id: id.to_string(),
        release: 0,
        lambda: String::new(),
        revision,
        fallback: None,
        grants: GrantStatus::default(),
        is_wanted: deployed.is_wanted,
        runs_fallback: deployed.runs_fallback,
        is_proven: deployed.is_proven,
        failed: deployed.failed.clone(),
        refused: Some(reason.to_owned()),
        stale: None,
        status: None,
    }
}
