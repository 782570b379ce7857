//! Models that run on the host. This build has no model runtime: every call returns
//! [`InferenceError::NoRuntime`].

use super::fuel::{Fuel, OutOfFuel};

/// The reason why a call failed that creates a tensor, or opens or runs a model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InferenceError {
    /// The host was built without a model runtime.
    #[error("no model runtime in this build")]
    NoRuntime,
    /// The lambda has less fuel than the call costs.
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
    /// Returns the name of the case in the WIT.
    pub fn name(self) -> &'static str {
        match self {
            Self::NoRuntime => "no-runtime",
        }
    }
}

impl InferenceError {
    /// Returns the case that the lambda receives.
    pub fn kind(&self) -> InferenceErrorKind {
        match self {
            // A lambda that runs out of fuel is ended and receives no error.
            Self::NoRuntime | Self::OutOfFuel(_) => InferenceErrorKind::NoRuntime,
        }
    }
}

/// A tensor in host memory. Cannot be created in this build.
#[derive(Debug)]
pub enum Tensor {}

/// A loaded model. Cannot be opened in this build.
#[derive(Debug)]
pub enum Model {}

impl Tensor {
    /// Creates a tensor from numbers. `bytes` is the size of the numbers and of the shape.
    ///
    /// # Errors
    ///
    /// [`InferenceError::OutOfFuel`] if too little fuel is left; otherwise
    /// [`InferenceError::NoRuntime`].
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
    /// Opens the `[[model]]` of the manifest with this name.
    ///
    /// # Errors
    ///
    /// As [`Tensor::from_values`].
    pub fn open(name: &str, fuel: &Fuel) -> Result<Self, InferenceError> {
        fuel.charge(|| name.len())?;
        fuel.charge_call()?;
        Err(InferenceError::NoRuntime)
    }
}
