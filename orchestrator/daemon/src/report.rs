//! The state of the vehicle, for users.

use std::collections::BTreeMap;

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::ItemName;
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_protocol::supervision::SupervisorStatus;
use gleaner_protocol::vehicle_api::{
    Capacity, DeploymentEnvelopes, DeploymentStatus, RevisionEnvelope,
};
use gleaner_trust::{sha256, unverified_deployment};

use crate::core::Core;
use crate::state::Deployed;

impl Core {
    /// Returns the status of all deployments, that of the processes, and the generation.
    pub(crate) fn status(&self) -> (Vec<DeploymentStatus>, Option<SupervisorStatus>, u64) {
        let inner = self.lock();
        let status = inner.state.deployments.iter().map(|(id, deployed)| {
            let lambdas = inner.status.iter().flat_map(|status| &status.lambdas);
            let lambda = lambdas.into_iter().find(|lambda| lambda.id == id.as_str()).cloned();
            let mut status = match inner.signed.get(id) {
                Some(Ok(signed)) => {
                    let verifier = inner.trust.verifier().ok();
                    let stale = verifier.and_then(|it| it.expiry(signed.deployment.payload()));
                    signed.status(deployed, stale)
                }
                Some(Err(reason)) => refused(id, deployed, reason),
                None => refused(id, deployed, "it was not checked"),
            };
            let demand = inner.demand(id).map(|demand| self.budgets.demand(&demand));
            status.demand = demand.unwrap_or_default();
            status.status = lambda;
            status
        });
        (status.collect(), inner.status.clone(), inner.state.generation)
    }

    /// Returns the newest releases that were accepted of deployments that were removed.
    pub(crate) fn removed(&self) -> BTreeMap<String, u64> {
        let inner = self.lock();
        let releases = inner.trust.floors().releases();
        let removed = releases.filter(|(id, _)| !inner.state.deployments.contains_key(*id));
        removed.map(|(id, release)| (id.to_string(), release)).collect()
    }

    /// Returns the signed parts of a deployment.
    ///
    /// # Errors
    ///
    /// A failure if there is no such deployment, or a revision of it cannot be read.
    pub(crate) fn envelopes(&self, id: &str) -> Result<DeploymentEnvelopes, Failure> {
        let inner = self.lock();
        let name = id.parse::<ItemName>().ok();
        let deployed = name.and_then(|name| inner.state.deployments.get(&name));
        let deployment = deployed.ok_or_else(|| inner.unknown(id))?.envelope.clone();
        drop(inner);
        let wish = unverified_deployment(deployment.as_bytes())
            .map_err(|refusal| Failure::because("the deployment cannot be read", &refusal))?;
        let revisions = std::iter::once(&wish.revision).chain(&wish.fallback).map(|digest| {
            let envelope = self.store.envelope(digest).map_err(|error| {
                let action = format!("cannot read the revision {digest}");
                Failure::caused_by(Exit::Internal, action, &error)
            })?;
            let envelope = String::from_utf8_lossy(&envelope).into_owned();
            let build = BuildDir::of(self.store.folder(digest));
            Ok(RevisionEnvelope { envelope, manifest: Manifest::read(build.path())? })
        });
        let revisions = revisions.collect::<Result<_, Failure>>()?;
        Ok(DeploymentEnvelopes { deployment, revisions })
    }

    /// Returns whether there is a deployment of this id, or records of one that was removed.
    pub(crate) fn has_records(&self, id: &ItemName) -> bool {
        self.lock().state.deployments.contains_key(id) || self.spools.join(id.as_str()).is_dir()
    }

    /// Returns the resources that lambdas share, with what all wanted ones ask for and use.
    pub(crate) fn capacity(&self) -> Vec<Capacity> {
        let inner = self.lock();
        let used = inner.status.as_ref().map(|status| inner.measured.current(status));
        self.budgets.capacity(&inner.wanted_demand(), &used.unwrap_or_default())
    }
}

/// Returns the status of a deployment whose envelope counts no more.
fn refused(id: &ItemName, deployed: &Deployed, reason: &str) -> DeploymentStatus {
    DeploymentStatus {
        id: id.to_string(),
        release: deployed.release,
        envelope: sha256(deployed.envelope.as_bytes()).to_string(),
        attempt: deployed.attempt,
        lambda: deployed.lambda.to_string(),
        is_wanted: deployed.is_wanted,
        runs_fallback: deployed.runs_fallback,
        is_proven: deployed.is_proven,
        failed: deployed.failed.clone(),
        refused: Some(reason.to_owned()),
        ..DeploymentStatus::default()
    }
}
