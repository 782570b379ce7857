//! Looks up plain values and exceptions of the Python package `gleaner`, each once.

use pyo3::call::PyCallArgs;
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::PyType;

pub(crate) struct SdkClass {
    module: &'static str,
    name: &'static str,
    class: PyOnceLock<Py<PyType>>,
}

impl SdkClass {
    pub(crate) const fn new(module: &'static str, name: &'static str) -> Self {
        Self { module, name, class: PyOnceLock::new() }
    }

    /// Creates a value of the class from its fields, in their order.
    pub(crate) fn make<'py>(
        &self,
        py: Python<'py>,
        fields: impl PyCallArgs<'py>,
    ) -> PyResult<Bound<'py, PyAny>> {
        self.class.import(py, self.module, self.name)?.call1(fields)
    }

    /// Creates an exception of the class from the message of the host's error and the WIT name of
    /// its case.
    pub(crate) fn error(&self, py: Python<'_>, message: String, kind: &'static str) -> PyErr {
        match self.class.import(py, self.module, self.name) {
            Ok(class) => PyErr::from_type(class.clone(), (message, kind)),
            Err(error) => error,
        }
    }
}
