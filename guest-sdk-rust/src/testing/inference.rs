//! Implements `gleaner:lambda/inference`: tensors in memory, and models that answer as the test
//! determines.

use std::sync::{Arc, Mutex, PoisonError};

use gleaner_rules::clamps;
use gleaner_rules::frames::{Budget, FrameLease};
use gleaner_rules::refused;

use super::data::Frame;
use super::manifest::Limits;
use super::model::{FakeModel, SeenFrame};
use super::session::{Handle, HandleCounter, current};
pub use crate::bindings::gleaner::lambda::inference::{
    DetectOptions, Detection, ElementType, InferenceError, TensorInfo,
};
use crate::data::{Encoding, encoding_name};
use crate::inference::Preprocess;

const MAX_DIMENSIONS: usize = 8;
/// Maximum side of a tensor that is created from a frame.
const MAX_SIDE: u32 = 8192;
const MAX_DETECTIONS: u32 = 1024;

type CallResult<T> = Result<T, InferenceError>;

/// The models of the manifest, and the memory of tensors.
pub(crate) struct ModelTable {
    models: Vec<DeclaredModel>,
    budget: Budget,
    handles: Arc<HandleCounter>,
}

/// One `[[model]]`, with the answers of the test, if it has some.
#[derive(Clone)]
pub(super) struct DeclaredModel {
    pub(super) name: String,
    pub(super) has_layout: bool,
    pub(super) answers: Option<FakeModel>,
}

impl ModelTable {
    pub(super) fn new(
        models: Vec<DeclaredModel>,
        limits: &Limits,
        handles: Arc<HandleCounter>,
    ) -> Self {
        Self { models, budget: Budget::new(usize::MAX, limits.memory), handles }
    }
}

/// An array in memory. Clones are the same tensor.
#[derive(Clone)]
pub struct Tensor(Arc<TensorState>);

struct TensorState {
    element: ElementType,
    shape: Vec<u32>,
    bytes: Mutex<Vec<u8>>,
    _taken: FrameLease,
    _handle: Handle,
}

impl Tensor {
    pub(crate) fn create(element: ElementType, shape: &[u32]) -> CallResult<Self> {
        let session = current();
        session.check_bytes(size_of_val(shape));
        let wrong = |why: String| Err(InferenceError::WrongInput(why));
        if shape.len() > MAX_DIMENSIONS {
            let found = shape.len();
            return wrong(format!("a tensor has at most {MAX_DIMENSIONS} dimensions, not {found}"));
        }
        if shape.contains(&0) {
            return wrong(format!("a tensor of shape {shape:?} has no elements"));
        }
        let lengths = shape.iter().map(|length| *length as usize);
        let size = lengths.fold(element_size(element), usize::saturating_mul);
        let taken = match session.models.budget.take(size) {
            Ok(taken) => taken,
            Err(no_room) => return wrong(no_room.to_string()),
        };
        let (bytes, shape) = (Mutex::new(vec![0; size]), shape.to_vec());
        let handle = session.models.handles.acquire();
        Ok(Self(Arc::new(TensorState { element, shape, bytes, _taken: taken, _handle: handle })))
    }

    pub(crate) fn from_frame(frame: &Frame, how: Preprocess) -> CallResult<Self> {
        check_frame(frame)?;
        let Preprocess { width, height, .. } = how;
        if [width, height].iter().any(|side| !(1..=MAX_SIDE).contains(side)) {
            let why = format!("a tensor of a frame cannot have {width}x{height} pixels");
            return Err(InferenceError::WrongInput(format!("{why}; each side is 1 to {MAX_SIDE}")));
        }
        Err(InferenceError::Unavailable(
            "the fake host does not convert frames to tensors; set answers of `detect` with \
             `FakeModel::detect`, or run the lambda with gleaner replay"
                .to_owned(),
        ))
    }

    pub(crate) fn element(&self) -> ElementType {
        self.0.element
    }

    pub(crate) fn shape(&self) -> Vec<u32> {
        self.0.shape.clone()
    }

    pub(crate) fn size(&self) -> u64 {
        self.bytes(|bytes| bytes.len() as u64)
    }

    pub(crate) fn read(&self, offset: u64, len: u32) -> Vec<u8> {
        let per_call = current().limits().per_call;
        self.bytes(|bytes| bytes[per_call.piece(bytes.len(), offset, len)].to_vec())
    }

    pub(crate) fn write(&self, offset: u64, written: &[u8]) -> CallResult<()> {
        current().check_bytes(written.len());
        self.bytes(|bytes| {
            let piece = clamps::piece(bytes.len(), offset, written.len());
            if piece.len() < written.len() || piece.start as u64 != offset {
                let (len, size) = (written.len(), bytes.len());
                return Err(InferenceError::WrongInput(format!(
                    "{len} bytes at offset {offset} exceed a tensor of {size} bytes"
                )));
            }
            bytes[piece].copy_from_slice(written);
            Ok(())
        })
    }

