//! Models that run in `gleaner-inference`; `tensor` has their inputs and outputs.

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::visible;
use gleaner_pixels::vision::{Detection, DetectorLayout, Preprocess, VisionError, Wanted};
use gleaner_protocol::inference::{Element, ModelFaultKind, TensorInfo, TensorPlace};
use gleaner_rules::refused;

use super::frame::Frame;
use super::fuel::OutOfFuel;
use super::models::{ModelEntry, Models, OpenedModel, TensorBytes};
pub use super::tensor::{Tensor, TensorContent, TensorLimits};
use super::tensor::{prepare_work, prepared_as};

/// The reason why a call failed that creates a tensor, or opens or runs a model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
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
    Queued(String),
    #[error("{0}")]
    Failed(String),
    #[error("gleaner-inference has just been started again")]
    Restarted,
    #[error("the deadline has passed")]
    OutOfTime,
    #[error(transparent)]
    OutOfFuel(#[from] OutOfFuel),
}

/// Cases of `inference-error` in `wit/inference.wit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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
            Self::Unavailable(_) | Self::Restarted => InferenceErrorKind::Unavailable,
            Self::NoSuchModel(_) => InferenceErrorKind::NoSuchModel,
            Self::WrongInput(_) => InferenceErrorKind::WrongInput,
            // A guest that can be interrupted is ended instead.
            Self::TooSlow(_) | Self::Queued(_) | Self::OutOfTime | Self::OutOfFuel(_) => {
                InferenceErrorKind::TooSlow
            }
            Self::Failed(_) => InferenceErrorKind::Failed,
        }
    }

    pub(super) fn of(kind: ModelFaultKind, message: String) -> Self {
        match kind {
            ModelFaultKind::Unavailable => Self::Unavailable(message),
            ModelFaultKind::NoSuchModel => Self::NoSuchModel(message),
            ModelFaultKind::WrongInput => Self::WrongInput(message),
            ModelFaultKind::TooSlow => Self::TooSlow(message),
            ModelFaultKind::Queued => Self::Queued(message),
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

    pub(super) fn wrong(error: &VisionError) -> Self {
        Self::WrongInput(error.to_string())
    }
}

/// Options of [`Model::detect`].
#[derive(Clone, Debug)]
pub struct DetectOptions {
    /// Classes to return, by name or by index as text; empty for all.
    pub classes: Vec<String>,
    pub min_score: f32,
    /// Overlap above which the detection with the lower score is dropped.
    pub max_iou: f32,
    pub max_count: u32,
}

pub struct Model {
    models: Models,
    limits: TensorLimits,
    entry: Arc<ModelEntry>,
    opened: Arc<OpenedModel>,
    /// The layout of a detector, and the conversion of frames to its input.
    detector: Option<(DetectorLayout, Preprocess)>,
}

impl Model {
    /// Opens the `[[model]]` of the manifest with this name.
    pub fn open(
        models: &Models,
        limits: &TensorLimits,
        name: &str,
    ) -> Result<Self, InferenceError> {
        limits.per_call.charge(|| name.len())?;
        let (entry, opened) = models.open(name, &limits.per_call.due)?;
        let detector = match entry.layout {
            Some(layout) => Some((layout, check_layout(layout, &entry, &opened)?)),
            None => None,
        };
        Ok(Self { models: models.clone(), limits: limits.clone(), entry, opened, detector })
    }

    pub fn inputs(&self) -> &[TensorInfo] {
        &self.opened.inputs
    }

    pub fn outputs(&self) -> &[TensorInfo] {
        &self.opened.outputs
    }

    pub fn labels(&self) -> &[String] {
        &self.entry.labels
    }

    /// Backend, version, provider and threads.
    pub fn runtime(&self) -> &str {
        &self.opened.runtime
    }

    /// Runs it once with these inputs; returns its outputs by name.
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
            if sent.iter().any(|it: &TensorBytes<_>| it.place.name == *name) {
                let (model, name) = (&self.entry.name, visible(name));
                let message = format!("input `{name}` of model `{model}` is given twice");
                return Err(InferenceError::WrongInput(message));
            }
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
    pub fn detect(
        &self,
        frame: &Frame,
        options: &DetectOptions,
    ) -> Result<Vec<Detection>, InferenceError> {
        let (name, per_call) = (&self.entry.name, &self.limits.per_call);
        let (layout, how) = self.detector.ok_or_else(|| {
            let why = "it has no `layout` in lambda.toml, which states the meaning of its outputs; \
                       add it, or call `run`";
            no_detector(name, why)
        })?;
        let bytes_of_classes = || options.classes.iter().map(String::len).sum::<usize>();
        per_call.charge(|| prepare_work(&how).saturating_add(bytes_of_classes()))?;
        let wanted = self.wanted(options)?;
        let (element, shape) = prepared_as(&how);
        let input = self.opened.inputs.first().map_or_else(String::new, |it| it.name.clone());
        let place = TensorPlace { name: input, element, shape, offset: 0 };
        self.models.run_prepared(
            name,
            place,
            &per_call.due,
            |preparer, bytes| self.limits.prepare(preparer, frame, &how, bytes),
            |placed, outputs| {
                let found = gleaner_pixels::vision::detect(layout, outputs, &placed, &wanted);
                found
                    .map_err(|error| InferenceError::WrongInput(format!("model `{name}`: {error}")))
            },
        )
    }

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

/// Checks that a model fits its `layout` and `labels`; returns the conversion to its input.
fn check_layout(
    layout: DetectorLayout,
    entry: &ModelEntry,
    opened: &OpenedModel,
) -> Result<Preprocess, InferenceError> {
    let wrong = |why: String| no_detector(&entry.name, &why);
    let [input] = &*opened.inputs else {
        return Err(wrong(format!("it has {} inputs", opened.inputs.len())));
    };
    let how = layout.preprocess(&input.shape).map_err(|error| wrong(error.to_string()))?;
    let outputs: Vec<_> = opened.outputs.iter().map(|it| it.shape.as_slice()).collect();
    let classes = layout.check(&outputs, (how.width, how.height), &opened.note);
    let (labels, classes) =
        (entry.labels.len(), classes.map_err(|error| wrong(error.to_string()))?);
    if let Some(classes) = classes.filter(|it| labels > 0 && labels as u64 != u64::from(*it)) {
        let why = format!("it has {classes} classes, and its `labels` have {labels} lines");
        return Err(wrong(why));
    }
    if let Some((index, label, class)) = opened.note.contradicted(&entry.labels) {
        return Err(wrong(format!(
            "its `labels` have `{}` for class {index}, and its metadata has it for class {class}: \
             use the labels with which it was trained",
            visible(label)
        )));
    }
    for (what, info) in
        [("input", input)].into_iter().chain(opened.outputs.first().map(|it| ("output", it)))
    {
        if info.element != Element::Float32 {
            return Err(wrong(format!(
                "its {what} `{}` is {}, and `detect` has float32: export the model without \
                 `half` or `int8`, or call `run`",
                info.name, info.element
            )));
        }
    }
    Ok(how)
}

fn no_detector(name: &str, why: &str) -> InferenceError {
    InferenceError::WrongInput(format!("model `{name}` is no detector: {why}"))
}
