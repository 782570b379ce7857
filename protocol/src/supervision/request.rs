//! Requests of the orchestrator.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// Version of these messages. A program refuses other versions.
pub const SUPERVISION_VERSION: u32 = 1;

/// Maximum number of lambdas of a vehicle.
pub const LAMBDAS_MAX: usize = 128;

/// A request of the orchestrator to the supervisor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "request", rename_all = "snake_case")]
pub enum SupervisorRequest {
    /// Sent first on each connection: the settings of all processes.
    Configure(Box<SupervisionSpec>),
    /// Sets what runs.
    Apply(Box<DesiredState>),
    /// Ends all processes in order, and then the supervisor.
    Stop,
}

/// Settings of all processes. They do not change while the supervisor runs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SupervisionSpec {
    /// [`SUPERVISION_VERSION`].
    pub version: u32,
    /// Folder of the spools: `events`, and in `lambdas` one of each lambda.
    pub spool: PathBuf,
    /// Maximum size of the spool of a lambda, in bytes.
    pub spool_bytes: u64,
    /// Folder of the records of how processes ended.
    pub records: PathBuf,
    /// Folder of the clips.
    pub clips: PathBuf,
    /// Configuration file of the vehicle.
    pub vehicle: Option<PathBuf>,
    /// Key that signs clips, and the name of the vehicle.
    pub signer: Option<(PathBuf, String)>,
    /// Arguments of `gleaner-ingress` that select the network.
    pub network: Vec<String>,
    /// True to keep every decision, not only those with a trigger or a fault.
    pub all: bool,
    /// Topic on which decisions are published.
    pub decisions: Option<String>,
    /// Topic of recording commands.
    pub commands: Option<String>,
    /// Free bytes of the disk below which no clip is started.
    pub disk_floor: Option<u64>,
    /// Maximum number of clips to keep.
    pub clips_max: Option<u64>,
    /// Maximum total size of clips to keep, in bytes.
    pub bytes_max: Option<u64>,
    /// Folder of cgroup v2 for the control groups of the lambdas.
    pub cgroup: Option<PathBuf>,
}

/// The whole desired state. The newest that is received counts.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DesiredState {
    /// Number of the state; it grows with each change.
    pub generation: u64,
    /// The lambdas that run, each id and each name once.
    pub lambdas: Vec<DesiredLambda>,
}

/// A lambda that runs. One that differs from the running one in any field replaces it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DesiredLambda {
    /// Id of its deployment.
    pub id: String,
    /// Name of the lambda.
    pub name: String,
    /// Digest of its revision.
    pub revision: String,
    /// Folder that has its `build/`.
    pub folder: PathBuf,
    /// File with the signed revision, by which the files are checked before each start.
    pub envelope: PathBuf,
    /// Overrides of its config, as `KEY=VALUE`.
    pub set: Vec<String>,
    /// Number of the deployment, or of a user's request to start it again.
    pub attempt: u64,
}
