//! Messages of the API of `gleaner-orchestrator`: JSON over HTTP, on a socket of the machine.

use std::collections::BTreeMap;

use gleaner_base::{Exit, Failure};
use serde::{Deserialize, Deserializer, Serialize};

use crate::supervision::{LambdaStatus, SupervisorStatus};

pub use order::{LinePlace, in_order};

mod order;

/// Name of the API's socket in the run folder of the orchestrator.
pub const API_SOCKET: &str = "control.sock";

/// The status of a vehicle: `GET /v1/status`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct VehicleStatus {
    /// Name of the vehicle.
    pub vehicle: String,
    /// The public key that verifies its clips.
    pub key: String,
    /// Its labels.
    pub labels: BTreeMap<String, String>,
    /// The orchestrator itself.
    pub orchestrator: ProgramStatus,
    /// The trust root; absent before one is installed.
    pub trust: Option<TrustStatus>,
    /// Number of the desired state.
    pub generation: u64,
    /// All deployments, by id.
    pub deployments: Vec<DeploymentStatus>,
    /// The newest releases that were accepted of deployments that were removed, by id: only later
    /// ones are accepted.
    #[serde(default)]
    pub removed: BTreeMap<String, u64>,
    /// Resources that all lambdas share.
    pub capacity: Vec<Capacity>,
    /// Number of events of the orchestrator that could not be made durable.
    #[serde(default)]
    pub events_lost: u64,
    /// Losses of streams whose records could not be written, also before a kill or a power cut, and
    /// streams whose records cannot be written now.
    #[serde(default)]
    pub records_lost: Vec<StreamLoss>,
    /// The processes; absent while the supervisor cannot be reached.
    pub supervisor: Option<SupervisorStatus>,
    /// The connection to the cloud; absent unless the vehicle is enrolled.
    #[serde(default)]
    pub cloud: Option<CloudStatus>,
    /// Time since the vehicle reported it, in s; only a cloud states it.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "number")]
    pub age_s: Option<f64>,
}

/// Deserialises a number. Only a missing one is none: null is an error.
fn number<'de, D: Deserializer<'de>>(from: D) -> Result<Option<f64>, D::Error> {
    f64::deserialize(from).map(Some)
}

/// The connection of a vehicle to the cloud.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct CloudStatus {
    /// Address of the cloud: `HOST:PORT`.
    pub address: String,
    /// Its state: `connecting`, `connected`, or `refused` by the cloud.
    pub state: String,
    /// The reason why it is not connected, or why files wait, if it is known.
    pub reason: Option<String>,
    /// Help for the user with that reason.
    #[serde(default)]
    pub help: Option<String>,
    /// Time in this state, in s.
    pub since_s: f64,
    /// Number of the newest desired state of the cloud that was applied.
    pub generation: u64,
    /// Number of records in the spools that the cloud has not acknowledged, also of those that were
    /// not read yet.
    pub unsent: u64,
    /// Number of streams that `unsent` does not count: their spools cannot be read, or are of an
    /// earlier version.
    #[serde(default)]
    pub uncounted: u64,
    /// Streams that could not be sent at their last try, by cause.
    #[serde(default)]
    pub failing: Vec<FailingStreams>,
    /// End of the vehicle's certificate, in s since 1970.
    pub certificate_expires: u64,
    /// The clips on their way to the cloud.
    #[serde(default)]
    pub clips: ClipsStatus,
}

/// The clips of a vehicle on their way to the cloud.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ClipsStatus {
    /// Bytes of the list of clips that the cloud does not have yet; absent while it is unknown.
    pub unannounced_bytes: Option<u64>,
    /// Number of clips that the cloud wants, and that have not arrived in full; at most 64, and
    /// absent while it is unknown.
    pub waiting: Option<u64>,
    /// Number of clips that cannot be read now. They are looked at again.
    pub unreadable: u64,
    /// The reason why none is sent now, if there is one.
    pub paused: Option<String>,
    /// The clip that has been tried most often without any progress, once that is 5 times.
    pub stuck: Option<StuckClip>,
}

/// A clip that makes no progress on its way to the cloud.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct StuckClip {
    /// Its name; absent if it is the list of clips that cannot be exchanged.
    pub name: Option<String>,
    /// Number of attempts since the last progress.
    pub attempts: u64,
    /// Time since the first of these, in s.
    pub since_s: f64,
    /// The cause of the last failure.
    pub cause: String,
}

