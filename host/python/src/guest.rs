//! Runs a Python lambda as a guest of the host. `start.py` hands over the interpreter by calling
//! `main`.

use std::cell::Cell;
use std::ffi::OsString;
use std::path::{self, PathBuf};
use std::time::Duration;

use gleaner_host::api::Session;
use gleaner_host::api::call_time::{CallTime, TimeUsed};
use gleaner_host::api::data::Wake;
use gleaner_host::api::log::LINE_BYTES;
use gleaner_host::guest::{Guest, LambdaEngine, WakeOutcome};
use gleaner_host::session_setup::RunMode;
use gleaner_host::{memory, program};
use gleaner_lambda::manifest::{Limits, Manifest, ScheduleSpec};
use gleaner_lambda::{Fault, FaultKind};
use pyo3::call::PyCallArgs;
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::PyString;

use crate::context::Context;
use crate::inference;

/// Wakes between two runs of the garbage collector.
const WAKES_PER_TIDY: u64 = 10;

/// Runs `gleaner-runtime` with its arguments inside this interpreter; returns the exit code.
///
/// `host` is the module `gleaner._host`: the part of the host that is written in Python.
#[pyfunction]
pub(crate) fn main(py: Python<'_>, args: Vec<OsString>, host: Py<PyAny>) -> u8 {
    // Attached only during a call into the lambda, so that its own threads run between wakes.
    py.detach(|| {
        program::run_with(args, &mut |lambda, manifest, session, mode| {
            let host = Python::attach(|py| host.clone_ref(py));
            let entry = lambda.build.entry_path(manifest);
            let allowed = CallLimits::new(&manifest.limits, mode);
            Ok(Box::new(PythonGuest::new(host, entry, handler(manifest), session, allowed)))
        })
    })
}

thread_local! {
    /// The current call into the lambda, if it has a deadline.
    static CALL: Cell<Option<CallTime>> = const { Cell::new(None) };
}

/// Time in seconds that is left of the current call into the lambda; 0 if it has to end. The
/// signal handler of the deadline calls this.
#[pyfunction]
pub(crate) fn time_left() -> f64 {
    CALL.get().map_or(0.0, |call| call.left(Duration::ZERO).as_secs_f64())
}

fn handler(manifest: &Manifest) -> &'static str {
    match manifest.schedule {
        ScheduleSpec::Event { .. } => "on_event",
        ScheduleSpec::Periodic { .. } => "on_tick",
    }
}

#[derive(Copy, Clone)]
struct CallLimits {
    /// Time for the import and `init` together; 0 means no limit.
    init: Duration,
    wake: Duration,
    /// Memory in bytes.
    memory: u64,
}

impl CallLimits {
    fn new(limits: &Limits, mode: RunMode) -> Self {
        let memory = limits.memory.bytes();
        match mode {
            RunMode::Replay => Self { init: Duration::ZERO, wake: Duration::ZERO, memory },
            RunMode::Live(wake) => Self { init: limits.init_deadline, wake, memory },
        }
    }
}

/// A lambda in a Python file. After a fault it is re-initialised; the globals of its module are
/// kept.
struct PythonGuest {
    host: Py<PyAny>,
    entry: PathBuf,
    handler: &'static str,
    session: Session,
    allowed: CallLimits,
    /// Creates a lambda and returns its handler; set once the file was imported.
    make: Option<Py<PyAny>>,
    instance: Option<PythonInstance>,
    wakes: u64,
}

/// An initialised lambda that has not faulted.
struct PythonInstance {
    context: Py<Context>,
    handler: Py<PyAny>,
}

impl PythonGuest {
    fn new(
        host: Py<PyAny>,
        entry: PathBuf,
        handler: &'static str,
        session: Session,
        allowed: CallLimits,
    ) -> Self {
        inference::use_session(session.clone());
        Self { host, entry, handler, session, allowed, make: None, instance: None, wakes: 0 }
    }

