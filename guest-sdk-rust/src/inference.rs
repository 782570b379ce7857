//! Models that run in the host: `gleaner:lambda/inference`. No current host has a model runtime:
//! every call returns `no-runtime`.

use crate::Result;
use crate::bindings::gleaner::lambda::inference as wit;
pub use crate::bindings::gleaner::lambda::inference::{DetectOptions, Detection, InferenceError};
pub use crate::bindings::gleaner::lambda::types::Preprocess;
use crate::data::Frame;
use crate::error::into_result;

/// An array of numbers in row-major order, kept in the host.
pub struct Tensor(wit::Tensor);

/// A loaded `[[model]]`.
pub struct Model(wit::Model);

impl Tensor {
    /// Creates a tensor of 32-bit floats.
    ///
    /// # Errors
    ///
    /// `wrong-input` unless the product of `shape` is the length of `values`; `no-runtime`.
    pub fn from_values(shape: &[u32], values: &[f32]) -> Result<Self> {
        Ok(Self(into_result(wit::Tensor::from_values(shape, values))?))
    }

    /// Creates a tensor of shape [1, 3, height, width] from a frame.
    ///
    /// # Errors
    ///
    /// `wrong-input` for Bayer encodings and sizes out of range; `no-runtime`.
    pub fn from_frame(frame: &Frame, how: Preprocess) -> Result<Self> {
        Ok(Self(into_result(wit::Tensor::from_frame(frame.handle(), how))?))
    }

    /// Returns the length of each dimension.
    pub fn shape(&self) -> Vec<u32> {
        self.0.shape()
    }

    /// Returns values: at most `len`, from `offset`, clamped to the tensor and to 262,144 values.
    pub fn read(&self, offset: u64, len: u32) -> Vec<f32> {
        self.0.read(offset, len)
    }
}

impl Model {
    /// Opens the model `name` of the manifest. Do this in `init`.
    ///
    /// # Errors
    ///
    /// `no-such-model`; `failed` if the model cannot be loaded; `no-runtime`.
    pub fn open(name: &str) -> Result<Self> {
        Ok(Self(into_result(wit::Model::open(name))?))
    }

    /// Runs the model once.
    ///
    /// # Errors
    ///
    /// `wrong-input` if the number, shapes or types of `inputs` do not fit; `failed`.
    pub fn run(&self, inputs: &[&Tensor]) -> Result<Vec<Tensor>> {
        let inputs = inputs.iter().map(|tensor| &tensor.0).collect::<Vec<_>>();
        Ok(into_result(self.0.run(&inputs))?.into_iter().map(Tensor).collect())
    }

    /// Finds objects in a frame; returns them by score, highest first. The pixels are not copied
    /// into the lambda.
    ///
    /// # Errors
    ///
    /// `wrong-input` if the model is not a detector; `failed`.
    pub fn detect(&self, frame: &Frame, options: &DetectOptions) -> Result<Vec<Detection>> {
        into_result(self.0.detect(frame.handle(), options))
    }
}
