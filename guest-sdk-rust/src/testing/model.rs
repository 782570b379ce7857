//! The answers of a test in place of a model.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use crate::Tensor;
use crate::data::{FrameInfo, Identity, Stamps};
use crate::inference::{Detection, InferenceError, TensorInfo};

/// Answers of a test in place of a `[[model]]` of the manifest; pass it to
/// [`Host::model`](super::Host::model).
///
/// ```
/// use gleaner_sdk::inference::Detection;
/// use gleaner_sdk::testing::FakeModel;
///
/// let (label, score) = ("person".to_owned(), 0.9);
/// let person = Detection { class: 0, label, score, x: 4.0, y: 8.0, width: 2.0, height: 5.0 };
/// // A person in the second frame.
/// let model = FakeModel::new().detect(move |frame| match frame.identity.seq {
///     2 => Ok(vec![person.clone()]),
///     _ => Ok(Vec::new()),
/// });
/// ```
#[derive(Clone, Default)]
#[must_use = "answers have no effect until `Host::model`"]
pub struct FakeModel {
    pub(super) labels: Vec<String>,
    pub(super) inputs: Vec<TensorInfo>,
    pub(super) outputs: Vec<TensorInfo>,
    detect: Option<DetectAnswer>,
    run: Option<RunAnswer>,
}

type Answer<T> = Result<T, InferenceError>;
type DetectAnswer = Arc<Mutex<dyn FnMut(&SeenFrame) -> Answer<Vec<Detection>> + Send>>;
type RunAnswer = Arc<Mutex<dyn FnMut(&[(String, Tensor)]) -> Answer<Vec<(String, Tensor)>> + Send>>;

/// The frame that a lambda passes to `detect`.
#[derive(Clone, Debug)]
pub struct SeenFrame {
    /// Size and pixel layout.
    pub info: FrameInfo,
    /// Identity of its sample.
    pub identity: Identity,
    /// Timestamps of its sample.
    pub stamps: Stamps,
}

impl FakeModel {
    /// Creates a model without answers.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets the answer of `detect`.
    ///
    /// Of the objects that it returns, the lambda gets those that fit its classes, minimum score
    /// and maximum number, highest score first. Overlaps are not removed. An error is returned to
    /// the lambda.
    pub fn detect(
        mut self,
        answer: impl FnMut(&SeenFrame) -> Result<Vec<Detection>, InferenceError> + Send + 'static,
    ) -> Self {
        self.detect = Some(Arc::new(Mutex::new(answer)));
        self
    }

    /// Sets the answer of `run`: outputs by name, from the inputs by name. An error is returned to
    /// the lambda.
    pub fn run<F>(mut self, answer: F) -> Self
    where
        F: FnMut(&[(String, Tensor)]) -> Result<Vec<(String, Tensor)>, InferenceError>,
        F: Send + 'static,
    {
        self.run = Some(Arc::new(Mutex::new(answer)));
        self
    }

    /// Sets the names of the classes. With them, `detect` refuses a class that they lack.
    pub fn labels<S: Into<String>>(mut self, labels: impl IntoIterator<Item = S>) -> Self {
        self.labels = labels.into_iter().map(Into::into).collect();
        self
    }

    /// Sets the inputs that the lambda can query.
    pub fn inputs(mut self, inputs: impl IntoIterator<Item = TensorInfo>) -> Self {
        self.inputs = inputs.into_iter().collect();
        self
    }

    /// Sets the outputs that the lambda can query.
    pub fn outputs(mut self, outputs: impl IntoIterator<Item = TensorInfo>) -> Self {
        self.outputs = outputs.into_iter().collect();
        self
    }

    pub(super) fn answer_detect(&self, model: &str, frame: &SeenFrame) -> Answer<Vec<Detection>> {
        let answer = self.detect.as_ref().ok_or_else(|| no_answer(model, "detect"))?;
        (answer.lock().unwrap_or_else(PoisonError::into_inner))(frame)
    }

    pub(super) fn answer_run(
        &self,
        model: &str,
        inputs: &[(String, Tensor)],
    ) -> Answer<Vec<(String, Tensor)>> {
        let answer = self.run.as_ref().ok_or_else(|| no_answer(model, "run"))?;
        (answer.lock().unwrap_or_else(PoisonError::into_inner))(inputs)
    }

    /// Returns whether `class` is a label or an index. Without labels every class may exist.
    pub(super) fn has_class(&self, class: &str) -> bool {
        self.labels.is_empty()
            || self.labels.iter().any(|label| label == class)
            || class.parse::<u32>().is_ok()
    }
}

fn no_answer(model: &str, call: &str) -> InferenceError {
    InferenceError::Unavailable(format!(
        "the fake host has no answer of `{call}` of model `{model}`; set it with \
         `FakeModel::{call}`"
    ))
}

impl fmt::Debug for FakeModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("FakeModel").field("labels", &self.labels).finish_non_exhaustive()
    }
}

/// Converts an error of a call to the host, so that an answer of `run` can use `?`.
impl From<crate::Error> for InferenceError {
    fn from(error: crate::Error) -> Self {
        Self::Failed(error.to_string())
    }
}