/// Streams that cannot be sent for the same cause.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct FailingStreams {
    /// The cause, such as the error of the file system.
    pub cause: String,
    /// Number of the streams.
    pub streams: u64,
    /// The failed action of one of them, with its causes.
    pub example: String,
    /// Time since the first of them has failed, in s.
    pub since_s: f64,
    /// Time since the last try, in s. None is tried without a connection.
    pub tried_s: f64,
}

/// Records of a stream that could not be written to its spool.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct StreamLoss {
    /// Name of the stream: of a lambda's records, `lambdas/ID`.
    pub stream: String,
    /// Number of the records, since the spool was created.
    pub records: u64,
    /// Reason of the last loss, as in a line of kind `gap`.
    pub reason: String,
    /// Time of the last loss, in ns since 1970, as the clock was set.
    pub last_ns: i64,
    /// Number of further records that wait for the disk, as writing fails.
    #[serde(default, alias = "unwritten")]
    pub waiting: u64,
    /// Time since which writing fails, as `last_ns`; 0 if it does not.
    #[serde(default)]
    pub failing_ns: i64,
}

/// The status of a program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ProgramStatus {
    /// Its version.
    pub version: String,
    /// Number of its process.
    pub pid: u32,
    /// Time since its start, in s.
    pub up_s: f64,
    /// Resident memory, in bytes.
    pub rss_bytes: u64,
    /// CPU time, in s.
    pub cpu_s: f64,
}

/// The status of the trust root.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct TrustStatus {
    /// Its version.
    pub version: u64,
    /// Time from which nothing is accepted for the first time by it, in s since 1970.
    pub expires: u64,
    /// True if that time is over.
    pub is_expired: bool,
}

/// The status of a deployment.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct DeploymentStatus {
    /// Its id.
    pub id: String,
    /// Number of its release.
    pub release: u64,
    /// SHA-256 of its signed envelope: of one number, there may be several.
    #[serde(default)]
    pub envelope: String,
    /// Number of the attempt to run it: the status of its lambda with a lower one is of an earlier
    /// attempt.
    pub attempt: u64,
    /// Name of the lambda.
    pub lambda: String,
    /// The revision.
    pub revision: RevisionStatus,
    /// The revision that runs if that fails.
    pub fallback: Option<RevisionStatus>,
    /// Rights of the lambda.
    pub grants: GrantStatus,
    /// Values of the lambda's config that it sets, by their names.
    #[serde(default)]
    pub config: BTreeMap<String, String>,
    /// True unless it was stopped by a user.
    pub is_wanted: bool,
    /// True if its fallback runs.
    pub runs_fallback: bool,
    /// True once its revision ran for the whole probation.
    pub is_proven: bool,
    /// The reason why the fallback runs.
    pub failed: Option<String>,
    /// The reason why it does not run although it was accepted.
    pub refused: Option<String>,
    /// The reason why its deployer should sign it again.
    pub stale: Option<String>,
    /// Its demand for each resource that lambdas share.
    #[serde(default)]
    pub demand: Vec<ResourceDemand>,
    /// The status of its lambda, if the supervisor knows it.
    pub status: Option<LambdaStatus>,
}

/// Rights of a lambda in a deployment.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct GrantStatus {
    /// Topics that it may read.
    pub topics: Vec<String>,
    /// Models that it may run.
    pub models: Vec<String>,
    /// Permission to record clips.
    pub record: bool,
}

/// The answer to a change of a deployment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Changed {
    /// Number of the attempt: a status with a lower one is of an earlier one.
    pub attempt: u64,
}

/// A revision of a deployment.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct RevisionStatus {
    /// Digest of the revision.
    pub digest: String,
    /// Version in its manifest.
    pub version: String,
    /// Number of its release.
    pub release: u64,
}

/// A resource that lambdas share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Capacity {
    /// Its name: `memory`, `topics`, `cpu`, `model_time`.
    pub resource: String,
    /// Unit of the numbers: `B`, `cores`, or `s/s` for the share of the time.
    pub unit: String,
    /// Sum of what all wanted lambdas ask for.
    pub asked: f64,
    /// Amount that they use now, where it is measured.
    #[serde(default)]
    pub used: Option<f64>,
    /// Maximum of that sum.
    pub most: f64,
    /// The source of `most`.
    pub source: String,
}

