//! `gleaner:lambda/data` over `gleaner_host::api::data`: topics, fields and samples.

use std::sync::Arc;

use gleaner_host::api::data::{self, DataError};
use gleaner_messages::MessageValue;
use numpy::PyArray1;
use pyo3::IntoPyObjectExt;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyString};

use crate::array::Frame;
use crate::sdk::SdkClass;

static DATA_ERROR: SdkClass = SdkClass::new("gleaner.data", "DataError");
static COUNTS: SdkClass = SdkClass::new("gleaner.data", "Counts");
static GUID: SdkClass = SdkClass::new("gleaner.data", "Guid");
static IDENTITY: SdkClass = SdkClass::new("gleaner.data", "Identity");
static STAMPS: SdkClass = SdkClass::new("gleaner.data", "Stamps");
static COLUMN: SdkClass = SdkClass::new("gleaner.data", "Column");

/// Maximum number of paths that a topic caches, so that a lambda that generates paths cannot fill
/// the memory.
const PATHS: usize = 256;

/// The ring of one input.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Topic {
    inner: Arc<data::Topic>,
    fields: Py<PyDict>,
}

/// A compiled path into the messages of one topic.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Field(data::Field);

/// One message; holds its cell of the ring.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Sample {
    inner: data::Sample,
    /// Cached fields of its topic.
    fields: Py<PyDict>,
}

impl Topic {
    pub(crate) fn new(py: Python<'_>, inner: Arc<data::Topic>) -> Self {
        Self { inner, fields: PyDict::new(py).unbind() }
    }

    pub(crate) fn host(&self) -> &Arc<data::Topic> {
        &self.inner
    }

    /// Wraps a sample of this topic for the lambda.
    pub(crate) fn sample(&self, py: Python<'_>, inner: data::Sample) -> Sample {
        Sample { inner, fields: self.fields.clone_ref(py) }
    }

    fn samples(
        &self,
        py: Python<'_>,
        samples: Result<Vec<data::Sample>, DataError>,
    ) -> PyResult<Vec<Sample>> {
        let samples = samples.map_err(|error| refused(py, error))?;
        Ok(samples.into_iter().map(|sample| self.sample(py, sample)).collect())
    }
}

#[pymethods]
impl Topic {
    #[getter]
    fn name(&self) -> &str {
        self.inner.name()
    }

    #[getter]
    fn ros_topic(&self) -> &str {
        self.inner.ros_topic()
    }

    #[getter]
    fn type_name(&self) -> &str {
        self.inner.type_name()
    }

    fn newest(&self, py: Python<'_>) -> PyResult<Option<Sample>> {
        let newest = self.inner.newest().map_err(|error| refused(py, error))?;
        Ok(newest.map(|sample| self.sample(py, sample)))
    }

    fn last(&self, py: Python<'_>, n: usize) -> PyResult<Vec<Sample>> {
        self.samples(py, self.inner.last(n))
    }

    fn since(&self, py: Python<'_>, since_ns: i64) -> PyResult<Vec<Sample>> {
        self.samples(py, self.inner.since(since_ns))
    }

    fn counts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let data::Counts { received, lost, overwritten, no_slot, too_big, skipped } =
            self.inner.counts();
        COUNTS.make(py, (received, lost, overwritten, no_slot, too_big, skipped))
    }

    fn field<'py>(&self, path: &Bound<'py, PyString>) -> PyResult<Bound<'py, Field>> {
        field_at(path, &self.inner, &self.fields)
    }

    fn column<'py>(
        &self,
        py: Python<'py>,
        field: &Bound<'py, PyAny>,
        n: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let field = field_of(field, &self.inner, &self.fields)?;
        column(py, self.inner.column(&field.get().0, n))
    }

    fn column_since<'py>(
        &self,
        py: Python<'py>,
        field: &Bound<'py, PyAny>,
        since_ns: i64,
    ) -> PyResult<Bound<'py, PyAny>> {
        let field = field_of(field, &self.inner, &self.fields)?;
        column(py, self.inner.column_since(&field.get().0, since_ns))
    }

    fn __repr__(&self) -> String {
        format!("<Topic `{}`: {} {}>", self.name(), self.ros_topic(), self.type_name())
    }
}

#[pymethods]
impl Field {
    #[getter]
    fn path(&self) -> &str {
        self.0.path()
    }

    fn __repr__(&self) -> String {
        format!("<Field `{}`>", self.path())
    }
}

