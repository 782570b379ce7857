//! The state of the vehicle, and the operations that change it. Each is durable before it counts.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, MutexGuard, PoisonError, Weak};
use std::time::Instant;

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::{ItemName, Sha256};
use gleaner_lambda::{Manifest, Vehicle};
use gleaner_protocol::supervision::{
    DesiredState, EventKind, LambdaPhase, SupervisorStatus, VehicleEvent,
};
use gleaner_supervisor::EventLog;
use gleaner_trust::{PublicKey, VehicleName};
use tokio::sync::watch;

use crate::admission::{self, Budgets, LambdaDemand, Measurements};
use crate::checked::SignedDeployment;
use crate::durable::DurableFile;
use crate::layout::VehicleFolders;
use crate::state::{Deployed, DesiredDeployment, VehicleState};
use crate::store::{self, RevisionStore};
use crate::trust::VehicleTrust;

/// The vehicle.
pub(crate) struct Orchestrator {
    pub(crate) vehicle: Vehicle,
    pub(crate) layout: VehicleFolders,
    pub(crate) name: VehicleName,
    pub(crate) key: PublicKey,
    pub(crate) started: Instant,
    pub(crate) store: RevisionStore,
    pub(crate) budgets: Budgets,
    pub(crate) events: EventLog,
    pub(crate) desired: watch::Sender<DesiredState>,
    pub(crate) inner: Mutex<Inner>,
    /// Held by the operation that changes the store. Compiling does not change it.
    pub(crate) deploying: Mutex<()>,
}

/// State that changes.
pub(crate) struct Inner {
    pub(crate) trust: VehicleTrust,
    pub(crate) state: VehicleState,
    pub(crate) state_file: DurableFile,
    /// The deployments of the state that were verified, or the reasons why they do not run.
    pub(crate) signed: BTreeMap<ItemName, Result<SignedDeployment, String>>,
    /// Files that deployments need that were offered, and their lengths.
    pub(crate) expected: BTreeMap<ItemName, BTreeMap<Sha256, u64>>,
    /// The manifests of the revisions of each deployment, with their digests.
    pub(crate) manifests: BTreeMap<ItemName, Vec<(Sha256, Manifest)>>,
    /// Revisions that are compiled for deployments that are not accepted yet.
    pub(crate) compiling: Vec<Weak<[Sha256]>>,
    /// True after a removal, until its files are removed; and at the start, as an earlier process
    /// may not have come to that.
    pub(crate) has_removed: bool,
    /// True if the state was missing at the start, and revisions were not: none is removed.
    keeps_revisions: bool,
    /// Use of resources so far.
    pub(crate) measured: Measurements,
    pub(crate) status: Option<SupervisorStatus>,
}

impl Orchestrator {
    /// Loads the state, and verifies every deployment in it.
    ///
    /// # Errors
    ///
    /// A failure if both copies of the state are damaged, or a folder cannot be used.
    pub(crate) fn open(
        layout: VehicleFolders,
        vehicle: Vehicle,
        (name, key): (VehicleName, PublicKey),
    ) -> Result<Self, Failure> {
        let events = EventLog::open(&layout.spool(), "orchestrator")?;
        let state_file = DurableFile::new(layout.state_file());
        let loaded = state_file.load::<VehicleState>()?;
        let store = RevisionStore::open(&layout)?;
        let keeps_revisions = loaded.value.is_none() && store.has_any()?;
        let state = loaded.value.unwrap_or_default();
        let labels = vehicle.identity.labels.clone();
        let (measured, measured_damage) = Measurements::load(DurableFile::new(layout.measured()));
        let (trust, damage) = VehicleTrust::load(&layout, labels, state.floors.clone());
        let inner = Inner {
            trust,
            state,
            state_file,
            signed: BTreeMap::new(),
            expected: BTreeMap::new(),
            manifests: BTreeMap::new(),
            compiling: Vec::new(),
            has_removed: true,
            keeps_revisions,
            measured,
            status: None,
        };
        let core = Self {
            name,
            key,
            started: Instant::now(),
            store,
            budgets: Budgets::of(&vehicle),
            events,
            desired: watch::Sender::new(DesiredState::default()),
            inner: Mutex::new(inner),
            deploying: Mutex::new(()),
            layout,
            vehicle,
        };
        core.event(EventKind::Started, None, "the orchestrator has started");
        let damages =
            [("trust root", damage), ("state", loaded.damage), ("measurements", measured_damage)];
        for (file, damage) in damages {
            if let Some(damage) = damage {
                core.warn(&format!("the file of the {file} is damaged: {damage}"));
            }
        }
        core.begin();
        // The verification takes time.
        Ok(Self { started: Instant::now(), ..core })
    }