    fn bytes<R>(&self, call: impl FnOnce(&mut Vec<u8>) -> R) -> R {
        call(&mut self.0.bytes.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// A `[[model]]` that answers as the test determines.
pub struct Model {
    declared: DeclaredModel,
    answers: FakeModel,
    _handle: Handle,
}

impl Model {
    pub(crate) fn open(name: &str) -> CallResult<Self> {
        let session = current();
        session.check_bytes(name.len());
        let models = &session.models.models;
        let declared = models.iter().find(|model| model.name == name).ok_or_else(|| {
            let known = models.iter().map(|model| model.name.as_str());
            InferenceError::NoSuchModel(refused::no_such_model(name, known))
        })?;
        let answers = declared.answers.clone().ok_or_else(|| {
            let why = format!("the fake host has no answers of model `{name}`");
            InferenceError::Unavailable(format!("{why}; set them with `testing::Host::model`"))
        })?;
        let handle = session.models.handles.acquire();
        Ok(Self { declared: declared.clone(), answers, _handle: handle })
    }

    pub(crate) fn inputs(&self) -> Vec<TensorInfo> {
        self.answers.inputs.clone()
    }

    pub(crate) fn outputs(&self) -> Vec<TensorInfo> {
        self.answers.outputs.clone()
    }

    pub(crate) fn labels(&self) -> Vec<String> {
        self.answers.labels.clone()
    }

    pub(crate) fn runtime(&self) -> String {
        "fake host".to_owned()
    }

    pub(crate) fn run(&self, inputs: &[(String, &Tensor)]) -> CallResult<Vec<(String, Tensor)>> {
        current().check_bytes(inputs.iter().map(|(name, _)| name.len()).sum());
        let inputs: Vec<_> = inputs
            .iter()
            .map(|(name, tensor)| (name.clone(), crate::Tensor::from_handle(Tensor::clone(tensor))))
            .collect();
        let outputs = self.answers.answer_run(&self.declared.name, &inputs)?;
        Ok(outputs.into_iter().map(|(name, tensor)| (name, tensor.into_handle())).collect())
    }

    pub(crate) fn detect(
        &self,
        frame: &Frame,
        options: &DetectOptions,
    ) -> CallResult<Vec<Detection>> {
        let DetectOptions { classes, min_score, max_iou, max_count } = options;
        current().check_bytes(classes.iter().map(String::len).sum());
        let name = &self.declared.name;
        let wrong = |why: String| Err(InferenceError::WrongInput(why));
        if !self.declared.has_layout {
            return wrong(format!("model `{name}` has no `layout` in the manifest, for `detect`"));
        }
        for (option, value) in [("min_score", min_score), ("max_iou", max_iou)] {
            if !(0.0..=1.0).contains(value) {
                return wrong(format!("`{option}` is {value}; its range is 0 to 1"));
            }
        }
        if let Some(class) = classes.iter().find(|class| !self.answers.has_class(class)) {
            return wrong(format!("model `{name}` has no class `{class}` in its labels"));
        }
        check_frame(frame)?;
        let seen =
            SeenFrame { info: frame.info(), identity: frame.identity(), stamps: frame.stamps() };
        let mut found = self.answers.answer_detect(name, &seen)?;
        found.retain(|object| {
            let is_named =
                |class: &String| *class == object.label || class.parse() == Ok(object.class);
            object.score >= *min_score && (classes.is_empty() || classes.iter().any(is_named))
        });
        found.sort_by(|a, b| b.score.total_cmp(&a.score));
        found.truncate((*max_count).min(MAX_DETECTIONS) as usize);
        Ok(found)
    }
}

/// Refuses the frames that no model gets as its input.
fn check_frame(frame: &Frame) -> CallResult<()> {
    use Encoding::{Bgr8, Bgra8, Mono8, Rgb8, Rgba8, Yuv422, Yuv422Yuy2};
    let encoding = frame.info().encoding;
    if [Rgb8, Bgr8, Rgba8, Bgra8, Mono8, Yuv422, Yuv422Yuy2].contains(&encoding) {
        return Ok(());
    }
    let name = encoding_name(encoding);
    Err(InferenceError::WrongInput(format!(
        "a frame of {name} cannot be the input of a model; 8-bit colour and grey can"
    )))
}

fn element_size(element: ElementType) -> usize {
    match element {
        ElementType::Int8 | ElementType::Uint8 | ElementType::Boolean => 1,
        ElementType::Float16 | ElementType::Int16 => 2,
        ElementType::Float32 | ElementType::Int32 => 4,
        ElementType::Float64 | ElementType::Int64 => 8,
    }
}
