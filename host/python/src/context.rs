//! The context that a lambda receives in each call: the functions of the WIT interfaces `data`,
//! `trigger` and `log`.

use std::borrow::Cow;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use gleaner_host::api::{Session, data};
use gleaner_lambda::manifest::ConfigValue;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::data::{Sample, Topic, refused};
use crate::scratch::Scratch;
use crate::{log, trigger};

/// The session of one lambda. A lambda that is re-initialised after a fault gets a new one.
#[pyclass(frozen, module = "_gleaner")]
pub(crate) struct Context {
    session: Session,
    topics: Vec<Py<Topic>>,
    config: Py<PyDict>,
    scratch: Py<Scratch>,
    missed: AtomicU64,
}

impl Context {
    pub(crate) fn new(py: Python<'_>, session: Session) -> PyResult<Self> {
        let topics = session.inputs().into_iter().map(|topic| Py::new(py, Topic::new(py, topic)));
        let topics = topics.collect::<PyResult<Vec<_>>>()?;
        let config = PyDict::new(py);
        for (key, value) in session.config() {
            match value {
                ConfigValue::Bool(value) => config.set_item(key, value)?,
                ConfigValue::Int(value) => config.set_item(key, value)?,
                ConfigValue::Float(value) => config.set_item(key, value)?,
                ConfigValue::Text(value) => config.set_item(key, value)?,
            }
        }
        let scratch = Py::new(py, Scratch::new(session.clone()))?;
        Ok(Self { session, topics, config: config.unbind(), scratch, missed: AtomicU64::new(0) })
    }

    /// Sets the value that the lambda reads as `missed`.
    pub(crate) fn set_missed(&self, ticks: u64) {
        self.missed.store(ticks, Ordering::Relaxed);
    }

    /// Wraps a sample of one of the inputs for the lambda.
    pub(crate) fn sample(&self, py: Python<'_>, sample: data::Sample) -> PyResult<Sample> {
        let topic = self.topic(py, sample.topic())?;
        Ok(topic.get().sample(py, sample))
    }

    /// Returns the same object in every call, so that each path is compiled once.
    fn topic<'py>(
        &self,
        py: Python<'py>,
        wanted: &Arc<data::Topic>,
    ) -> PyResult<&Bound<'py, Topic>> {
        let mut topics = self.topics.iter().map(|topic| topic.bind(py));
        let found = topics.find(|topic| Arc::ptr_eq(topic.get().host(), wanted));
        Ok(found.expect("the session's inputs never change"))
    }
}

#[pymethods]
impl Context {
    /// Values of `[config]` by key: the manifest's, overridden by the deployment's.
    #[getter]
    fn config<'py>(&self, py: Python<'py>) -> &Bound<'py, PyDict> {
        self.config.bind(py)
    }

    #[getter]
    fn scratch<'py>(&self, py: Python<'py>) -> &Bound<'py, Scratch> {
        self.scratch.bind(py)
    }

    #[getter]
    fn missed(&self) -> u64 {
        self.missed.load(Ordering::Relaxed)
    }

    fn input<'py>(&self, py: Python<'py>, name: Cow<'_, str>) -> PyResult<Bound<'py, Topic>> {
        let topic = self.session.input(&name).map_err(|error| refused(py, error))?;
        self.topic(py, &topic).cloned()
    }

    fn inputs(&self, py: Python<'_>) -> PyResult<Vec<String>> {
        self.session.input_names().map_err(|error| refused(py, error.into()))
    }

    fn now_ns(&self) -> i64 {
        self.session.now_ns()
    }

    #[pyo3(signature = (label, score, /, **attributes))]
    fn event(
        &self,
        py: Python<'_>,
        label: Cow<'_, str>,
        score: f64,
        attributes: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<()> {
        let attributes = trigger::attributes(&label, attributes)?;
        self.session.event(&label, score, attributes).map_err(|error| trigger::refused(py, &error))
    }

    #[pyo3(signature = (label, /, **attributes))]
    fn start(
        &self,
        py: Python<'_>,
        label: Cow<'_, str>,
        attributes: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<()> {
        let attributes = trigger::attributes(&label, attributes)?;
        self.session.start(&label, attributes).map_err(|error| trigger::refused(py, &error))
    }

    #[pyo3(signature = (label, /))]
    fn stop(&self, py: Python<'_>, label: Cow<'_, str>) -> PyResult<()> {
        self.session.stop(&label).map_err(|error| trigger::refused(py, &error))
    }

    fn log(&self, py: Python<'_>, level: Cow<'_, str>, message: Cow<'_, str>) -> PyResult<()> {
        self.session.log(log::level(&level)?, &message).map_err(|error| refused(py, error.into()))
    }
}