    /// Redirects the lambda's output to its log, including output during the import.
    fn redirect_output(&self, py: Python<'_>) -> PyResult<()> {
        let context = Py::new(py, Context::new(py, self.session.clone())?)?;
        self.host.call_method1(py, "print_to", (context.getattr(py, "log")?,)).map(drop)
    }

    fn start(&mut self, py: Python<'_>) -> Result<PythonInstance, Fault> {
        let make = match &self.make {
            Some(make) => make.clone_ref(py),
            None => self.import(py).map_err(|failed| failed.fault("in import: "))?,
        };
        self.make = Some(make.clone_ref(py));
        self.make_instance(py, &make).map_err(|failed| failed.fault("in init: "))
    }

    fn import(&self, py: Python<'_>) -> Result<Py<PyAny>, CallFault> {
        self.redirect_output(py)?;
        let entry = path::absolute(&self.entry).map_err(PyErr::from)?;
        let (init, load) = (self.allowed.init, self.host.getattr(py, "load")?);
        let make = self.attempt(py, init, (init.as_secs_f64(), load, entry, self.handler))?;
        Ok(make.unbind())
    }

    fn make_instance(&self, py: Python<'_>, make: &Py<PyAny>) -> Result<PythonInstance, CallFault> {
        let context = Py::new(py, Context::new(py, self.session.clone())?)?;
        let init = self.allowed.init;
        let handler = self.attempt(py, init, (init.as_secs_f64(), make, &context))?.unbind();
        Ok(PythonInstance { context, handler })
    }

    fn run(&mut self, py: Python<'_>, wake: Wake) -> Result<(), Fault> {
        let instance = match self.instance.take() {
            Some(instance) => instance,
            None => {
                let session = self.session.clone();
                session.during_init(|| self.start(py))?
            }
        };
        self.call(py, &instance, wake).map_err(|failed| failed.fault(""))?;
        self.instance = Some(instance);
        Ok(())
    }

    fn call(&self, py: Python<'_>, instance: &PythonInstance, wake: Wake) -> Result<(), CallFault> {
        let PythonInstance { context, handler } = instance;
        let (wake_time, seconds) = (self.allowed.wake, self.allowed.wake.as_secs_f64());
        match wake {
            Wake::Event(sample) => {
                let event = context.get().sample(py, sample)?;
                self.attempt(py, wake_time, (seconds, handler, context, event))?;
            }
            Wake::Tick(tick) => {
                context.get().set_missed(tick.missed);
                self.attempt(py, wake_time, (seconds, handler, context))?;
            }
        }
        Ok(())
    }

    /// Calls the second item of `call`, which is code of the lambda, with the items after it; the
    /// first item is `allowed` in seconds.
    ///
    /// `gleaner._host` catches the exceptions: a panic in Rust code below the call must not return
    /// here as an exception, because PyO3 turns such an exception into a panic again, which would
    /// end the process.
    fn attempt<'py>(
        &self,
        py: Python<'py>,
        allowed: Duration,
        call: impl PyCallArgs<'py>,
    ) -> Result<Bound<'py, PyAny>, CallFault> {
        let time = (!allowed.is_zero()).then(|| CallTime::begin(allowed));
        CALL.set(time);
        self.session.models().end_with(time);
        let ended = self.host.bind(py).call_method1(intern!(py, "attempt"), call)?;
        let late = time.as_ref().and_then(CallTime::late);
        match ended
            .extract::<(Bound<'py, PyAny>, Option<Bound<'py, PyString>>, Bound<'py, PyString>)>()?
        {
            // The signal never came: a lambda can ignore it, block it, or disable its timer.
            (result, None, _) => late.map_or(Ok(result), |time| {
                Err(CallFault::late("native code of Python is not interrupted", time))
            }),
            (_, Some(message), kind) => {
                let message = message.to_string_lossy().into_owned();
                Err(match &*kind.to_string_lossy() {
                    "deadline" => {
                        CallFault::late(&message, time.map(|time| time.used()).unwrap_or_default())
                    }
                    "memory" => CallFault {
                        kind: FaultKind::Memory,
                        message,
                        used: None,
                        allowed: Some(self.allowed.memory),
                    },
                    _ => {
                        CallFault { kind: FaultKind::Exception, message, used: None, allowed: None }
                    }
                })
            }
        }
    }

    /// Runs the garbage collector, which is off during wakes; see `gleaner._host`.
    fn tidy(&mut self, py: Python<'_>) {
        self.wakes += 1;
        if self.wakes.is_multiple_of(WAKES_PER_TIDY) {
            // It fails only if a lambda replaced the collector; then nothing has to be done here.
            let _ = self.host.call_method1(py, "tidy", (self.wakes,));
        }
    }
}

