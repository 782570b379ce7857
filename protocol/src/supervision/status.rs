//! The status of all processes, which the supervisor sends.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::inference::InferenceStatus;
use crate::ingress::IngressStatus;
use crate::link::RecorderStatus;
use crate::{Layer, LiveStatus, WakeCounts};

/// A report of the supervisor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "supervisor", rename_all = "snake_case")]
pub enum SupervisorReport {
    /// Sent first on each connection.
    Welcome(Welcome),
    /// It runs with other settings, and must be started again to have new ones.
    OtherSettings,
    /// An upgrade has replaced the programs, and one of them has to start. It ends all processes,
    /// and itself, so that programs of two versions never run together.
    Replaced,
    /// A request that cannot be met, for this reason. Nothing has changed.
    Refused {
        /// The reason.
        reason: String,
    },
    /// Sent once a second, and at once after a change. If the reader is too slow, some are dropped.
    Status(Box<SupervisorStatus>),
}

/// The identity of a supervisor.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome {
    /// [`SUPERVISION_VERSION`](super::SUPERVISION_VERSION).
    pub version: u32,
    /// Version of its program.
    pub program: String,
    /// Number of its process.
    pub pid: u32,
}

/// The status of all processes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SupervisorStatus {
    /// Generation of the newest desired state that was received.
    pub generation: u64,
    /// Time since the start of the supervisor, in s.
    pub up_s: f64,
    /// The lambdas, in the order of the desired state, and those that are ending.
    pub lambdas: Vec<LambdaStatus>,
    /// The ingress.
    pub ingress: ProcessStatus<IngressStatus>,
    /// The recorder; absent while no lambda records.
    pub recorder: Option<ProcessStatus<RecorderStatus>>,
    /// The process that runs models; absent while no lambda has any.
    pub inference: Option<ProcessStatus<InferenceStatus>>,
    /// Models that are refused for the rest of the run: each with its cause and the way out.
    #[serde(default)]
    pub refused_models: Vec<String>,
    /// Number of clips since the start of the supervisor.
    pub clips: u64,
    /// Those with windows of a lambda, by its name. A clip with windows of several counts for each.
    #[serde(default)]
    pub clips_by_lambda: BTreeMap<String, ClipCounts>,
    /// Number of events that could not be made durable.
    pub events_lost: u64,
    /// Resident memory of the supervisor, in bytes.
    #[serde(default)]
    pub rss_bytes: u64,
    /// CPU time of the supervisor, in s.
    #[serde(default)]
    pub cpu_s: f64,
}

/// Number and size of clips.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ClipCounts {
    /// Their number.
    pub clips: u64,
    /// Sum of their sizes, in bytes.
    pub bytes: u64,
}

/// The status of a process that all lambdas share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ProcessStatus<S> {
    /// True while it runs and is ready.
    pub is_ready: bool,
    /// Number of its restarts.
    pub restarts: u32,
    /// The reason of its last end.
    pub last_end: Option<String>,
    /// Its last status.
    pub last: Option<Box<S>>,
}

impl<S> Default for ProcessStatus<S> {
    fn default() -> Self {
        Self { is_ready: false, restarts: 0, last_end: None, last: None }
    }
}

impl<S> ProcessStatus<S> {
    /// Counts an end, for this reason.
    pub fn ended(&mut self, reason: &str) {
        self.is_ready = false;
        self.restarts += 1;
        self.last_end = Some(reason.to_owned());
    }
}

/// The status of a lambda.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct LambdaStatus {
    /// Id of its deployment.
    pub id: String,
    /// Name of the lambda.
    pub name: String,
    /// Digest of its revision.
    pub revision: String,
    /// The attempt of the desired state.
    pub attempt: u64,
    /// The phase.
    pub phase: LambdaPhase,
    /// Time in this phase, in s.
    pub phase_s: f64,
    /// Number of the shim's process, if it runs.
    pub pid: Option<u32>,
    /// Number of restarts of this revision.
    pub restarts: u32,
    /// The reason of the last end of its process, or of the quarantine.
    pub last_end: Option<String>,
    /// Counts of its process, with those of earlier ones.
    pub live: Option<Box<LiveStatus>>,
    /// Wakes of the last minutes.
    #[serde(default)]
    pub recent: WakeCounts,
    /// The layers around its process, as tested.
    pub layers: Vec<Layer>,
}

impl LambdaStatus {
    /// Returns what is wrong while it runs, as sentences: its faults, and a recorder that is
    /// missing.
    pub fn warnings(&self) -> [Option<String>; 2] {
        let Some(live) = self.live.as_deref() else { return [None, None] };
        let link = live.recorder_link.filter(|link| link.absent_s > 0);
        let unrecorded = link.map(|link| {
            format!(
                "no recorder for {} s: it records nothing, {} triggers and {} other wakes are lost",
                link.absent_s, link.triggers_lost, link.wakes_dropped
            )
        });
        [self.recent.faulty(), unrecorded]
    }
}

/// Phase of a lambda.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LambdaPhase {
    /// It waits for its start: for the ingress, or after an end.
    #[default]
    Waiting,
    /// Its files are being checked.
    Checking,
    /// Its process runs, and its `init` is not over.
    Starting,
    /// It is ready, or in a wake.
    Running,
    /// It was requested to end.
    Stopping,
    /// It failed too often, or cannot run, and is not started again.
    Quarantined,
}

impl LambdaPhase {
    /// Returns its name, as in the status.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Checking => "checking",
            Self::Starting => "starting",
            Self::Running => "running",
            Self::Stopping => "stopping",
            Self::Quarantined => "quarantined",
        }
    }
}
