//! Models on the host: `gleaner:lambda/inference`.

use crate::Result;
use crate::bindings::gleaner::lambda::inference as wit;
pub use crate::bindings::gleaner::lambda::inference::{DetectOptions, Detection, InferenceError};
pub use crate::bindings::gleaner::lambda::types::Preprocess;
use crate::data::Frame;
use crate::error::answer;

/// Numbers in row-major order, on the host.
pub struct Tensor(wit::Tensor);

/// A loaded `[[model]]`.
pub struct Model(wit::Model);

impl Tensor {
    /// A tensor of 32-bit floats; the product of `shape` is the length of `values`.
    ///
    /// # Errors
    ///
    /// If it is not, or this host has no model runtime.
    pub fn from_values(shape: &[u32], values: &[f32]) -> Result<Self> {
        Ok(Self(answer(wit::Tensor::from_values(shape, values))?))
    }

    /// A tensor [1, 3, height, width] from a frame.
    ///
    /// # Errors
    ///
    /// If the frame cannot be read, or this host has no model runtime.
    pub fn from_frame(frame: &Frame, how: Preprocess) -> Result<Self> {
        Ok(Self(answer(wit::Tensor::from_frame(frame.handle(), how))?))
    }

    /// Length of each dimension.
    pub fn shape(&self) -> Vec<u32> {
        self.0.shape()
    }

    /// Values from `offset`, `len` at most; 262,144 at most.
    pub fn read(&self, offset: u64, len: u32) -> Vec<f32> {
        self.0.read(offset, len)
    }
}

impl Model {
    /// Opens the model of that name. Do this in `init`.
    ///
    /// # Errors
    ///
    /// If the manifest has no such model, or this host has no model runtime.
    pub fn open(name: &str) -> Result<Self> {
        Ok(Self(answer(wit::Model::open(name))?))
    }

    /// Runs the model.
    ///
    /// # Errors
    ///
    /// If number, shape or type of `inputs` do not fit, or the model fails.
    pub fn run(&self, inputs: &[&Tensor]) -> Result<Vec<Tensor>> {
        let inputs = inputs.iter().map(|tensor| &tensor.0).collect::<Vec<_>>();
        Ok(answer(self.0.run(&inputs))?.into_iter().map(Tensor).collect())
    }

    /// Finds objects in a frame, without its pixels entering the lambda.
    ///
    /// # Errors
    ///
    /// If the model is no detector, or fails.
    pub fn detect(&self, frame: &Frame, options: &DetectOptions) -> Result<Vec<Detection>> {
        answer(self.0.detect(frame.handle(), options))
    }
}
