//! Events of a vehicle: the records of its spool `events`.

use serde::{Deserialize, Serialize};

/// Something that happened on a vehicle, other than a decision or a log line of a lambda.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct VehicleEvent {
    /// The kind.
    pub event: EventKind,
    /// Id of the deployment that it is about.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lambda: Option<String>,
    /// Digest of the revision that it is about.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revision: Option<String>,
    /// A sentence for the user, without control characters.
    pub text: String,
}

/// The kind of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// A program of the vehicle has started.
    Started,
    /// A program of the vehicle ends.
    Stopped,
    /// A lambda is ready.
    Ready,
    /// The process of a lambda has ended on request.
    Ended,
    /// A process failed, and is started again.
    Failed,
    /// A lambda is not started again.
    Quarantined,
    /// A deployment was accepted.
    Deployed,
    /// A deployment was refused.
    Refused,
    /// A deployment runs its other revision.
    RolledBack,
    /// A clip is complete, or was recovered.
    Clip,
    /// Data was lost.
    Loss,
    /// Something else went wrong.
    Warning,
}