#[pymethods]
impl Sample {
    #[getter]
    fn identity<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        identity(py, &self.inner.identity())
    }

    #[getter]
    fn stamps<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        stamps(py, self.inner.stamps())
    }

    fn get<'py>(&self, py: Python<'py>, field: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let field = field_of(field, self.inner.topic(), &self.fields)?;
        value(py, self.inner.get(&field.get().0).map_err(|error| refused(py, error))?)
    }

    fn number(&self, py: Python<'_>, field: &Bound<'_, PyAny>) -> PyResult<f64> {
        let field = field_of(field, self.inner.topic(), &self.fields)?;
        self.inner.number(&field.get().0).map_err(|error| refused(py, error))
    }

    #[getter]
    fn size(&self) -> usize {
        self.inner.bytes().len()
    }

    #[getter]
    fn big_endian(&self) -> bool {
        self.inner.big_endian()
    }

    #[pyo3(signature = (offset = 0, len = None))]
    fn cdr<'py>(
        &self,
        py: Python<'py>,
        offset: u64,
        len: Option<u32>,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let bytes =
            self.inner.cdr(offset, len.unwrap_or(u32::MAX)).map_err(|error| refused(py, error))?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn as_frame(&self, py: Python<'_>) -> PyResult<Frame> {
        // Decoding takes milliseconds, in which other threads of the lambda may run.
        py.detach(|| self.inner.as_frame()).map(Frame::new).map_err(|error| refused(py, error))
    }

    fn __repr__(&self) -> String {
        let data::Identity { topic, seq, .. } = self.inner.identity();
        format!("<Sample {topic} seq {seq}, at {} ns>", self.inner.stamps().at_ns)
    }
}

/// Returns a given field, or the field at a given path.
fn field_of<'py>(
    given: &Bound<'py, PyAny>,
    topic: &Arc<data::Topic>,
    fields: &Py<PyDict>,
) -> PyResult<Bound<'py, Field>> {
    if let Ok(field) = given.cast::<Field>() {
        return Ok(field.clone());
    }
    match given.cast::<PyString>() {
        Ok(path) => field_at(path, topic, fields),
        Err(_) => Err(PyTypeError::new_err("a field must be a Field, or its path as a str")),
    }
}

/// The field at `path`, compiled in the first call and cached in `fields`.
fn field_at<'py>(
    path: &Bound<'py, PyString>,
    topic: &Arc<data::Topic>,
    fields: &Py<PyDict>,
) -> PyResult<Bound<'py, Field>> {
    let py = path.py();
    let fields = fields.bind(py);
    if let Some(field) = fields.get_item(path)? {
        return Ok(field.cast_into::<Field>()?);
    }
    let field = topic.field(&path.to_cow()?).map_err(|error| refused(py, error))?;
    let field = Bound::new(py, Field(field))?;
    if fields.len() < PATHS {
        fields.set_item(path, &field)?;
    }
    Ok(field)
}

fn column(py: Python<'_>, column: Result<data::Column, DataError>) -> PyResult<Bound<'_, PyAny>> {
    let data::Column { at_ns, values } = column.map_err(|error| refused(py, error))?;
    COLUMN.make(py, (PyArray1::from_vec(py, at_ns), PyArray1::from_vec(py, values)))
}

fn value<'py>(py: Python<'py>, value: MessageValue<'_>) -> PyResult<Bound<'py, PyAny>> {
    match value {
        MessageValue::Bool(value) => value.into_bound_py_any(py),
        MessageValue::Signed(value) => value.into_bound_py_any(py),
        MessageValue::Unsigned(value) => value.into_bound_py_any(py),
        MessageValue::Real(value) => value.into_bound_py_any(py),
        MessageValue::Text(value) => value.into_bound_py_any(py),
        MessageValue::Bytes(value) => Ok(PyBytes::new(py, value).into_any()),
        MessageValue::Numbers(values) => Ok(PyArray1::from_vec(py, values).into_any()),
        MessageValue::Texts(values) => values.into_bound_py_any(py),
    }
}

pub(crate) fn identity<'py>(
    py: Python<'py>,
    identity: &data::Identity,
) -> PyResult<Bound<'py, PyAny>> {
    let data::Identity { topic, writer, seq } = identity;
    let bytes = u128::from_be_bytes(writer.0);
    let writer = GUID.make(py, ((bytes >> 64) as u64, bytes as u64))?;
    IDENTITY.make(py, (topic, writer, seq))
}

pub(crate) fn stamps(py: Python<'_>, stamps: data::Stamps) -> PyResult<Bound<'_, PyAny>> {
    let data::Stamps { at_ns, publish_ns, header_ns } = stamps;
    STAMPS.make(py, (at_ns, publish_ns, header_ns))
}

pub(crate) fn refused(py: Python<'_>, error: DataError) -> PyErr {
    DATA_ERROR.error(py, error.to_string(), error.kind().name())
}
