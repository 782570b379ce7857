//! `gleaner:lambda/scratch` over `gleaner_host::api::scratch`.

use std::borrow::Cow;

use gleaner_host::api::Session;
use gleaner_host::api::scratch::{Entry, ScratchError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyMemoryView};

use crate::sdk::SdkClass;

static SCRATCH_ERROR: SdkClass = SdkClass::new("gleaner.scratch", "ScratchError");
static ENTRY: SdkClass = SdkClass::new("gleaner.scratch", "Entry");

fn refused(py: Python<'_>, error: &ScratchError) -> PyErr {
    SCRATCH_ERROR.error(py, error.to_string(), error.kind().name())
}

#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Scratch(Session);

impl Scratch {
    pub(crate) fn new(session: Session) -> Self {
        Self(session)
    }
}

#[pymethods]
impl Scratch {
    fn put(&self, py: Python<'_>, name: Cow<'_, str>, bytes: &Bound<'_, PyAny>) -> PyResult<()> {
        self.0.put(&name, to_bytes(bytes)?.as_bytes()).map_err(|error| refused(py, &error))
    }

    fn append(&self, py: Python<'_>, name: Cow<'_, str>, bytes: &Bound<'_, PyAny>) -> PyResult<()> {
        self.0.append(&name, to_bytes(bytes)?.as_bytes()).map_err(|error| refused(py, &error))
    }

    #[pyo3(signature = (name, offset = 0, len = None))]
    fn get<'py>(
        &self,
        py: Python<'py>,
        name: Cow<'_, str>,
        offset: u64,
        len: Option<u64>,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let bytes = self
            .0
            .get(&name, offset, len.unwrap_or(u64::MAX))
            .map_err(|error| refused(py, &error))?;
        Ok(PyBytes::new(py, &bytes))
    }

    fn remove(&self, py: Python<'_>, name: Cow<'_, str>) -> PyResult<()> {
        self.0.remove(&name).map_err(|error| refused(py, &error))
    }

    fn entries<'py>(&self, py: Python<'py>) -> PyResult<Vec<Bound<'py, PyAny>>> {
        let entries = self.0.entries().map_err(|error| refused(py, &error.into()))?;
        entries.into_iter().map(|Entry { name, bytes }| ENTRY.make(py, (name, bytes))).collect()
    }

    fn free(&self) -> u64 {
        self.0.free()
    }
}

/// The bytes of an object with a buffer: `bytes`, `bytearray`, a numpy array.
pub(crate) fn to_bytes<'py>(bytes: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyBytes>> {
    if let Ok(bytes) = bytes.cast::<PyBytes>() {
        return Ok(bytes.clone());
    }
    // A mutable buffer is copied first.
    Ok(PyMemoryView::from(bytes)?.call_method0("tobytes")?.cast_into()?)
}
