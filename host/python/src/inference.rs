//! `gleaner:lambda/inference` over `gleaner_host::api::inference`.
//!
//! This build has no model runtime: no model or tensor can be created, so their methods are never
//! called.

use std::borrow::Cow;

use gleaner_host::api::fuel::Fuel;
use gleaner_host::api::inference::{self, InferenceError};
use pyo3::prelude::*;

use crate::sdk::SdkClass;

static INFERENCE_ERROR: SdkClass = SdkClass::new("gleaner.inference", "InferenceError");

/// A tensor in host memory.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Tensor(inference::Tensor);

/// A loaded model.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Model(inference::Model);

fn refused(py: Python<'_>, error: &InferenceError) -> PyErr {
    INFERENCE_ERROR.error(py, error.to_string(), error.kind().name())
}

#[pymethods]
impl Tensor {
    #[staticmethod]
    #[expect(unused_variables)]
    fn from_values(
        py: Python<'_>,
        shape: &Bound<'_, PyAny>,
        values: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        inference::Tensor::from_values(0, &Fuel::default())
            .map(Self)
            .map_err(|error| refused(py, &error))
    }

    #[staticmethod]
    #[expect(unused_variables)]
    fn from_frame(
        py: Python<'_>,
        frame: &Bound<'_, PyAny>,
        how: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        inference::Tensor::from_frame(&Fuel::default())
            .map(Self)
            .map_err(|error| refused(py, &error))
    }

    #[getter]
    fn shape(&self) -> Vec<u32> {
        match self.0 {}
    }

    #[pyo3(signature = (offset = 0, len = None))]
    #[expect(unused_variables)]
    fn read(&self, offset: u64, len: Option<u32>) -> Vec<f32> {
        match self.0 {}
    }
}

#[pymethods]
impl Model {
    #[staticmethod]
    fn open(py: Python<'_>, name: Cow<'_, str>) -> PyResult<Self> {
        inference::Model::open(&name, &Fuel::default())
            .map(Self)
            .map_err(|error| refused(py, &error))
    }

    #[expect(unused_variables)]
    fn run(&self, inputs: &Bound<'_, PyAny>) -> Vec<Tensor> {
        match self.0 {}
    }

    #[pyo3(signature = (frame, options = None))]
    #[expect(unused_variables)]
    fn detect(&self, frame: &Bound<'_, PyAny>, options: Option<&Bound<'_, PyAny>>) -> Vec<Tensor> {
        match self.0 {}
    }
}
