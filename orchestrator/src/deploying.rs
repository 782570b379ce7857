//! Deployments: checks one that is offered, receives its files, and accepts it.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::{Arc, MutexGuard, PoisonError};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::Manifest;
use gleaner_lambda::manifest::{ItemName, Sha256};
use gleaner_protocol::supervision::{EventKind, LAMBDAS_MAX};
use gleaner_protocol::vehicle_api::{DeployReply, DeployRequest, MissingObject};
use gleaner_trust::{Revision, Trusted, Verifier};

use crate::checked::SignedDeployment;
use crate::compile;
use crate::orchestrator::{Inner, Orchestrator};
use crate::spools;
use crate::state::{Deployed, DesiredDeployment, VehicleState};
use crate::store::KnownFiles;

/// Maximum number of deployments that wait for files.
const OFFERS_MAX: usize = LAMBDAS_MAX;

impl Orchestrator {
    /// Checks a deployment and runs it, or returns the files that are missing for it. `wish` is
    /// that of the cloud if it comes from there.
    ///
    /// # Errors
    ///
    /// A failure with the reason; what ran before goes on.
    pub(crate) fn deploy(
        &self,
        request: &DeployRequest,
        wish: Option<&DesiredDeployment>,
    ) -> Result<DeployReply, Failure> {
        let reply = self.try_deploy(request, wish);
        if let Err(failure) = &reply {
            // Those of a cloud are noted by the caller, which bounds them.
            if wish.is_none() {
                self.event(EventKind::Refused, None, &failure.to_string());
            }
            // What has expired once stays expired, also if the clock is reset soon.
            self.observe_time();
        }
        reply
    }

    fn try_deploy(
        &self,
        request: &DeployRequest,
        wish: Option<&DesiredDeployment>,
    ) -> Result<DeployReply, Failure> {
        match ReceivedDeployment::verify(self, request, wish)?.fetch()? {
            ControlFlow::Continue(fetched) => fetched.admit()?.compile()?.install(),
            ControlFlow::Break(missing) => Ok(missing),
        }
    }

    /// Waits for the operation that changes the store.
    fn changing(&self) -> MutexGuard<'_, ()> {
        self.deploying.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Verifies all deployments of the state again.
    pub(crate) fn verify(&self, inner: &mut Inner) {
        (inner.signed, inner.manifests) = (BTreeMap::new(), BTreeMap::new());
        self.verify_others(inner, &BTreeMap::new());
    }

    /// Verifies those deployments again that are refused: this machine may have lacked memory or
    /// open files, or its disk may have failed.
    pub(crate) fn verify_refused(&self) {
        let mut inner = self.lock();
        let all = std::mem::take(&mut inner.signed);
        let refused: BTreeMap<_, _>;
        (inner.signed, refused) = all.into_iter().partition(|(_, signed)| signed.is_ok());
        if refused.is_empty() {
            return;
        }
        self.verify_others(&mut inner, &refused);
        for id in refused.keys().filter(|id| inner.signed[*id].is_ok()) {
            self.event(EventKind::Deployed, Some(id), "accepted again; earlier refusal cleared");
        }
        self.publish(&mut inner);
    }

    /// Verifies the deployments that were not verified yet. A refusal is an event, unless it is as
    /// in `before`.
    fn verify_others(
        &self,
        inner: &mut Inner,
        before: &BTreeMap<ItemName, Result<SignedDeployment, String>>,
    ) {
        let Inner { state, trust, signed, manifests, .. } = inner;
        for (id, deployed) in &state.deployments {
            if signed.contains_key(id) {
                continue;
            }
            let checked = trust.verifier().and_then(|verifier| {
                let find = |digest: &Sha256| self.store.envelope(digest).ok();
                let envelope = deployed.envelope.as_bytes();
                let mut signed = SignedDeployment::verify(&verifier, envelope, find)?;
                manifests.insert(id.clone(), self.check_manifests(&mut signed)?);
                Ok(signed)
            });
            let checked = checked.map_err(|failure| failure.to_string());
            if let Err(reason) = &checked
                && before.get(id).and_then(|it| it.as_ref().err()) != Some(reason)
            {
                self.event(EventKind::Refused, Some(id), reason);
            }
            signed.insert(id.clone(), checked);
        }
    }