    /// Verifies every deployment of the state that was loaded, and lets it count.
    fn begin(&self) {
        let mut inner = self.lock();
        if inner.keeps_revisions {
            self.warn(&format!(
                "`{}` and its copy are missing, so nothing is deployed; revisions are kept until \
                 the next start: restore the file from a backup before, or deploy again",
                self.layout.state_file().display()
            ));
        }
        inner.trust.observe_time();
        self.verify(&mut inner);
        // What was repaired is written again. A full disk does not keep anything from running.
        if let Err(failure) = self.save(&mut inner) {
            self.warn(&failure.to_string());
        }
        self.collect(&mut inner);
    }

    pub(crate) fn desired(&self) -> watch::Receiver<DesiredState> {
        self.desired.subscribe()
    }

    /// Adds an event to the spool of the orchestrator.
    pub(crate) fn event(&self, event: EventKind, lambda: Option<&ItemName>, text: &str) {
        self.events.add(&VehicleEvent {
            event,
            lambda: lambda.map(ItemName::to_string),
            revision: None,
            text: gleaner_base::in_one_line(text),
        });
    }

    /// Adds a warning about the vehicle as a whole.
    pub(crate) fn warn(&self, text: &str) {
        self.event(EventKind::Warning, None, text);
    }

    pub(crate) fn trust<T>(&self, read: impl FnOnce(&VehicleTrust) -> T) -> T {
        read(&self.lock().trust)
    }

    /// Moves the trusted time to that of the clock, and makes that durable if it is a minute or
    /// more.
    pub(crate) fn observe_time(&self) {
        let mut inner = self.lock();
        inner.trust.observe_time();
        if !inner.trust.floors().is_later(&inner.state.floors, 60) {
            return;
        }
        match inner.change(|_| ()) {
            Ok(()) => self.publish(&mut inner),
            Err(failure) => self.warn(&failure.to_string()),
        }
    }

    /// Installs a trust root, and verifies all deployments by it. A refused one changes nothing.
    pub(crate) fn install_root(&self, envelope: &[u8]) -> Result<(), Failure> {
        let mut inner = self.lock();
        inner.trust.install(envelope)?;
        let version = inner.trust.status().map_or(0, |status| status.version);
        self.event(EventKind::Deployed, None, &format!("trust root {version} is installed"));
        self.verify(&mut inner);
        self.save(&mut inner)
    }

    /// Stops a lambda, or starts it, also after a quarantine. `by` is who wants it.
    pub(crate) fn set_wanted(&self, id: &str, is_wanted: bool, by: &str) -> Result<u64, Failure> {
        self.update(id, |inner, deployed, signed| {
            if is_wanted && !deployed.is_wanted {
                self.admit(inner, signed.id(), inner.demand(signed.id()))?;
            }
            deployed.is_wanted = is_wanted;
            deployed.attempt += u64::from(is_wanted);
            Ok(if is_wanted {
                (EventKind::Started, format!("started by {by}"))
            } else {
                (EventKind::Stopped, format!("stopped by {by}"))
            })
        })
    }

