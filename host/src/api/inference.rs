//! Models that run on the host. This build has no model runtime: every call returns that error.

use super::fuel::{Fuel, OutOfFuel};

/// A model that could not be opened or run.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InferenceError {
    /// The host was built without a model runtime.
    #[error("no model runtime in this build")]
    NoRuntime,
    /// The lambda cannot pay for the call.
    #[error(transparent)]
    OutOfFuel(#[from] OutOfFuel),
}

/// Cases of `inference-error` in `wit/inference.wit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum InferenceErrorKind {
    NoRuntime,
}

impl InferenceErrorKind {
    /// The name in the WIT.
    pub fn name(self) -> &'static str {
        match self {
            Self::NoRuntime => "no-runtime",
        }
    }
}

impl InferenceError {
    /// The case that the lambda receives.
    pub fn kind(&self) -> InferenceErrorKind {
        match self {
            // A guest with a fuel allowance is ended instead.
            Self::NoRuntime | Self::OutOfFuel(_) => InferenceErrorKind::NoRuntime,
        }
    }
}

/// Numbers on the host. Cannot be created in this build.
#[derive(Debug)]
pub enum Tensor {}

/// A loaded model. Cannot be opened in this build.
#[derive(Debug)]
pub enum Model {}

impl Tensor {
    /// Creates a tensor from numbers that take `bytes` bytes with its shape.
    ///
    /// # Errors
    ///
    /// [`InferenceError::NoRuntime`]; [`InferenceError::OutOfFuel`].
    pub fn from_values(bytes: usize, fuel: &Fuel) -> Result<Self, InferenceError> {
        fuel.charge(|| bytes)?;
        Self::new(fuel)
    }

    /// Creates a tensor from a frame.
    ///
    /// # Errors
    ///
    /// As [`Tensor::from_values`].
    pub fn from_frame(fuel: &Fuel) -> Result<Self, InferenceError> {
        Self::new(fuel)
    }

    fn new(fuel: &Fuel) -> Result<Self, InferenceError> {
        fuel.charge_call()?;
        Err(InferenceError::NoRuntime)
    }
}

impl Model {
    /// Opens the `[[model]]` of that name.
    ///
    /// # Errors
    ///
    /// [`InferenceError::NoRuntime`]; [`InferenceError::OutOfFuel`].
    pub fn open(name: &str, fuel: &Fuel) -> Result<Self, InferenceError> {
        fuel.charge(|| name.len())?;
        fuel.charge_call()?;
        Err(InferenceError::NoRuntime)
    }
}