    /// Checks the manifests of a deployment, and returns them with the limits that apply here.
    pub(crate) fn check_manifests(
        &self,
        signed: &mut SignedDeployment,
    ) -> Result<Vec<(Sha256, Manifest)>, Failure> {
        let mut manifests = signed.check_manifests(&self.store)?;
        for (_, manifest) in &mut manifests {
            manifest.limits = manifest.limits.tightened_by(&self.vehicle.limits).0;
        }
        Ok(manifests)
    }

    /// Removes a deployment, as `by` wants it, and lets its lambda end. What the vehicle has
    /// accepted stays remembered: no earlier release of it is accepted afterwards.
    pub(crate) fn remove(&self, id: &str, by: &str) -> Result<(), Failure> {
        let _changing = self.changing();
        let mut inner = self.lock();
        let name = id.parse::<ItemName>().ok();
        let Some(name) = name.filter(|name| inner.state.deployments.contains_key(name)) else {
            return Err(inner.unknown(id));
        };
        inner.change(|state| state.remove(&name, spools::KEPT))?;
        inner.signed.remove(&name);
        inner.manifests.remove(&name);
        inner.expected.remove(&name);
        self.publish(&mut inner);
        inner.has_removed = true;
        self.event(EventKind::Stopped, Some(&name), &format!("removed by {by}"));
        let running = inner.status.iter().flat_map(|status| &status.lambdas);
        let running = running.map(|lambda| lambda.id.clone());
        let VehicleState { deployments, removed, .. } = &inner.state;
        let kept = deployments.keys().chain(removed).map(ItemName::to_string);
        let kept = running.chain(kept).collect();
        drop(inner);
        for id in spools::collect(&self.layout.lambda_spools(), &kept) {
            let text = format!("the records of `{id}`, which was removed earlier, are removed");
            self.event(EventKind::Loss, None, &text);
        }
        Ok(())
    }

    /// Returns the length of a file, if a deployment that was offered needs it.
    pub(crate) fn expected(&self, sha256: &Sha256) -> Result<u64, Failure> {
        let inner = self.lock();
        inner.expected.values().find_map(|files| files.get(sha256)).copied().ok_or_else(|| {
            Failure::new(Exit::Usage, format!("no deployment needs the file {sha256}"))
                .with_help("send the deployment first, and then the files that are missing")
        })
    }
}

/// A deployment that is offered. The next steps follow, each made only by the one before; then it
/// is accepted.
struct ReceivedDeployment<'d> {
    core: &'d Orchestrator,
    request: &'d DeployRequest,
    /// The wish of the cloud, if the deployment comes from there.
    wish: Option<&'d DesiredDeployment>,
    /// The envelopes of revisions that were sent with it.
    sent: BTreeMap<Sha256, String>,
}

/// A deployment whose signatures and name were checked. While it exists, no other operation changes
/// the store.
struct VerifiedDeployment<'d> {
    offer: ReceivedDeployment<'d>,
    changing: MutexGuard<'d, ()>,
    signed: SignedDeployment,
}

/// A deployment whose files are all in the store, and durable.
struct FetchedDeployment<'d>(VerifiedDeployment<'d>);

/// A deployment for which the vehicle has room, and whose manifests fit.
struct AdmittedDeployment<'d> {
    offer: ReceivedDeployment<'d>,
    signed: SignedDeployment,
    manifests: Vec<(Sha256, Manifest)>,
    /// Its revisions, which are kept for as long as this exists.
    kept: Arc<[Sha256]>,
}

/// A deployment that can be started without a delay.
struct CompiledDeployment<'d>(AdmittedDeployment<'d>);