    /// Refuses a deployment that asks for more than the vehicle has.
    pub(crate) fn admit(
        &self,
        inner: &Inner,
        id: &ItemName,
        demand: Option<LambdaDemand>,
    ) -> Result<(), Failure> {
        let Some(demand) = demand else { return Ok(()) };
        self.budgets.admit(id, &demand, &inner.wanted_demand())
    }

    /// Returns whether the lambda of a deployment is wanted and not quarantined, as far as the
    /// supervisor has reported it.
    pub(crate) fn runs(&self, id: &ItemName) -> bool {
        let inner = self.lock();
        let deployed = inner.state.deployments.get(id);
        let reported = inner.status.iter().flat_map(|status| &status.lambdas);
        let mut own = reported.filter(|lambda| {
            deployed.is_some_and(|it| it.is_wanted && it.attempt == lambda.attempt)
                && lambda.id == id.as_str()
        });
        own.next().is_some_and(|lambda| lambda.phase != LambdaPhase::Quarantined)
    }

    /// Runs the fallback of a deployment. It is a failure if there is none, or it runs already, or
    /// the deployment is stopped.
    pub(crate) fn roll_back(&self, id: &str, reason: &str) -> Result<u64, Failure> {
        self.update(id, |_, deployed, signed| {
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
            if !deployed.is_wanted {
                let message = format!("deployment `{id}` is stopped");
                let help = format!("start it first: `gleaner start {id}`");
                return Err(Failure::new(Exit::Usage, message).with_help(help));
            }
            deployed.runs_fallback = true;
            deployed.is_proven = true;
            deployed.attempt += 1;
            deployed.failed = Some(reason.to_owned());
            let version = &fallback.payload().version;
            Ok((EventKind::RolledBack, format!("runs its fallback {version}: {reason}")))
        })
    }

    /// Notes that a wish of the cloud was followed.
    pub(crate) fn note_wish(&self, id: &ItemName, wish: &DesiredDeployment) -> Result<(), Failure> {
        let mut inner = self.lock();
        let deployed = inner.state.deployments.get(id).cloned();
        let deployed = deployed.ok_or_else(|| inner.unknown(id.as_str()))?;
        let deployed = Deployed { cloud: Some(wish.clone()), ..deployed };
        inner.change(|state| state.deployments.insert(id.clone(), deployed))?;
        self.publish(&mut inner);
        Ok(())
    }

    fn update(
        &self,
        id: &str,
        change: impl FnOnce(
            &Inner,
            &mut Deployed,
            &SignedDeployment,
        ) -> Result<(EventKind, String), Failure>,
    ) -> Result<u64, Failure> {
        let mut inner = self.lock();
        let found = id.parse::<ItemName>().ok().and_then(|id| {
            let deployed = inner.state.deployments.get(&id)?.clone();
            Some((deployed, inner.signed.get(&id)?, id))
        });
        let Some((mut deployed, signed, id)) = found else { return Err(inner.unknown(id)) };
        let signed = signed.as_ref().map_err(|reason| {
            let mut failure = Failure::new(Exit::Denied, format!("deployment `{id}` is refused"));
            failure.causes = vec![reason.clone()];
            failure
        })?;
        let (kind, text) = change(&inner, &mut deployed, signed)?;
        let attempt = deployed.attempt;
        inner.change(|state| state.deployments.insert(id.clone(), deployed))?;
        self.publish(&mut inner);
        self.event(kind, Some(&id), &text);
        Ok(attempt)
    }

