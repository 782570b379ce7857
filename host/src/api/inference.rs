//! Models that run in `gleaner-inference`, and tensors in the memory of the lambda's process.

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::visible;
use gleaner_protocol::inference::{
    Element, MAX_DIMENSIONS, MAX_TENSOR_BYTES, ModelFaultKind, TensorInfo, TensorPlace,
};
use gleaner_rules::clamps;
use gleaner_rules::frames::{Budget, FrameLease};
use gleaner_rules::pixels::StopCheck;
use gleaner_rules::refused;
use gleaner_vision::{Detection, OutputView, Placed, Preparer, Preprocess, VisionError, Wanted};

use super::call::PerCall;
use super::data::DataError;
use super::frame::Frame;
use super::fuel::OutOfFuel;
use super::models::{ModelEntry, Models, OpenedModel, TensorBytes};

/// Work on a prepared pixel, as the number of bytes that are copied in the same time.
const PREPARE: usize = 12;

/// The reason why a call failed that creates a tensor, or opens or runs a model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs)]
pub enum InferenceError {
    #[error("{0}")]
    Unavailable(String),
    #[error("{0}")]
    NoSuchModel(String),
    #[error("{0}")]
    WrongInput(String),
    #[error("{0}")]
    TooSlow(String),
    #[error("{0}")]
    Failed(String),
    #[error("the deadline is over")]
    OutOfTime,
    #[error(transparent)]
    OutOfFuel(#[from] OutOfFuel),
}

/// Cases of `inference-error` in `wit/inference.wit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum InferenceErrorKind {
    Unavailable,
    NoSuchModel,
    WrongInput,
    TooSlow,
    Failed,
}

impl InferenceErrorKind {
    /// Returns the name of the case in the WIT.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unavailable => "unavailable",
            Self::NoSuchModel => "no-such-model",
            Self::WrongInput => "wrong-input",
            Self::TooSlow => "too-slow",
            Self::Failed => "failed",
        }
    }
}

impl InferenceError {
    /// Returns the case that the lambda receives.
    pub fn kind(&self) -> InferenceErrorKind {
        match self {
            Self::Unavailable(_) => InferenceErrorKind::Unavailable,
            Self::NoSuchModel(_) => InferenceErrorKind::NoSuchModel,
            Self::WrongInput(_) => InferenceErrorKind::WrongInput,
            // A guest that can be interrupted is ended instead.
            Self::TooSlow(_) | Self::OutOfTime | Self::OutOfFuel(_) => InferenceErrorKind::TooSlow,
            Self::Failed(_) => InferenceErrorKind::Failed,
        }
    }

    pub(super) fn of(kind: ModelFaultKind, message: String) -> Self {
        match kind {
            ModelFaultKind::Unavailable => Self::Unavailable(message),
            ModelFaultKind::NoSuchModel => Self::NoSuchModel(message),
            ModelFaultKind::WrongInput => Self::WrongInput(message),
            ModelFaultKind::TooSlow => Self::TooSlow(message),
            ModelFaultKind::Failed => Self::Failed(message),
        }
    }

    pub(super) fn no_such_model(name: &str, known: &[&str]) -> Self {
        Self::NoSuchModel(refused::no_such_model(name, known))
    }

    pub(super) fn too_slow(name: &str, allowed: Duration) -> Self {
        Self::TooSlow(format!(
            "the models of this wake, at last `{name}`, took longer than the {allowed:?} of \
             `model_time`: raise it in [limits], or use a smaller model"
        ))
    }

    fn wrong(error: &VisionError) -> Self {
        Self::WrongInput(error.to_string())
    }
}

/// An array in row-major order.
pub struct Tensor {
    content: TensorContent,
    per_call: PerCall,
    _taken: FrameLease,
}

/// The content of a tensor. Clones share its bytes, which never change while one lives.
#[derive(Clone)]
pub struct TensorContent {
    /// Type of the elements.
    pub element: Element,
    /// Length of each dimension.
    pub shape: Vec<u32>,
    /// The elements, little-endian.
    pub bytes: Arc<Vec<u8>>,
}

/// What the tensors of a lambda share: the limits of a call, and of all tensors.
#[derive(Clone)]
pub struct TensorLimits {
    pub(super) per_call: PerCall,
    pub(super) budget: Budget,
}

impl TensorLimits {
    fn take(&self, bytes: usize) -> Result<FrameLease, InferenceError> {
        let taken = self.budget.take(bytes);
        taken.map_err(|refused| InferenceError::WrongInput(refused.to_string()))
    }

