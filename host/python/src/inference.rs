//! `gleaner:lambda/inference` over `gleaner_host::api::inference`.

use std::borrow::Cow;
use std::sync::{Mutex, MutexGuard, PoisonError};

use gleaner_host::api::Session;
use gleaner_host::api::inference::{
    self, DetectOptions, InferenceError, InferenceErrorKind, TensorContent,
};
use gleaner_pixels::vision::{Detection, Placement, Preprocess};
use gleaner_protocol::inference::{Element, TensorInfo};
use numpy::PyReadonlyArray1;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::array::{self, Frame, TensorBytes};
use crate::scratch::to_bytes;
use crate::sdk::SdkClass;

static INFERENCE_ERROR: SdkClass = SdkClass::new("gleaner.inference", "InferenceError");

/// The session of the lambda of this process, since a tensor or a model is created without one.
static SESSION: Mutex<Option<Session>> = Mutex::new(None);

/// A tensor in host memory. Arrays over its bytes rely on them not to change, which a write
/// respects: it copies them first.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Tensor(Mutex<inference::Tensor>);

#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Model(inference::Model);

/// Name, element type and shape of an input or output.
type InfoFields = (String, &'static str, Vec<Option<u32>>);

/// Fields of `gleaner.Preprocess`, in their order.
type PreprocessFields<'py> =
    (u32, u32, Cow<'py, str>, u8, bool, bool, bool, f32, [f32; 3], [f32; 3]);

/// Fields of `gleaner.DetectOptions`, in their order.
type OptionFields = (Vec<String>, f32, f32, u32);

/// Fields of `gleaner.Detection`, in their order.
type DetectionFields = (u32, String, f32, f32, f32, f32, f32);

pub(crate) fn use_session(session: Session) {
    *SESSION.lock().unwrap_or_else(PoisonError::into_inner) = Some(session);
}

fn session(py: Python<'_>) -> PyResult<Session> {
    let session = SESSION.lock().unwrap_or_else(PoisonError::into_inner).clone();
    session.ok_or_else(|| {
        let error = InferenceErrorKind::Unavailable.name();
        INFERENCE_ERROR.error(py, "no lambda is hosted".to_owned(), error)
    })
}

fn refused(py: Python<'_>, error: &InferenceError) -> PyErr {
    INFERENCE_ERROR.error(py, error.to_string(), error.kind().name())
}

fn element(name: &str) -> PyResult<Element> {
    let found = Element::ALL.into_iter().find(|element| element.name() == name);
    found.ok_or_else(|| {
        let known = Element::ALL.map(Element::name).join(", ");
        PyValueError::new_err(format!("the element type `{name}` is none of {known}"))
    })
}

fn fields(TensorInfo { name, element, shape }: &TensorInfo) -> InfoFields {
    (name.clone(), element.name(), shape.clone())
}

impl Tensor {
    fn new(py: Python<'_>, tensor: Result<inference::Tensor, InferenceError>) -> PyResult<Self> {
        tensor.map(|tensor| Self(Mutex::new(tensor))).map_err(|error| refused(py, &error))
    }

    fn lock(&self) -> MutexGuard<'_, inference::Tensor> {
        // A write either happens or not.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

// Calls that take milliseconds let other threads of the lambda run.
#[pymethods]
impl Tensor {
    #[staticmethod]
    fn create(py: Python<'_>, element: Cow<'_, str>, shape: Vec<u32>) -> PyResult<Self> {
        let created = session(py)?.tensors().create(self::element(&element)?, &shape);
        Self::new(py, created)
    }

    #[staticmethod]
    fn from_bytes(
        py: Python<'_>,
        element: Cow<'_, str>,
        shape: Vec<u32>,
        bytes: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let (session, element) = (session(py)?, self::element(&element)?);
        let create = |bytes: &[u8]| session.tensors().of_bytes(element, &shape, bytes);
        let array = bytes.extract::<PyReadonlyArray1<'_, u8>>();
        let created = match array.as_ref().map(PyReadonlyArray1::as_slice) {
            Ok(Ok(bytes)) => create(bytes),
            _ => create(to_bytes(bytes)?.as_bytes()),
        };
        Self::new(py, created)
    }

    #[staticmethod]
    fn from_frame(
        py: Python<'_>,
        frame: &Bound<'_, Frame>,
        how: PreprocessFields<'_>,
    ) -> PyResult<Self> {
        let (session, how, frame) = (session(py)?, preprocess(how)?, frame.get().host());
        let made = py.detach(|| session.tensors().of_frame(session.models(), frame, &how));
        Self::new(py, made)
    }

    #[getter]
    fn element(&self) -> &'static str {
        self.lock().content().element.name()
    }

    #[getter]
    fn shape(&self) -> Vec<u32> {
        self.lock().content().shape.clone()
    }

    #[getter]
    fn size(&self) -> u64 {
        self.lock().content().bytes.len() as u64
    }

    #[pyo3(signature = (offset = 0, len = None))]
    fn read<'py>(
        &self,
        py: Python<'py>,
        offset: u64,
        len: Option<u32>,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let tensor = self.lock();
        let bytes = tensor.read(offset, len.unwrap_or(u32::MAX));
        Ok(PyBytes::new(py, bytes.map_err(|error| refused(py, &error.into()))?))
    }

    fn write(&self, py: Python<'_>, offset: u64, bytes: &Bound<'_, PyAny>) -> PyResult<()> {
        let bytes = to_bytes(bytes)?;
        self.lock().write(offset, bytes.as_bytes()).map_err(|error| refused(py, &error))
    }

    fn array<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let content = self.lock().content().clone();
        array::over_tensor(&Bound::new(py, TensorBytes(content))?)
    }

    fn __repr__(&self) -> String {
        let TensorContent { element, shape, .. } = self.lock().content().clone();
        format!("<Tensor {element} {shape:?}>")
    }
}