    /// Handles a status of the supervisor: a revision that failed in its probation is replaced by
    /// its fallback.
    pub(crate) fn observe(&self, status: SupervisorStatus) {
        let inner = self.lock();
        let mut proven = BTreeSet::new();
        let mut failed = Vec::new();
        for lambda in &status.lambdas {
            let Ok(id) = lambda.id.parse::<ItemName>() else { continue };
            let Some(deployed) = inner.state.deployments.get(&id) else { continue };
            if deployed.is_proven || deployed.attempt != lambda.attempt {
                continue;
            }
            let has_run = lambda.phase_s >= self.vehicle.deployments.probation.as_secs_f64();
            let failure = match lambda.phase {
                LambdaPhase::Quarantined => Some(lambda.last_end.clone().unwrap_or_default()),
                _ => lambda.recent.faulty(),
            };
            match failure {
                Some(reason) => {
                    let signed = inner.signed.get(&id).and_then(|signed| signed.as_ref().ok());
                    if !deployed.runs_fallback && signed.is_some_and(|it| it.fallback.is_some()) {
                        failed.push((id, reason));
                    }
                }
                None if lambda.phase == LambdaPhase::Running && has_run => {
                    proven.insert(id);
                }
                None => {}
            }
        }
        drop(inner);
        for (id, reason) in failed {
            // On a full disk it is tried again with the next status.
            let _ = self.roll_back(id.as_str(), &reason);
        }
        let mut inner = self.lock();
        if !proven.is_empty() {
            // On a full disk it is tried again with the next status.
            let _ = inner.change(|state| {
                let all = state.deployments.iter_mut().filter(|(id, _)| proven.contains(*id));
                all.for_each(|(_, deployed)| deployed.is_proven = true);
            });
        }
        if inner.measured.observe(&status) {
            self.report_excess(&mut inner, &status);
            inner.measured.save_if_changed();
        }
        inner.status = Some(status);
        drop(inner);
        self.collect_removed();
    }

    /// Removes the revisions and the records of ends of removed deployments, once the supervisor
    /// reports that their lambdas have ended.
    fn collect_removed(&self) {
        let Ok(_changing) = self.deploying.try_lock() else { return };
        let mut inner = self.lock();
        let is_due = inner.has_removed && !inner.keeps_revisions;
        let Some(status) = inner.status.as_ref().filter(|_| is_due) else { return };
        let is_deployed = |inner: &Inner, id: &str| {
            id.parse::<ItemName>().is_ok_and(|id| inner.state.deployments.contains_key(&id))
        };
        let have_ended = status.lambdas.iter().all(|lambda| is_deployed(&inner, &lambda.id));
        if have_ended && status.generation >= inner.state.generation {
            inner.has_removed = false;
            self.collect(&mut inner);
            for path in store::entries(&self.layout.records()).unwrap_or_default() {
                let id = path.file_name().map(|name| name.to_string_lossy().into_owned());
                if !id.is_some_and(|id| is_deployed(&inner, &id)) {
                    store::remove(&path);
                }
            }
        }
    }

    /// Adds an event for each lambda that uses more than it states, once for each revision.
    fn report_excess(&self, inner: &mut Inner, status: &SupervisorStatus) {
        for lambda in &status.lambdas {
            let Ok(id) = lambda.id.parse::<ItemName>() else { continue };
            let demand = inner.demand(&id).map(|demand| self.budgets.demand(&demand));
            for of in demand.into_iter().flatten().filter(|of| of.exceeds) {
                let digest = lambda.revision.parse::<Sha256>();
                if digest.is_ok_and(|digest| inner.measured.report(&digest)) {
                    let text = format!(
                        "it uses more {} than it states: {:.2} {}, {}",
                        of.resource, of.asked, of.unit, of.source
                    );
                    self.event(EventKind::Warning, Some(&id), &text);
                }
            }
        }
    }

    /// Measures the speed of this machine, unless that was done before.
    pub(crate) fn measure_speed(&self) {
        let machine = admission::machine();
        if self.lock().measured.has_speed_of(&machine) {
            return;
        }
        match admission::fuel_per_second() {
            Ok(speed) => self.lock().measured.set_speed(machine, speed),
            Err(failure) => self.warn(&failure.to_string()),
        }
    }

    /// Writes the state as it is, with the next generation, and publishes what is wanted.
    pub(crate) fn save(&self, inner: &mut Inner) -> Result<(), Failure> {
        let saved = inner.change(|_| ());
        self.publish(inner);
        saved
    }

