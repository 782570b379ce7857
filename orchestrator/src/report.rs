//! The state of the vehicle, for users.

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::ItemName;
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_protocol::process_stats::usage;
use gleaner_protocol::vehicle_api::{
    DeploymentEnvelopes, DeploymentStatus, ProgramStatus, RevisionEnvelope, VehicleStatus,
};
use gleaner_trust::{sha256, unverified_deployment};

use crate::orchestrator::{Inner, Orchestrator};

impl Orchestrator {
    /// Returns the status of the vehicle, without its connection to the cloud.
    pub(crate) fn status(&self) -> VehicleStatus {
        let orchestrator = ProgramStatus {
            version: gleaner_base::version().to_owned(),
            pid: std::process::id(),
            up_s: self.started.elapsed().as_secs_f64(),
            rss_bytes: usage::resident(),
            cpu_s: usage::cpu_seconds(),
        };
        let inner = self.lock();
        let labels = inner.trust.labels().iter();
        let deployed = &inner.state.deployments;
        let releases = inner.trust.floors().releases();
        let removed = releases.filter(|(id, _)| !deployed.contains_key(*id));
        let used = inner.status.as_ref().map(|status| inner.measured.current(status));
        VehicleStatus {
            vehicle: self.name.to_string(),
            key: self.key.to_string(),
            labels: labels.map(|(name, value)| (name.to_string(), value.clone())).collect(),
            orchestrator,
            trust: inner.trust.status(),
            generation: inner.state.generation,
            deployments: self.deployments(&inner),
            removed: removed.map(|(id, release)| (id.to_string(), release)).collect(),
            capacity: self.budgets.capacity(&inner.wanted_demand(), &used.unwrap_or_default()),
            events_lost: self.events.lost(),
            records_lost: Vec::new(),
            supervisor: inner.status.clone(),
            cloud: None,
            age_s: None,
        }
    }

    fn deployments(&self, inner: &Inner) -> Vec<DeploymentStatus> {
        let status = inner.state.deployments.iter().map(|(id, deployed)| {
            let lambdas = inner.status.iter().flat_map(|status| &status.lambdas);
            let lambda = lambdas.into_iter().find(|lambda| lambda.id == id.as_str()).cloned();
            let refused = |reason: &str| {
                let envelope = sha256(deployed.envelope.as_bytes());
                let refused = Some(reason.to_owned());
                DeploymentStatus { refused, ..deployed.status(id, &envelope) }
            };
            let mut status = match inner.signed.get(id) {
                Some(Ok(signed)) => {
                    let verifier = inner.trust.verifier().ok();
                    let stale = verifier.and_then(|it| it.expiry(signed.deployment.payload()));
                    signed.status(deployed, stale)
                }
                Some(Err(reason)) => refused(reason),
                None => refused("it was not checked"),
            };
            let demand = inner.demand(id).map(|demand| self.budgets.demand(&demand));
            status.demand = demand.unwrap_or_default();
            status.status = lambda;
            status
        });
        status.collect()
    }

    /// Returns the signed parts of a deployment.
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
        self.lock().state.deployments.contains_key(id)
            || self.layout.lambda_spools().join(id.as_str()).is_dir()
    }
}
