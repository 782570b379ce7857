//! A Python lambda as a guest of the host, and the function through which `start.py` hands over the interpreter.

use std::ffi::OsString;
use std::path::{self, PathBuf};

use gleaner_host::api::Session;
use gleaner_host::api::data::Wake;
use gleaner_host::api::log::LINE_BYTES;
use gleaner_host::guest::{Guest, Outcome};
use gleaner_host::program;
use gleaner_protocol::manifest::{Manifest, Schedule};
use gleaner_protocol::{Fault, FaultKind};
use pyo3::prelude::*;
use pyo3::types::PyString;

use crate::context::Context;

/// Wakes between two looks of the garbage collector.
const WAKES_PER_TIDY: u64 = 10;

/// Runs `gleaner-runtime` with its arguments inside this interpreter; returns the exit code.
///
/// `host` is the module `gleaner._host`: the part of hosting that is written in Python.
#[pyfunction]
pub(crate) fn main(py: Python<'_>, args: Vec<OsString>, host: Py<PyAny>) -> u8 {
    // Attached only for the length of a call into the lambda, so that its own threads run between two wakes.
    py.detach(|| {
        program::replay_in_python(args, &mut |options, manifest, session| {
            let host = Python::attach(|py| host.clone_ref(py));
            let entry = options.build.entry_path(manifest);
            Ok(Box::new(PythonGuest::new(host, entry, handler(manifest), session)))
        })
    })
}

fn handler(manifest: &Manifest) -> &'static str {
    match manifest.schedule {
        Schedule::Event { .. } => "on_event",
        Schedule::Periodic { .. } => "on_tick",
    }
}

/// A lambda in a Python file. After a fault it is made anew; the globals of its module stay as they are.
struct PythonGuest {
    host: Py<PyAny>,
    entry: PathBuf,
    handler: &'static str,
    session: Session,
    /// Makes a lambda and gives its handler; there once the file was imported.
    make: Option<Py<PyAny>>,
    live: Option<Live>,
    wakes: u64,
}

/// A lambda that was made and has not faulted.
struct Live {
    context: Py<Context>,
    handler: Py<PyAny>,
}

impl PythonGuest {
    fn new(host: Py<PyAny>, entry: PathBuf, handler: &'static str, session: Session) -> Self {
        Self { host, entry, handler, session, make: None, live: None, wakes: 0 }
    }

    fn start(&mut self, py: Python<'_>) -> Result<Live, Fault> {
        let make = match &self.make {
            Some(make) => make.clone_ref(py),
            None => self.import(py).map_err(|error| self.fault(py, "in import: ", error))?,
        };
        self.make = Some(make.clone_ref(py));
        self.make_live(make.bind(py)).map_err(|error| self.fault(py, "in init: ", error))
    }

    fn import(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let entry = path::absolute(&self.entry)?;
        self.host.call_method1(py, "load", (entry, self.handler))
    }

    fn make_live(&self, make: &Bound<'_, PyAny>) -> PyResult<Live> {
        let py = make.py();
        let context = Py::new(py, Context::new(py, self.session.clone())?)?;
        let handler = make.call1((&context,))?.unbind();
        Ok(Live { context, handler })
    }

    fn run(&mut self, py: Python<'_>, wake: Wake) -> Result<(), Fault> {
        let live = match self.live.take() {
            Some(live) => live,
            None => self.start(py)?,
        };
        live.run(py, wake).map_err(|error| self.fault(py, "", error))?;
        self.live = Some(live);
        Ok(())
    }

    /// The collector is off during wakes and runs between them, see `gleaner._host`.
    fn tidy(&mut self, py: Python<'_>) {
        self.wakes += 1;
        if self.wakes.is_multiple_of(WAKES_PER_TIDY) {
            // It fails only if a lambda took the collector apart; then there is nothing to do between wakes.
            let _ = self.host.call_method1(py, "tidy", (self.wakes,));
        }
    }

    fn fault(&self, py: Python<'_>, when: &str, error: PyErr) -> Fault {
        // What is in the text is all that is kept: a traceback holds the frames of a call, and these the sample.
        let told = self.host.call_method1(py, "explain", (error.into_value(py),));
        let text = match told.and_then(|text| Ok(text.extract::<Bound<'_, PyString>>(py)?)) {
            Ok(text) => text.to_string_lossy().into_owned(),
            Err(error) => error.to_string(),
        };
        let message = format!("{when}{}", ending(&text, LINE_BYTES - when.len()));
        Fault { kind: FaultKind::Exception, message, used: None, allowed: None }
    }
}

impl Live {
    fn run(&self, py: Python<'_>, wake: Wake) -> PyResult<()> {
        match wake {
            Wake::Event(sample) => {
                let event = self.context.get().sample(py, sample)?;
                self.handler.call1(py, (&self.context, event))?;
            }
            Wake::Tick(tick) => {
                self.context.get().set_missed(tick.missed);
                self.handler.call1(py, (&self.context,))?;
            }
        }
        Ok(())
    }
}

impl Guest for PythonGuest {
    fn init(&mut self) -> Result<(), Fault> {
        Python::attach(|py| {
            self.live = None;
            self.live = Some(self.start(py)?);
            let settled = self.host.call_method0(py, "settle");
            settled.map(drop).map_err(|error| self.fault(py, "in init: ", error))
        })
    }

    fn wake(&mut self, wake: Wake) -> Outcome {
        Python::attach(|py| {
            let result = self.run(py, wake);
            self.tidy(py);
            Outcome { result, fuel: None }
        })
    }
}

impl Drop for PythonGuest {
    fn drop(&mut self) {
        // What a detached thread lets go of lives on until the next one attaches; the slots should be free now.
        Python::attach(|_| {
            self.live = None;
            self.make = None;
        });
    }
}

/// The longest end of `text` that fits into `bytes` and begins at a character boundary: a traceback says what happened last.
fn ending(text: &str, bytes: usize) -> &str {
    &text[text.ceil_char_boundary(text.len().saturating_sub(bytes))..]
}