    pub(crate) fn publish(&self, inner: &mut Inner) {
        let wanted = inner.state.deployments.iter().filter(|(_, deployed)| deployed.is_wanted);
        let signed = wanted.filter_map(|(id, deployed)| {
            Some(inner.signed.get(id)?.as_ref().ok()?.desired(deployed, &self.store))
        });
        let (generation, lambdas) = (inner.state.generation, signed.collect());
        self.desired.send_replace(DesiredState { generation, lambdas });
    }

    /// Removes revisions that no deployment names, nor ran before.
    pub(crate) fn collect(&self, inner: &mut Inner) {
        if inner.keeps_revisions {
            return;
        }
        let compiling = inner.compiling.iter().filter_map(Weak::upgrade);
        let mut kept: BTreeSet<_> = compiling.flat_map(|revisions| revisions.to_vec()).collect();
        for (id, deployed) in &inner.state.deployments {
            match inner.signed.get(id) {
                Some(Ok(signed)) => kept.extend(signed.digests().cloned()),
                // Its revisions are unknown: nothing is removed.
                _ => return,
            }
            kept.extend(deployed.history.iter().cloned());
        }
        let expected = inner.expected.values().flat_map(BTreeMap::keys).cloned().collect();
        let manifests = inner.manifests.values().flatten();
        let models = manifests.flat_map(|(_, manifest)| &manifest.models);
        let models = models.map(|model| model.sha256.clone()).collect();
        inner.measured.retain(&kept, &models);
        if let Err(failure) = self.store.collect(&kept, &expected) {
            self.warn(&failure.to_string());
        }
    }

    pub(crate) fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    /// Changes the state, which becomes the next generation with what is trusted now. `change` gets
    /// a copy: what was not written does not count.
    pub(crate) fn change<T>(
        &mut self,
        change: impl FnOnce(&mut VehicleState) -> T,
    ) -> Result<T, Failure> {
        let mut state = self.state.clone();
        let changed = change(&mut state);
        state.generation += 1;
        state.floors = self.trust.floors().clone();
        if let Err(failure) = self.state_file.save(&state) {
            self.trust.reset_floors(self.state.floors.clone());
            return Err(failure);
        }
        self.state = state;
        Ok(changed)
    }

    /// Returns the failure for an id without a deployment.
    pub(crate) fn unknown(&self, id: &str) -> Failure {
        let known: Vec<_> = self.state.deployments.keys().map(ItemName::to_string).collect();
        let message = format!("there is no deployment `{}`", gleaner_base::excerpt(id));
        let help = match known.is_empty() {
            true => "`gleaner deploy --local DIR` makes one".to_owned(),
            false => format!("the deployments are `{}`", known.join("`, `")),
        };
        Failure::new(Exit::Usage, message).with_help(help)
    }

    /// Returns the demand of a deployment that was verified.
    pub(crate) fn demand(&self, id: &ItemName) -> Option<LambdaDemand> {
        self.measured.model().of(self.manifests.get(id)?)
    }

    pub(crate) fn wanted_demand(&self) -> BTreeMap<ItemName, LambdaDemand> {
        let wanted = self.state.deployments.iter().filter(|(_, deployed)| deployed.is_wanted);
        wanted.filter_map(|(id, _)| Some((id.clone(), self.demand(id)?))).collect()
    }
}

#[cfg(test)]
impl Orchestrator {
    /// Creates a vehicle with its state in the folder `state`, and its socket in `run`.
    pub(crate) fn in_folder(folder: &std::path::Path, settings: Vehicle) -> std::sync::Arc<Self> {
        let [state, run] = ["state", "run"].map(|name| folder.join(name));
        let layout = VehicleFolders::create(&state, &run).unwrap();
        let key = gleaner_trust::SecretKey::generate().unwrap().public();
        Self::open(layout, settings, ("car".parse().unwrap(), key)).unwrap().into()
    }
}