/// Cause and message of a failed call into the lambda. The exception is not kept: its traceback
/// holds the frames of the call, and these hold the sample.
struct CallFault {
    kind: FaultKind,
    message: String,
    used: Option<u64>,
    allowed: Option<u64>,
}

impl CallFault {
    fn fault(&self, when: &str) -> Fault {
        let Self { kind, message, used, allowed } = self;
        let message = format!("{when}{}", suffix(message, LINE_BYTES - when.len()));
        Fault { kind: *kind, message, used: *used, allowed: *allowed }
    }

    /// Creates a deadline fault; `location` is the place where the call was interrupted.
    fn late(location: &str, time: TimeUsed) -> Self {
        let Fault { kind, message, used, allowed } = time.fault(&format!("{location}\n"));
        Self { kind, message, used, allowed }
    }
}

/// An exception outside of the lambda's code, such as a lack of memory.
impl From<PyErr> for CallFault {
    fn from(error: PyErr) -> Self {
        Self { kind: FaultKind::Exception, message: error.to_string(), used: None, allowed: None }
    }
}

impl Guest for PythonGuest {
    fn prepare(&mut self) -> Result<(), Fault> {
        Python::attach(|py| {
            let enter = || {
                let enter = self.host.getattr(py, "enter_environment")?;
                // Only the shim limits its time, which depends on the machine and not on the
                // lambda.
                self.attempt(py, Duration::ZERO, (0.0, enter)).map(drop)
            };
            enter().map_err(|failed: CallFault| failed.fault("at the start of its environment: "))
        })
    }

    fn init(&mut self) -> Result<(), Fault> {
        Python::attach(|py| {
            self.instance = None;
            self.instance = Some(self.start(py)?);
            let settled = self.host.call_method0(py, "settle");
            settled.map(drop).map_err(|error| CallFault::from(error).fault("in init: "))
        })
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome {
        Python::attach(|py| {
            let result = self.run(py, wake);
            self.tidy(py);
            WakeOutcome { result, fuel: None, run_ns: None, model_ns: None }
        })
    }

    fn discard(&mut self) {
        Python::attach(|py| {
            self.instance = None;
            // All generations: the last wake may have left cycles.
            let _ = self.host.call_method1(py, "tidy", (0,));
        });
        memory::trim_heap();
    }

    fn engine(&self) -> LambdaEngine {
        Python::attach(|py| {
            let version = Python::version_str();
            let python = version.split(' ').next().unwrap_or(version);
            let numpy = self
                .host
                .call_method0(py, "numpy_version")
                .and_then(|version| version.extract::<String>(py));
            let numpy = numpy.as_deref().unwrap_or("unknown");
            let name = format!("Python {python}, numpy {numpy}");
            LambdaEngine { name, models: Vec::new() }
        })
    }
}

impl Drop for PythonGuest {
    fn drop(&mut self) {
        // Objects that a detached thread drops live until the next thread attaches; the slots
        // should be free now.
        Python::attach(|py| {
            // The log is closed: later output, such as that of destructors, goes to standard error.
            let _ = self.host.call_method1(py, "print_to", (py.None(),));
            self.instance = None;
            self.make = None;
        });
    }
}

/// The longest suffix of `text` that fits into `bytes` and begins at a character boundary: the end
/// of a traceback matters most.
fn suffix(text: &str, bytes: usize) -> &str {
    &text[text.ceil_char_boundary(text.len().saturating_sub(bytes))..]
}
