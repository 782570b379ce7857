//! The state of a vehicle that survives restarts: its deployments, and what became of them.

use std::collections::BTreeMap;

use gleaner_lambda::manifest::{ItemName, LambdaName, Sha256};
use gleaner_protocol::vehicle_api::DeploymentStatus;
use gleaner_trust::Floors;
use serde::{Deserialize, Serialize};

/// Maximum number of revisions of a deployment that are kept, beside those that it names.
const HISTORY_MAX: usize = 2;

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct VehicleState {
    /// Number of the desired state; it grows with each change.
    pub(crate) generation: u64,
    /// Floors: written together with the deployments, so that a kill in between leaves
    /// neither without the other.
    pub(crate) floors: Floors,
    pub(crate) deployments: BTreeMap<ItemName, Deployed>,
    /// Deployments that were removed and whose records are kept, the newest last.
    #[serde(default)]
    pub(crate) removed: Vec<ItemName>,
    /// The newest state of the cloud that was followed.
    #[serde(default)]
    pub(crate) followed: FollowedState,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FollowedState {
    /// SHA-256 of the certificate of the cloud's authority: another cloud counts on its own.
    pub(crate) authority: String,
    pub(crate) generation: u64,
}

impl VehicleState {
    /// Removes a deployment. Records of earlier ones than the newest `kept` that were removed are
    /// not kept any more.
    pub(crate) fn remove(&mut self, id: &ItemName, kept: usize) {
        self.deployments.remove(id);
        let deployments = &self.deployments;
        self.removed.retain(|it| it != id && !deployments.contains_key(it));
        self.removed.push(id.clone());
        self.removed.drain(..self.removed.len().saturating_sub(kept));
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Deployed {
    pub(crate) envelope: String,
    pub(crate) lambda: LambdaName,
    pub(crate) release: u64,
    /// Number of the attempt to run it: it grows with each deployment, rollback and start.
    pub(crate) attempt: u64,
    /// False if a user has stopped it.
    pub(crate) is_wanted: bool,
    pub(crate) runs_fallback: bool,
    /// True once its revision ran for the whole probation.
    pub(crate) is_proven: bool,
    /// The reason why the fallback runs.
    pub(crate) failed: Option<String>,
    /// Revisions that ran before, the newest first.
    pub(crate) history: Vec<Sha256>,
    /// The last wish of the cloud; `None` of a local deployment.
    #[serde(default)]
    pub(crate) cloud: Option<DesiredDeployment>,
}

/// A wish of the cloud for a deployment. It is followed once: what is changed locally afterwards
/// stays until the cloud wants something else.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct DesiredDeployment {
    /// SHA-256 of the envelope.
    pub(crate) envelope: String,
    /// False if it is to be stopped.
    pub(crate) is_wanted: bool,
    /// Number of the request to run its fallback.
    pub(crate) rollback: u64,
    /// Number of the request to start it again.
    #[serde(default)]
    pub(crate) start: u64,
}

impl Deployed {
    /// Returns the part of its status that a refused deployment has, too.
    pub(crate) fn status(&self, id: &ItemName, envelope: &Sha256) -> DeploymentStatus {
        DeploymentStatus {
            id: id.to_string(),
            release: self.release,
            envelope: envelope.to_string(),
            attempt: self.attempt,
            lambda: self.lambda.to_string(),
            is_wanted: self.is_wanted,
            runs_fallback: self.runs_fallback,
            is_proven: self.is_proven,
            failed: self.failed.clone(),
            ..DeploymentStatus::default()
        }
    }

    /// Returns the history of a deployment that replaces this one, which runs `revision`.
    pub(crate) fn next_history(&self, revision: &Sha256) -> Vec<Sha256> {
        let mut history = self.history.clone();
        history.retain(|before| before != revision);
        history.insert(0, revision.clone());
        history.truncate(HISTORY_MAX);
        history
    }
}