impl<'d> ReceivedDeployment<'d> {
    fn verify(
        core: &'d Orchestrator,
        request: &'d DeployRequest,
        wish: Option<&'d DesiredDeployment>,
    ) -> Result<VerifiedDeployment<'d>, Failure> {
        let changing = core.changing();
        let inner = core.lock();
        let offer = Self { core, request, wish, sent: inner.revisions(request)? };
        let signed = offer.check(&inner)?;
        Ok(VerifiedDeployment { offer, changing, signed })
    }

    /// Checks it by the trust and the deployments of now.
    fn check(&self, inner: &Inner) -> Result<SignedDeployment, Failure> {
        let known = inner.known_revisions();
        let verifier = Verifier { known: &known, ..inner.trust.verifier()? };
        let envelope = self.request.deployment.as_bytes();
        let signed = SignedDeployment::verify(&verifier, envelope, |digest| self.find(digest))?;
        inner.check_name(&signed)?;
        Ok(signed)
    }

    /// Returns the envelope of a revision.
    fn find(&self, digest: &Sha256) -> Option<Vec<u8>> {
        let sent = self.sent.get(digest).map(|envelope| envelope.as_bytes().to_vec());
        sent.or_else(|| self.core.store.envelope(digest).ok())
    }

    /// Returns the state of the deployment once it is accepted; `None` if it is as it is.
    fn deployed(&self, inner: &Inner, signed: &SignedDeployment) -> Option<Deployed> {
        let Self { request: DeployRequest { deployment: envelope, .. }, wish, .. } = self;
        let before = inner.state.deployments.get(signed.id());
        // The same envelope again is a start after a stop.
        let kept = before.filter(|before| before.envelope == *envelope);
        let is_noted = |kept: &Deployed| wish.is_none() || kept.cloud.as_ref() == *wish;
        if kept.is_some_and(|kept| kept.is_wanted && is_noted(kept)) {
            return None;
        }
        let running = inner.signed.get(signed.id()).and_then(|it| it.as_ref().ok());
        let history = match (before, running) {
            (Some(before), Some(running)) => before.next_history(running.revision.digest()),
            (Some(before), None) => before.history.clone(),
            (None, _) => Vec::new(),
        };
        Some(Deployed {
            envelope: envelope.clone(),
            lambda: signed.revision.payload().name.clone(),
            release: signed.deployment.payload().release,
            // Of a removed deployment of this id, an attempt may still end: no later one has its
            // number, as no attempt is above the generation.
            attempt: before.map_or(inner.state.generation, |before| before.attempt) + 1,
            is_wanted: true,
            runs_fallback: kept.is_some_and(|kept| kept.runs_fallback),
            is_proven: kept.is_some_and(|kept| kept.is_proven),
            failed: kept.and_then(|kept| kept.failed.clone()),
            history,
            cloud: wish.or(kept.and_then(|kept| kept.cloud.as_ref())).cloned(),
        })
    }
}

impl<'d> VerifiedDeployment<'d> {
    /// Stores its revisions, or notes and returns the files that are missing for that.
    fn fetch(self) -> Result<ControlFlow<DeployReply, FetchedDeployment<'d>>, Failure> {
        let Self { offer, signed, .. } = &self;
        let store = &offer.core.store;
        let damaged = |revision: &&Trusted<Revision>| !store.is_intact(revision);
        let new: Vec<_> = signed.revisions().filter(damaged).collect();
        let mut known = if new.is_empty() { KnownFiles::new() } else { store.known_files() };
        let missing = new.iter().flat_map(|it| store.missing(it.payload(), &known));
        let objects: Vec<_> = missing.collect();
        if !objects.is_empty() {
            offer.core.lock().expect(signed.id(), &objects)?;
            return Ok(ControlFlow::Break(DeployReply::Missing { objects }));
        }
        for digest in new.into_iter().map(Trusted::digest) {
            if let Some(envelope) = offer.find(digest) {
                store.add(digest, &envelope, &mut known)?;
            }
        }
        Ok(ControlFlow::Continue(FetchedDeployment(self)))
    }
}