/// The demand of a deployment for a resource.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ResourceDemand {
    /// Name of the resource, as in [`Capacity`].
    pub resource: String,
    /// Unit of the numbers, as there.
    pub unit: String,
    /// Amount that counts.
    pub asked: f64,
    /// Amount in its busiest minute so far, where it is measured.
    pub peak: Option<f64>,
    /// The source of `asked`: stated, measured, assumed, or of the limits; with its factors.
    pub source: String,
    /// True if it uses more than its manifest states.
    pub exceeds: bool,
}

/// A deployment: `POST /v1/deployments`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DeployRequest {
    /// The envelope of the deployment.
    pub deployment: String,
    /// The envelopes of its revision and its fallback; one that the vehicle has may be left out.
    pub revisions: Vec<String>,
}

/// The signed parts of a deployment: `GET /v1/deployments/ID/envelopes`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct DeploymentEnvelopes {
    /// The envelope of the deployment.
    pub deployment: String,
    /// Its revision, and then its fallback.
    pub revisions: Vec<RevisionEnvelope>,
}

/// A revision of a deployment, as it was signed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct RevisionEnvelope {
    /// Its envelope, which has the digest of the manifest.
    pub envelope: String,
    /// Its manifest.
    pub manifest: String,
}

/// The answer to a deployment.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(tag = "result", rename_all = "snake_case")]
pub enum DeployReply {
    /// Files are missing: `PUT /v1/objects/SHA256` each, then repeat the request.
    Missing {
        /// The missing files.
        objects: Vec<MissingObject>,
    },
    /// It was accepted, and survives a restart of the vehicle.
    Accepted {
        /// Id of the deployment.
        id: String,
        /// Number of its attempt: a status with a lower one is of an earlier deployment.
        attempt: u64,
        /// Number of the desired state that has it.
        generation: u64,
    },
}

/// A file that a vehicle needs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct MissingObject {
    /// Its digest.
    pub sha256: String,
    /// Its length.
    pub bytes: u64,
}

/// A line of `GET /v1/events` and `GET /v1/lambdas/ID/records`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct StreamLine {
    /// Name of the stream.
    pub stream: String,
    /// Number of the record in the stream; of a gap, its first number.
    pub seq: u64,
    /// Time of the record, in ns since 1970, as the clock was set; 0 of a gap without one.
    pub time_ns: i64,
    /// Time since the boot, in ns.
    pub boot_ns: u64,
    /// The boot, as 32 hexadecimal digits.
    pub boot: String,
    /// Its kind: `event`, one of [`SpooledRecord`](crate::SpooledRecord), or `gap`, `torn` or
    /// `damaged`.
    pub kind: String,
    /// Its content.
    pub record: serde_json::Value,
}

/// An error, as `application/problem+json` of RFC 9457: a [`Failure`]. It has no `type`: all are of
/// the type `about:blank`, and they differ by their status.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Problem {
    /// The failed action.
    pub title: String,
    /// HTTP status of the answer.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub status: Option<u16>,
    /// The causes as one text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub detail: Option<String>,
    /// The causes, the nearest first.
    #[serde(default)]
    pub causes: Vec<String>,
    /// Help for the user.
    #[serde(default)]
    pub help: Option<String>,
    /// Exit code of a command that fails with it.
    pub exit: u8,
}

impl Problem {
    /// Returns a failure as the answer with an HTTP status.
    pub fn new(failure: Failure, status: u16) -> Self {
        let Failure { exit, message, causes, help } = failure;
        let detail = (!causes.is_empty()).then(|| causes.join(": "));
        Self { title: message, status: Some(status), detail, causes, help, exit: exit.code() }
    }
}

impl From<Problem> for Failure {
    fn from(Problem { title, causes, help, exit, .. }: Problem) -> Self {
        let exit = Exit::from_code(exit.into()).filter(|exit| *exit != Exit::Ok);
        Failure { exit: exit.unwrap_or(Exit::Internal), message: title, causes, help }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_age_without_a_number_is_refused() {
        let error = serde_json::from_str::<VehicleStatus>(r#"{"age_s":null}"#).unwrap_err();
        assert!(error.to_string().starts_with("invalid type: null"), "{error}");
    }
}
