//! `gleaner:lambda/inference`. As hosts are built today, there is no model runtime: every call says
//! so.

use super::data::Frame;
use super::session::current;
use super::types::{Preprocess, refusal};

/// Why a model could not be opened or run.
#[derive(Clone, Debug)]
pub enum InferenceError {
    /// This host was built without a model runtime.
    NoRuntime(String),
    /// No `[[model]]` of that name.
    NoSuchModel(String),
    /// Shape, type or number of tensors does not fit the model.
    WrongInput(String),
    /// The model ran and failed.
    Failed(String),
}

refusal!(InferenceError);

/// What `detect` found, in pixels of the frame.
#[derive(Clone, Copy, Debug)]
pub struct Detection {
    /// Index of the class, as the model counts them.
    pub class: u32,
    /// 0 to 1.
    pub score: f32,
    /// Left edge.
    pub x: f32,
    /// Upper edge.
    pub y: f32,
    /// Above 0.
    pub width: f32,
    /// Above 0.
    pub height: f32,
}

/// What `detect` is asked for.
#[derive(Clone, Debug)]
pub struct DetectOptions {
    /// Classes wanted; empty for all.
    pub classes: Vec<u32>,
    /// Detections below are dropped, 0 to 1.
    pub min_score: f32,
    /// Overlap (intersection over union) above which the weaker of two detections is dropped, 0 to
    /// 1.
    pub max_iou: f32,
    /// At most so many, strongest first; clamped to 1,024.
    pub max_count: u32,
}

/// Numbers on the host. Cannot be made in this build.
#[derive(Debug)]
pub enum Tensor {}

/// A loaded model. Cannot be opened in this build.
#[derive(Debug)]
pub enum Model {}

type Answer<T> = Result<T, InferenceError>;

fn no_runtime<T>() -> Answer<T> {
    Err(InferenceError::NoRuntime("no model runtime in this build".to_owned()))
}

impl Tensor {
    pub(crate) fn from_values(shape: &[u32], values: &[f32]) -> Answer<Self> {
        current().passed(size_of_val(shape) + size_of_val(values));
        no_runtime()
    }

    pub(crate) fn from_frame(_frame: &Frame, _how: Preprocess) -> Answer<Self> {
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
    pub(crate) fn open(name: &str) -> Answer<Self> {
        current().passed(name.len());
        no_runtime()
    }

    pub(crate) fn run(&self, _inputs: &[&Tensor]) -> Answer<Vec<Tensor>> {
        match *self {}
    }

    pub(crate) fn detect(
        &self,
        _frame: &Frame,
        _options: &DetectOptions,
    ) -> Answer<Vec<Detection>> {
        match *self {}
    }
}