impl<'d> FetchedDeployment<'d> {
    fn admit(self) -> Result<AdmittedDeployment<'d>, Failure> {
        let VerifiedDeployment { offer, changing: _changing, mut signed } = self.0;
        let manifests = offer.core.check_manifests(&mut signed)?;
        let mut inner = offer.core.lock();
        offer.core.admit(&inner, signed.id(), inner.measured.model().of(&manifests))?;
        let kept = signed.digests().cloned().collect();
        inner.compiling.retain(|revisions| revisions.strong_count() > 0);
        inner.compiling.push(Arc::downgrade(&kept));
        Ok(AdmittedDeployment { offer, signed, manifests, kept })
    }
}

impl<'d> AdmittedDeployment<'d> {
    /// Makes what a start needs. Others are deployed meanwhile.
    fn compile(self) -> Result<CompiledDeployment<'d>, Failure> {
        let core = self.offer.core;
        for digest in &*self.kept {
            let folder = core.store.folder(digest);
            compile::component(&folder, &core.layout.cache())?;
            // As before each start: what does not fit is refused while the former lambda runs.
            gleaner_supervisor::wheels::prepare(&folder)?;
        }
        Ok(CompiledDeployment(self))
    }
}

impl CompiledDeployment<'_> {
    fn install(self) -> Result<DeployReply, Failure> {
        let AdmittedDeployment { offer, signed, manifests, kept: _kept } = self.0;
        let core = offer.core;
        let _changing = core.changing();
        let mut inner = core.lock();
        // Another trust root may have been installed, and other deployments accepted.
        offer.check(&inner)?;
        core.admit(&inner, signed.id(), inner.measured.model().of(&manifests))?;
        let id = signed.id().clone();
        if let Some(deployed) = offer.deployed(&inner, &signed) {
            let Revision { name, version, .. } = signed.revision.payload();
            let text = format!("deployed release {} with {name} {version}", deployed.release);
            inner.trust.accept(&signed.deployment, &signed.revision)?;
            inner.change(|state| state.deployments.insert(id.clone(), deployed))?;
            inner.signed.insert(id.clone(), Ok(signed));
            inner.manifests.insert(id.clone(), manifests);
            core.publish(&mut inner);
            core.event(EventKind::Deployed, Some(&id), &text);
        }
        inner.expected.remove(&id);
        core.collect(&mut inner);
        let attempt = inner.state.deployments.get(&id).map_or(0, |deployed| deployed.attempt);
        let generation = inner.state.generation;
        Ok(DeployReply::Accepted { id: id.to_string(), attempt, generation })
    }
}

impl Inner {
    /// Returns the revisions that ran here by the present deployments, and their fallbacks.
    fn known_revisions(&self) -> Vec<Sha256> {
        let ran = self.state.deployments.values().flat_map(|deployed| &deployed.history);
        let signed = self.signed.values().flatten().flat_map(SignedDeployment::digests);
        ran.chain(signed).cloned().collect()
    }

    /// Notes the files that a deployment needs.
    fn expect(&mut self, id: &ItemName, objects: &[MissingObject]) -> Result<(), Failure> {
        if self.expected.len() >= OFFERS_MAX && !self.expected.contains_key(id) {
            let message = "too many deployments wait for files".to_owned();
            let help = "send the files of those that were offered, or start the daemon again";
            return Err(Failure::new(Exit::Unreachable, message).with_help(help));
        }
        let files = objects.iter().filter_map(|it| Some((it.sha256.parse().ok()?, it.bytes)));
        self.expected.insert(id.clone(), files.collect());
        Ok(())
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
        let same_name = |(other, it): &(&ItemName, &Deployed)| *other != id && it.lambda == *name;
        if let Some((other, _)) = self.state.deployments.iter().find(same_name) {
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