    /// Creates a tensor of `bytes`, which fit `shape`.
    fn tensor(
        &self,
        element: Element,
        shape: Vec<u32>,
        bytes: Vec<u8>,
    ) -> Result<Tensor, InferenceError> {
        let _taken = self.take(bytes.len())?;
        let content = TensorContent { element, shape, bytes: Arc::new(bytes) };
        Ok(Tensor { content, per_call: self.per_call.clone(), _taken })
    }

    /// Creates a tensor of zeros.
    ///
    /// # Errors
    ///
    /// [`InferenceError::WrongInput`] for a shape that is out of range; [`InferenceError::OutOfFuel`].
    pub fn create(&self, element: Element, shape: &[u32]) -> Result<Tensor, InferenceError> {
        let len = self.len(element, shape);
        self.per_call.charge(|| len.as_ref().map_or(0, |len| *len) + size_of_val(shape))?;
        let len = len?;
        // The budget first: memory is only taken for a tensor that fits.
        drop(self.take(len)?);
        self.tensor(element, shape.to_vec(), vec![0; len])
    }

    /// Creates a tensor of these bytes.
    ///
    /// # Errors
    ///
    /// As [`create`](Self::create), and [`InferenceError::WrongInput`] if their number does not fit.
    pub fn of_bytes(
        &self,
        element: Element,
        shape: &[u32],
        bytes: &[u8],
    ) -> Result<Tensor, InferenceError> {
        self.per_call.charge(|| bytes.len() + size_of_val(shape))?;
        let len = self.len(element, shape)?;
        if len != bytes.len() {
            let found = bytes.len();
            let message =
                format!("a tensor {element} {shape:?} has {len} bytes, and {found} are given");
            return Err(InferenceError::WrongInput(message));
        }
        drop(self.take(len)?);
        self.tensor(element, shape.to_vec(), bytes.to_vec())
    }

    /// Creates a tensor from a frame.
    ///
    /// # Errors
    ///
    /// [`InferenceError::WrongInput`] for an encoding or size that cannot be converted;
    /// [`InferenceError::OutOfFuel`].
    pub fn of_frame(
        &self,
        models: &Models,
        frame: &Frame,
        how: &Preprocess,
    ) -> Result<Tensor, InferenceError> {
        self.per_call.charge(|| prepare_work(how))?;
        how.check().map_err(|error| InferenceError::wrong(&error))?;
        let (element, shape) = prepared_as(how);
        drop(self.take(self.len(element, &shape)?)?);
        let mut bytes = Vec::new();
        models.prepare(|preparer| self.prepare(preparer, frame, how, &mut bytes))?;
        self.tensor(element, shape, bytes)
    }

    /// Converts a frame, until the call is due.
    fn prepare(
        &self,
        preparer: &mut Preparer,
        frame: &Frame,
        how: &Preprocess,
        out: &mut Vec<u8>,
    ) -> Result<Placed, InferenceError> {
        let view = frame.whole().map_err(of_frame)?;
        let due = &self.per_call.due;
        let in_time = || due.check().is_ok();
        let size = how.size().map_err(|error| InferenceError::wrong(&error))?;
        out.resize(size, 0);
        let prepared = preparer.prepare_into(&view, how, Some(&StopCheck::new(&in_time)), out);
        prepared.map_err(|error| match due.check() {
            Err(_) => InferenceError::OutOfTime,
            Ok(()) => InferenceError::wrong(&error),
        })
    }

    fn len(&self, element: Element, shape: &[u32]) -> Result<usize, InferenceError> {
        let len = element.bytes_of(shape).and_then(|len| usize::try_from(len).ok());
        len.ok_or_else(|| {
            let shown = &shape[..shape.len().min(MAX_DIMENSIONS + 1)];
            InferenceError::WrongInput(format!(
                "a tensor of shape {shown:?} is out of range: it has at most {MAX_DIMENSIONS} \
                 dimensions, no length of 0, and at most {MAX_TENSOR_BYTES} bytes"
            ))
        })
    }
}

/// Returns the element type and shape of a prepared frame.
fn prepared_as(how: &Preprocess) -> (Element, Vec<u32>) {
    (if how.bytes { Element::Uint8 } else { Element::Float32 }, how.shape().to_vec())
}

fn prepare_work(how: &Preprocess) -> usize {
    PREPARE.saturating_mul(how.width as usize).saturating_mul(how.height as usize)
}

fn of_frame(error: DataError) -> InferenceError {
    match error {
        DataError::OutOfTime => InferenceError::OutOfTime,
        DataError::OutOfFuel(error) => InferenceError::OutOfFuel(error),
        error => InferenceError::WrongInput(error.to_string()),
    }
}

impl Tensor {
    /// Type, shape and elements.
    pub fn content(&self) -> &TensorContent {
        &self.content
    }

