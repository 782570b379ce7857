//! Implements `gleaner:lambda/inference`. As in current builds of the host, there is no model
//! runtime: every call returns `no-runtime`.

use super::data::Frame;
use super::session::current;
use super::types::{Preprocess, refusal};

/// Reason why a model cannot be opened or run.
#[derive(Clone, Debug)]
pub enum InferenceError {
    /// This host was built without a model runtime.
    NoRuntime(String),
    /// The manifest has no `[[model]]` of that name.
    NoSuchModel(String),
    /// Shapes, types or number of the tensors do not fit the model.
    WrongInput(String),
    /// The model failed to load or to run.
    Failed(String),
}

refusal!(InferenceError);

/// An object that `detect` found; its box is in pixels of the frame.
#[derive(Clone, Copy, Debug)]
pub struct Detection {
    /// Class index of the model.
    pub class: u32,
    /// Confidence, 0 to 1.
    pub score: f32,
    /// Left edge.
    pub x: f32,
    /// Upper edge.
    pub y: f32,
    /// Width, above 0.
    pub width: f32,
    /// Height, above 0.
    pub height: f32,
}

/// Options of `detect`.
#[derive(Clone, Debug)]
pub struct DetectOptions {
    /// Classes to return; empty for all.
    pub classes: Vec<u32>,
    /// Minimum score, 0 to 1; detections with a lower one are dropped.
    pub min_score: f32,
    /// Overlap (intersection over union), 0 to 1, above which the detection with the lower score is
    /// dropped.
    pub max_iou: f32,
    /// Maximum number of detections, highest score first; clamped to 1,024.
    pub max_count: u32,
}

/// An array of numbers in the host. Cannot be created in this build.
#[derive(Debug)]
pub enum Tensor {}

/// A loaded model. Cannot be opened in this build.
#[derive(Debug)]
pub enum Model {}

type CallResult<T> = Result<T, InferenceError>;

fn no_runtime<T>() -> CallResult<T> {
    Err(InferenceError::NoRuntime("no model runtime in this build".to_owned()))
}

impl Tensor {
    pub(crate) fn from_values(shape: &[u32], values: &[f32]) -> CallResult<Self> {
        current().check_bytes(size_of_val(shape) + size_of_val(values));
        no_runtime()
    }

    pub(crate) fn from_frame(_frame: &Frame, _how: Preprocess) -> CallResult<Self> {
        no_runtime()
    }

    pub(crate) fn shape(&self) -> Vec<u32> {
        match *self {}
    }

    pub(crate) fn read(&self, _offset: u64, _len: u32) -> Vec<f32> {
        match *self {}
    }
}

impl Model {
    pub(crate) fn open(name: &str) -> CallResult<Self> {
        current().check_bytes(name.len());
        no_runtime()
    }

    pub(crate) fn run(&self, _inputs: &[&Tensor]) -> CallResult<Vec<Tensor>> {
        match *self {}
    }

    pub(crate) fn detect(
        &self,
        _frame: &Frame,
        _options: &DetectOptions,
    ) -> CallResult<Vec<Detection>> {
        match *self {}
    }
}
