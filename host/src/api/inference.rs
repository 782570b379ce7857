//! Models that run on the host. This build has no model runtime: every call says so.

/// Why a model could not be opened or run.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InferenceError {
    /// The host was built without a model runtime.
    #[error("no model runtime in this build")]
    NoRuntime,
}

/// Numbers on the host. Cannot be made in this build.
#[derive(Debug)]
pub enum Tensor {}

/// A loaded model. Cannot be opened in this build.
#[derive(Debug)]
pub enum Model {}

impl Tensor {
    /// Makes a tensor of `shape` from `values`, or from a frame.
    ///
    /// # Errors
    ///
    /// [`InferenceError::NoRuntime`], always.
    pub fn new() -> Result<Self, InferenceError> {
        Err(InferenceError::NoRuntime)
    }
}

impl Model {
    /// Opens the `[[model]]` of that name.
    ///
    /// # Errors
    ///
    /// [`InferenceError::NoRuntime`], always.
    pub fn open(_name: &str) -> Result<Self, InferenceError> {
        Err(InferenceError::NoRuntime)
    }
}