    /// Bytes from `offset`, `len` at most, clamped to the tensor and to `call_bytes` of `[limits]`.
    ///
    /// # Errors
    ///
    /// [`OutOfFuel`].
    pub fn read(&self, offset: u64, len: u32) -> Result<&[u8], OutOfFuel> {
        let len = self.per_call.clamps().bytes.min(len as usize);
        let bytes = &self.content.bytes;
        let piece = &bytes[clamps::piece(bytes.len(), offset, len)];
        self.per_call.charge(|| piece.len())?;
        Ok(piece)
    }

    /// Writes `bytes` at `offset`.
    ///
    /// # Errors
    ///
    /// [`InferenceError::WrongInput`] if they exceed the tensor; [`InferenceError::OutOfFuel`].
    pub fn write(&mut self, offset: u64, bytes: &[u8]) -> Result<(), InferenceError> {
        self.per_call.charge(|| bytes.len())?;
        let len = self.content.bytes.len();
        let start = usize::try_from(offset).unwrap_or(usize::MAX);
        let end = start.checked_add(bytes.len()).filter(|end| *end <= len);
        let Some(end) = end else {
            let count = bytes.len();
            let message =
                format!("{count} bytes at {offset} exceed the tensor, which has {len} bytes");
            return Err(InferenceError::WrongInput(message));
        };
        Arc::make_mut(&mut self.content.bytes)[start..end].copy_from_slice(bytes);
        Ok(())
    }
}

impl TensorContent {
    fn place(&self, name: &str) -> TensorPlace {
        let (name, shape) = (name.to_owned(), self.shape.clone());
        TensorPlace { name, element: self.element, shape, offset: 0 }
    }
}

/// Options of [`Model::detect`].
#[derive(Clone, Debug)]
pub struct DetectOptions {
    /// Classes to return, by name or by index as text; empty for all.
    pub classes: Vec<String>,
    /// Minimum score.
    pub min_score: f32,
    /// Overlap above which the detection with the lower score is dropped.
    pub max_iou: f32,
    /// Maximum number of detections.
    pub max_count: u32,
}

/// A loaded model.
pub struct Model {
    models: Models,
    limits: TensorLimits,
    entry: Arc<ModelEntry>,
    opened: Arc<OpenedModel>,
}

impl Model {
    /// Opens the `[[model]]` of the manifest with this name.
    ///
    /// # Errors
    ///
    /// [`InferenceError`].
    pub fn open(
        models: &Models,
        limits: &TensorLimits,
        name: &str,
    ) -> Result<Self, InferenceError> {
        limits.per_call.charge(|| name.len())?;
        let (entry, opened) = models.open(name, &limits.per_call.due)?;
        let model = Self { models: models.clone(), limits: limits.clone(), entry, opened };
        if model.entry.layout.is_some() {
            model.check_layout()?;
        }
        Ok(model)
    }

    /// Checks that the model fits its `layout` and `labels`.
    fn check_layout(&self) -> Result<Preprocess, InferenceError> {
        let name = &self.entry.name;
        let wrong = |why: String| {
            InferenceError::WrongInput(format!("model `{name}` is no detector: {why}"))
        };
        let Some(layout) = self.entry.layout else {
            return Err(wrong(
                "it has no `layout` in lambda.toml, which states the meaning of its outputs; add \
                 it, or call `run`"
                    .to_owned(),
            ));
        };
        let [input] = &*self.opened.inputs else {
            return Err(wrong(format!("it has {} inputs", self.opened.inputs.len())));
        };
        let how = layout.preprocess(&input.shape).map_err(|error| wrong(error.to_string()))?;
        let outputs: Vec<_> = self.opened.outputs.iter().map(|it| it.shape.as_slice()).collect();
        let classes = layout.check(&outputs, (how.width, how.height));
        let (labels, classes) =
            (self.entry.labels.len(), classes.map_err(|error| wrong(error.to_string()))?);
        match classes {
            Some(classes) if labels > 0 && labels as u64 != u64::from(classes) => Err(wrong(
                format!("it has {classes} classes, and its `labels` have {labels} lines"),
            )),
            _ => Ok(how),
        }
    }

    /// Its inputs.
    pub fn inputs(&self) -> &[TensorInfo] {
        &self.opened.inputs
    }

    /// Its outputs.
    pub fn outputs(&self) -> &[TensorInfo] {
        &self.opened.outputs
    }

    /// Names of its classes.
    pub fn labels(&self) -> &[String] {
        &self.entry.labels
    }

    /// Backend, version, provider and threads.
    pub fn runtime(&self) -> &str {
        &self.opened.runtime
    }

