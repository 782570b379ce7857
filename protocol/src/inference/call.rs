//! Calls of a lambda's process, and their replies.

use serde::{Deserialize, Serialize};

use super::{TensorInfo, TensorPlace};

/// A call of a lambda's process. It has one at a time.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelRequest {
    /// Number of the call, above 0 and above those before.
    pub id: u64,
    /// Time of CLOCK_MONOTONIC at which the caller stops waiting, in ns.
    pub deadline_ns: Option<u64>,
    /// Ids of the regions that the caller has, for inputs and for outputs; 0 for none.
    #[serde(default)]
    pub regions: [u64; 2],
    /// The call.
    pub call: ModelCall,
}

/// The kinds of call.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelCall {
    /// Load the model of this name, unless it is loaded.
    Open {
        /// Its name in the manifest.
        model: String,
    },
    /// Provide a region for inputs of at least this size.
    Reserve {
        /// Its size.
        bytes: u64,
    },
    /// Run a model that was opened.
    Run {
        /// Its name in the manifest.
        model: String,
        /// Its inputs, in the region for inputs.
        inputs: Vec<TensorPlace>,
    },
}

/// The reply to a call.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelReply {
    /// Number of the call; 0 for the end of the process, and with it of everything that was opened,
    /// and for the start of the next one. The starter sends these two.
    pub id: u64,
    /// Id of the region for inputs that was reserved, or that has the outputs of a run; else 0.
    #[serde(default)]
    pub region: u64,
    /// The result.
    pub result: Result<ModelResult, ModelFault>,
}

/// The result of a call.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelResult {
    /// The process has started again.
    Started,
    /// The model is loaded.
    Opened {
        /// Its inputs.
        inputs: Vec<TensorInfo>,
        /// Its outputs.
        outputs: Vec<TensorInfo>,
        /// Backend, version, provider and threads, such as `rten 0.27.0, cpu, 1 thread`.
        runtime: String,
        /// Entries of its metadata that describe a detector, by key.
        #[serde(default)]
        metadata: Vec<(String, String)>,
    },
    /// The region for inputs, which comes as a descriptor.
    Reserved,
    /// The model has run.
    Ran {
        /// Its outputs, in the region for outputs. If that is a new one, it comes as a descriptor.
        outputs: Vec<TensorPlace>,
        /// Run time of the model in ns; that of the first run, if the result is shared.
        run_ns: u64,
    },
}

/// The reason why a call failed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelFault {
    /// The kind of fault.
    pub kind: ModelFaultKind,
    /// The object, the cause and the way out.
    pub message: String,
}

/// The kinds of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelFaultKind {
    /// The process has ended or is not ready.
    Unavailable,
    /// The starter granted no model of that name.
    NoSuchModel,
    /// Name, shape or type of a tensor does not fit the model.
    WrongInput,
    /// The deadline passed before the result.
    TooSlow,
    /// The deadline passed before the load began, as other models were loaded.
    Queued,
    /// The model cannot be loaded, or its run failed.
    Failed,
}

impl ModelFault {
    /// A fault of this kind.
    pub fn new(kind: ModelFaultKind, message: impl Into<String>) -> ModelFault {
        ModelFault { kind, message: message.into() }
    }
}
