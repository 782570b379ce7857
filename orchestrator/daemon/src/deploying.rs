//! Deployments: checks one that is offered, receives its files, and accepts it.

use std::collections::BTreeMap;
use std::sync::PoisonError;

use gleaner_base::{Exit, Failure};
use gleaner_lambda::Manifest;
use gleaner_lambda::manifest::{ItemName, Sha256};
use gleaner_protocol::supervision::{EventKind, LAMBDAS_MAX};
use gleaner_protocol::vehicle_api::{DeployReply, DeployRequest, MissingObject};
use gleaner_trust::{Revision, Trusted, Verifier};

use crate::checked::SignedDeployment;
use crate::compile;
use crate::core::{Core, Inner};
use crate::spools;
use crate::state::{CloudWish, Deployed, VehicleState};
use crate::store::KnownFiles;

/// Maximum number of deployments that wait for files.
const OFFERS_MAX: usize = LAMBDAS_MAX;

impl Core {
    /// Checks a deployment and runs it, or returns the files that are missing for it. `wish` is
    /// that of the cloud if it comes from there.
    ///
    /// # Errors
    ///
    /// A failure with the reason; what ran before goes on.
    pub(crate) fn deploy(
        &self,
        request: &DeployRequest,
        wish: Option<&CloudWish>,
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
        wish: Option<&CloudWish>,
    ) -> Result<DeployReply, Failure> {
        let deploying = || self.deploying.lock().unwrap_or_else(PoisonError::into_inner);
        let changing = deploying();
        let inner = self.lock();
        let sent = inner.revisions(request)?;
        let find = |digest: &Sha256| {
            let sent = sent.get(digest).map(|envelope| envelope.as_bytes().to_vec());
            sent.or_else(|| self.store.envelope(digest).ok())
        };
        let verify = |inner: &Inner| {
            let known = inner.known_revisions();
            let verifier = Verifier { known: &known, ..inner.trust.verifier()? };
            SignedDeployment::verify(&verifier, request.deployment.as_bytes(), find)
        };
        let mut signed = verify(&inner)?;
        inner.check_name(&signed)?;
        drop(inner);
        let damaged = |revision: &&Trusted<Revision>| !self.store.is_intact(revision);
        let new: Vec<_> = signed.revisions().filter(damaged).collect();
        let mut known = if new.is_empty() { KnownFiles::new() } else { self.store.known_files() };
        let missing = |it: &&Trusted<Revision>| self.store.missing(it.payload(), &known);
        let missing = new.iter().flat_map(missing);
        let objects: Vec<_> = missing.collect();
        if !objects.is_empty() {
            self.lock().expect(signed.id(), &objects)?;
            return Ok(DeployReply::Missing { objects });
        }
        for digest in new.into_iter().map(Trusted::digest) {
            if let Some(envelope) = find(digest) {
                self.store.add(digest, &envelope, &mut known)?;
            }
        }
        let manifests = self.check_manifests(&mut signed)?;
        let admit = |inner: &Inner| {
            let demand = inner.measured.model().of(&manifests);
            demand.map_or(Ok(()), |it| self.budgets.admit(signed.id(), &it, &inner.wanted_demand()))
        };
        let mut inner = self.lock();
        admit(&inner)?;
        let digests: Vec<_> = signed.digests().cloned().collect();
        inner.compiling.extend(digests.iter().cloned());
        drop((inner, changing));
        // Others are deployed meanwhile.
        let compiled = digests.iter().try_for_each(|digest| {
            let folder = self.store.folder(digest);
            compile::component(&folder, &self.cache)?;
            // As before each start: what does not fit is refused while the former lambda runs.
            gleaner_wheels::prepare(&folder)?;
            Ok::<_, Failure>(())
        });
        let _changing = deploying();
        inner = self.lock();
        for digest in &digests {
            if let Some(index) = inner.compiling.iter().position(|it| it == digest) {
                inner.compiling.swap_remove(index);
            }
        }
        compiled?;
        // Another trust root may have been installed, and other deployments accepted.
        verify(&inner)?;
        inner.check_name(&signed)?;
        admit(&inner)?;
        let accepted = self.accept(&mut inner, signed, (&request.deployment, wish), manifests)?;
        self.collect(&mut inner);
        Ok(accepted)
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
            self.event(EventKind::Deployed, Some(id), "accepted: it is not refused any more");
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
    ///
    /// # Errors
    ///
    /// A failure if there is no such deployment, or the disk is full.
    pub(crate) fn remove(&self, id: &str, by: &str) -> Result<(), Failure> {
        let _changing = self.deploying.lock().unwrap_or_else(PoisonError::into_inner);
        let mut inner = self.lock();
        let mut state = inner.state.clone();
        let name = id.parse::<ItemName>().ok();
        let Some(name) = name.filter(|name| state.remove(name, spools::KEPT)) else {
            return Err(inner.unknown(id));
        };
        self.change(&mut inner, state)?;
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
        for id in spools::collect(&self.spools, &kept) {
            let text = format!("the records of `{id}`, which was removed earlier, are removed");
            self.event(EventKind::Loss, None, &text);
        }
        Ok(())
    }

    fn accept(
        &self,
        inner: &mut Inner,
        signed: SignedDeployment,
        (envelope, wish): (&str, Option<&CloudWish>),
        manifests: Vec<(Sha256, Manifest)>,
    ) -> Result<DeployReply, Failure> {
        let id = signed.id().clone();
        let before = inner.state.deployments.get(&id);
        let is_noted = |before: &Deployed| wish.is_none() || before.cloud.as_ref() == wish;
        let is_same = before.is_some_and(|before| {
            before.envelope == *envelope && before.is_wanted && is_noted(before)
        });
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
                lambda: signed.revision.payload().name.clone(),
                release: signed.deployment.payload().release,
                // Of a removed deployment of this id, an attempt may still end: no later one has
                // its number, as no attempt is above the generation.
                attempt: before.map_or(inner.state.generation, |before| before.attempt) + 1,
                is_wanted: true,
                runs_fallback: kept.is_some_and(|kept| kept.runs_fallback),
                is_proven: kept.is_some_and(|kept| kept.is_proven),
                failed: kept.and_then(|kept| kept.failed.clone()),
                history,
                cloud: wish.or(kept.and_then(|kept| kept.cloud.as_ref())).cloned(),
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
            inner.trust.accept(&signed.deployment, &signed.revision)?;
            self.change(inner, state)?;
            inner.signed.insert(id.clone(), Ok(signed));
            inner.manifests.insert(id.clone(), manifests);
            self.publish(inner);
            self.event(EventKind::Deployed, Some(&id), &text);
        }
        inner.expected.remove(&id);
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
        let inner = self.lock();
        inner.expected.values().find_map(|files| files.get(sha256)).copied().ok_or_else(|| {
            Failure::new(Exit::Usage, format!("no deployment needs the file {sha256}"))
                .with_help("send the deployment first, and then the files that are missing")
        })
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