    /// Runs it once with these inputs; returns its outputs by name.
    ///
    /// # Errors
    ///
    /// [`InferenceError`].
    pub fn run(
        &self,
        inputs: &[(String, TensorContent)],
    ) -> Result<Vec<(String, Tensor)>, InferenceError> {
        let bytes_of = |(name, tensor): &(String, TensorContent)| name.len() + tensor.bytes.len();
        self.limits.per_call.charge(|| inputs.iter().map(bytes_of).sum())?;
        let mut sent = Vec::new();
        for (name, tensor) in inputs {
            // A name that the model does not have, of any length, is not sent.
            self.check_name(name)?;
            sent.push(TensorBytes { place: tensor.place(name), bytes: tensor.bytes.as_slice() });
        }
        let outputs = self.models.run(&self.entry.name, &sent, &self.limits.per_call.due)?;
        let outputs = outputs.into_iter().map(|TensorBytes { place, bytes }| {
            let tensor = self.limits.tensor(place.element, place.shape, bytes)?;
            Ok((place.name, tensor))
        });
        outputs.collect()
    }

    fn check_name(&self, name: &str) -> Result<(), InferenceError> {
        let mut known = self.opened.inputs.iter().map(|input| &*input.name);
        if known.any(|known| known == name) {
            return Ok(());
        }
        let known: Vec<_> = self.opened.inputs.iter().map(|input| &*input.name).collect();
        Err(InferenceError::WrongInput(format!(
            "model `{}` has no input `{}`: it has `{}`",
            self.entry.name,
            visible(name),
            known.join("`, `")
        )))
    }

    /// Finds objects in a frame.
    ///
    /// # Errors
    ///
    /// [`InferenceError`].
    pub fn detect(
        &self,
        frame: &Frame,
        options: &DetectOptions,
    ) -> Result<Vec<Detection>, InferenceError> {
        let (name, per_call) = (&self.entry.name, &self.limits.per_call);
        let how = self.check_layout()?;
        let bytes_of_classes = || options.classes.iter().map(String::len).sum::<usize>();
        per_call.charge(|| prepare_work(&how).saturating_add(bytes_of_classes()))?;
        let wanted = self.wanted(options)?;
        let (element, shape) = prepared_as(&how);
        let input = self.opened.inputs.first().map_or_else(String::new, |it| it.name.clone());
        let place = TensorPlace { name: input, element, shape, offset: 0 };
        let (placed, outputs) =
            self.models.run_prepared(name, place, &per_call.due, |preparer, bytes| {
                self.limits.prepare(preparer, frame, &how, bytes)
            })?;
        let wrong = |why: String| InferenceError::WrongInput(format!("model `{name}`: {why}"));
        let outputs = outputs.iter().map(floats).collect::<Result<Vec<_>, _>>().map_err(wrong)?;
        let views: Vec<_> =
            outputs.iter().map(|(shape, values)| OutputView { shape, values }).collect();
        let layout = self.entry.layout.ok_or_else(|| wrong("it has no `layout`".to_owned()))?;
        gleaner_vision::detect(layout, &views, &placed, &wanted)
            .map_err(|error| wrong(error.to_string()))
    }

    /// Returns the name of a class.
    pub fn label(&self, class: u32) -> String {
        let label = usize::try_from(class).ok().and_then(|class| self.entry.labels.get(class));
        label.cloned().unwrap_or_else(|| class.to_string())
    }

    fn wanted(&self, options: &DetectOptions) -> Result<Wanted, InferenceError> {
        let class = |name: &String| {
            let index = self.entry.labels.iter().position(|label| label == name);
            let index = index.and_then(|index| u32::try_from(index).ok());
            index.or_else(|| name.parse().ok()).ok_or_else(|| {
                let from = if self.entry.labels.is_empty() {
                    "it has no `labels` in lambda.toml, so give the index of the class".to_owned()
                } else {
                    format!("its labels are `{}`", self.entry.labels.join("`, `"))
                };
                let (model, name) = (&self.entry.name, visible(name));
                InferenceError::WrongInput(format!("model `{model}` has no class `{name}`: {from}"))
            })
        };
        let classes = options.classes.iter().map(class).collect::<Result<Vec<_>, _>>()?;
        Ok(Wanted {
            classes: (!classes.is_empty()).then_some(classes),
            min_score: options.min_score,
            max_iou: options.max_iou,
            max_count: options.max_count,
        })
    }
}

/// Shape and values of an output.
type Floats = (Vec<u32>, Vec<f32>);

fn floats(output: &TensorBytes<Vec<u8>>) -> Result<Floats, String> {
    let TensorPlace { name, element, shape, .. } = &output.place;
    if *element != Element::Float32 {
        return Err(format!("output `{name}` is {element}, and `detect` needs float32"));
    }
    let (values, _) = output.bytes.as_chunks::<4>();
    Ok((shape.clone(), values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()))
}