#[pymethods]
impl Model {
    #[staticmethod]
    fn open(py: Python<'_>, name: Cow<'_, str>) -> PyResult<Self> {
        let session = session(py)?;
        py.detach(|| inference::Model::open(session.models(), session.tensors(), &name))
            .map(Self)
            .map_err(|error| refused(py, &error))
    }

    fn inputs(&self) -> Vec<InfoFields> {
        self.0.inputs().iter().map(fields).collect()
    }

    fn outputs(&self) -> Vec<InfoFields> {
        self.0.outputs().iter().map(fields).collect()
    }

    fn labels(&self) -> Vec<String> {
        self.0.labels().to_vec()
    }

    fn runtime(&self) -> &str {
        self.0.runtime()
    }

    fn run(
        &self,
        py: Python<'_>,
        inputs: Vec<(String, Bound<'_, Tensor>)>,
    ) -> PyResult<Vec<(String, Tensor)>> {
        let content = |(name, tensor): (String, Bound<'_, Tensor>)| {
            (name, tensor.get().lock().content().clone())
        };
        let named: Vec<_> = inputs.into_iter().map(content).collect();
        let outputs = py.detach(|| self.0.run(&named)).map_err(|error| refused(py, &error))?;
        let tensor = |(name, tensor)| (name, Tensor(Mutex::new(tensor)));
        Ok(outputs.into_iter().map(tensor).collect())
    }

    fn detect(
        &self,
        py: Python<'_>,
        frame: &Bound<'_, Frame>,
        options: OptionFields,
    ) -> PyResult<Vec<DetectionFields>> {
        let (classes, min_score, max_iou, max_count) = options;
        let options = DetectOptions { classes, min_score, max_iou, max_count };
        let frame = frame.get().host();
        let found = py.detach(|| self.0.detect(frame, &options));
        let fields = |found: Detection| {
            let Detection { class, score, x, y, width, height } = found;
            (class, self.0.label(class), score, x, y, width, height)
        };
        Ok(found.map_err(|error| refused(py, &error))?.into_iter().map(fields).collect())
    }
}

fn preprocess(fields: PreprocessFields<'_>) -> PyResult<Preprocess> {
    let (width, height, placement, fill, bgr, channels_last, bytes, scale, mean, deviation) =
        fields;
    let placement = match &*placement {
        "stretch" => Placement::Stretch,
        "centre" => Placement::Centre,
        "corner" => Placement::Corner,
        other => {
            let message = format!("the placement `{other}` is none of stretch, centre, corner");
            return Err(PyValueError::new_err(message));
        }
    };
    Ok(Preprocess {
        width,
        height,
        placement,
        fill,
        bgr,
        channels_last,
        bytes,
        scale,
        mean,
        deviation,
    })
}
