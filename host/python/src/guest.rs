//! A Python lambda as a guest of the host, and the function through which `start.py` hands over the
//! interpreter.

use std::ffi::OsString;
use std::path::{self, PathBuf};
use std::time::{Duration, Instant};

use gleaner_host::api::Session;
use gleaner_host::api::data::Wake;
use gleaner_host::api::log::LINE_BYTES;
use gleaner_host::guest::{Guest, Outcome, is_late};
use gleaner_host::stage::Bounds;
use gleaner_host::{memory, program};
use gleaner_lambda::manifest::{Limits, Manifest, Schedule};
use gleaner_lambda::{Fault, FaultKind};
use pyo3::call::PyCallArgs;
use pyo3::intern;
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
    // Attached only for the length of a call into the lambda, so that its own threads run between
    // two wakes.
    py.detach(|| {
        program::run_in_python(args, &mut |asked, manifest, session, bounds| {
            let host = Python::attach(|py| host.clone_ref(py));
            let entry = asked.build.entry_path(manifest);
            let allowed = Allowed::new(&manifest.limits, bounds);
            Ok(Box::new(PythonGuest::new(host, entry, handler(manifest), session, allowed)))
        })
    })
}

fn handler(manifest: &Manifest) -> &'static str {
    match manifest.schedule {
        Schedule::Event { .. } => "on_event",
        Schedule::Periodic { .. } => "on_tick",
    }
}

/// What a call into the lambda may use.
#[derive(Copy, Clone)]
struct Allowed {
    /// Time of `init`, the import before it included; 0 is for ever.
    init: Duration,
    /// Time of a wake.
    wake: Duration,
    /// Memory, in bytes.
    memory: u64,
}

impl Allowed {
    fn new(limits: &Limits, bounds: Bounds) -> Self {
        let memory = limits.memory.bytes();
        match bounds {
            Bounds::Replay => Self { init: Duration::ZERO, wake: Duration::ZERO, memory },
            Bounds::Live(wake) => Self { init: limits.init_deadline, wake, memory },
        }
    }
}

/// A lambda in a Python file. After a fault it is made anew; the globals of its module stay as they
/// are.
struct PythonGuest {
    host: Py<PyAny>,
    entry: PathBuf,
    handler: &'static str,
    session: Session,
    allowed: Allowed,
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
    fn new(
        host: Py<PyAny>,
        entry: PathBuf,
        handler: &'static str,
        session: Session,
        allowed: Allowed,
    ) -> Self {
        Self { host, entry, handler, session, allowed, make: None, live: None, wakes: 0 }
    }

    /// From now on what the lambda prints is its log, what it prints while it is imported included.
    fn listen(&self, py: Python<'_>) -> PyResult<()> {
        let context = Py::new(py, Context::new(py, self.session.clone())?)?;
        self.host.call_method1(py, "print_to", (context.getattr(py, "log")?,)).map(drop)
    }

    fn start(&mut self, py: Python<'_>) -> Result<Live, Fault> {
        let make = match &self.make {
            Some(make) => make.clone_ref(py),
            None => self.import(py).map_err(|raised| raised.fault("in import: "))?,
        };
        self.make = Some(make.clone_ref(py));
        self.make_live(py, &make).map_err(|raised| raised.fault("in init: "))
    }

    fn import(&self, py: Python<'_>) -> Result<Py<PyAny>, Raised> {
        self.listen(py)?;
        let entry = path::absolute(&self.entry).map_err(PyErr::from)?;
        let (init, load) = (self.allowed.init, self.host.getattr(py, "load")?);
        let make = self.attempt(py, init, (init.as_secs_f64(), load, entry, self.handler))?;
        Ok(make.unbind())
    }

    fn make_live(&self, py: Python<'_>, make: &Py<PyAny>) -> Result<Live, Raised> {
        let context = Py::new(py, Context::new(py, self.session.clone())?)?;
        let init = self.allowed.init;
        let handler = self.attempt(py, init, (init.as_secs_f64(), make, &context))?.unbind();
        Ok(Live { context, handler })
    }

    fn run(&mut self, py: Python<'_>, wake: Wake) -> Result<(), Fault> {
        let live = match self.live.take() {
            Some(live) => live,
            None => {
                let session = self.session.clone();
                session.during_init(|| self.start(py))?
            }
        };
        self.call(py, &live, wake).map_err(|raised| raised.fault(""))?;
        self.live = Some(live);
        Ok(())
    }

    fn call(&self, py: Python<'_>, live: &Live, wake: Wake) -> Result<(), Raised> {
        let Live { context, handler } = live;
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

    /// Calls the second of `call` with those behind it, all of it code of the lambda; the first is
    /// `allowed` in seconds.
    ///
    /// `gleaner._host` catches what it raises, since a panic of ours below it must not come back
    /// here as an exception: where an exception enters Rust, one that was made of a panic becomes a
    /// panic again, and would end the process.
    fn attempt<'py>(
        &self,
        py: Python<'py>,
        allowed: Duration,
        call: impl PyCallArgs<'py>,
    ) -> Result<Bound<'py, PyAny>, Raised> {
        let started = Instant::now();
        let ended = self.host.bind(py).call_method1(intern!(py, "attempt"), call)?;
        let elapsed = started.elapsed();
        match ended
            .extract::<(Bound<'py, PyAny>, Option<Bound<'py, PyString>>, Bound<'py, PyString>)>()?
        {
            // The signal never came: a lambda can ignore it, block it, or switch its timer off.
            (_, None, _) if !allowed.is_zero() && is_late(elapsed, allowed) => {
                Err(Raised::late("the call came back by itself, too late", elapsed, allowed))
            }
            (result, None, _) => Ok(result),
            (_, Some(told), kind) => {
                let told = told.to_string_lossy().into_owned();
                Err(match &*kind.to_string_lossy() {
                    "deadline" => Raised::late(&told, elapsed, allowed),
                    "memory" => Raised {
                        kind: FaultKind::Memory,
                        told,
                        used: None,
                        allowed: Some(self.allowed.memory),
                    },
                    _ => Raised { kind: FaultKind::Exception, told, used: None, allowed: None },
                })
            }
        }
    }

    /// The collector is off during wakes and runs between them, see `gleaner._host`.
    fn tidy(&mut self, py: Python<'_>) {
        self.wakes += 1;
        if self.wakes.is_multiple_of(WAKES_PER_TIDY) {
            // It fails only if a lambda took the collector apart; then there is nothing to do
            // between wakes.
            let _ = self.host.call_method1(py, "tidy", (self.wakes,));
        }
    }
}

/// What ended a call into the lambda, told. Nothing else is kept of it: a traceback holds the
/// frames of a call, and these the sample.
struct Raised {
    kind: FaultKind,
    told: String,
    used: Option<u64>,
    allowed: Option<u64>,
}

impl Raised {
    fn fault(&self, when: &str) -> Fault {
        let Self { kind, told, used, allowed } = self;
        let message = format!("{when}{}", ending(told, LINE_BYTES - when.len()));
        Fault { kind: *kind, message, used: *used, allowed: *allowed }
    }

    /// `told` says where it was.
    fn late(told: &str, ran: Duration, allowed: Duration) -> Self {
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        let told = format!("{told}\nran {:.1} ms; the deadline is {:.1} ms", ms(ran), ms(allowed));
        let ns = |time: Duration| u64::try_from(time.as_nanos()).ok();
        Self { kind: FaultKind::Deadline, told, used: ns(ran), allowed: ns(allowed) }
    }
}

/// An exception in what surrounds the call, such as a lack of memory.
impl From<PyErr> for Raised {
    fn from(error: PyErr) -> Self {
        Self { kind: FaultKind::Exception, told: error.to_string(), used: None, allowed: None }
    }
}

impl Guest for PythonGuest {
    fn prepare(&mut self) -> Result<(), Fault> {
        Python::attach(|py| {
            let enter = || {
                let enter = self.host.getattr(py, "enter_environment")?;
                // The shim alone ends it: how long it takes is for the machine to say, and not for
                // the lambda.
                self.attempt(py, Duration::ZERO, (0.0, enter)).map(drop)
            };
            enter().map_err(|raised: Raised| raised.fault("at the start of its environment: "))
        })
    }

    fn init(&mut self) -> Result<(), Fault> {
        Python::attach(|py| {
            self.live = None;
            self.live = Some(self.start(py)?);
            let settled = self.host.call_method0(py, "settle");
            settled.map(drop).map_err(|error| Raised::from(error).fault("in init: "))
        })
    }

    fn wake(&mut self, wake: Wake) -> Outcome {
        Python::attach(|py| {
            let result = self.run(py, wake);
            self.tidy(py);
            Outcome { result, fuel: None, run_ns: None }
        })
    }

    fn discard(&mut self) {
        Python::attach(|py| {
            self.live = None;
            // All objects, since the wake that was one too many may have left cycles.
            let _ = self.host.call_method1(py, "tidy", (0,));
        });
        memory::give_freed_back();
    }

    fn engine(&self) -> String {
        Python::attach(|py| {
            let version = Python::version_str();
            let python = version.split(' ').next().unwrap_or(version);
            let numpy = self
                .host
                .call_method0(py, "numpy_version")
                .and_then(|version| version.extract::<String>(py));
            format!("Python {python}, numpy {}", numpy.as_deref().unwrap_or("unknown"))
        })
    }
}

impl Drop for PythonGuest {
    fn drop(&mut self) {
        // What a detached thread lets go of lives on until the next one attaches; the slots should
        // be free now.
        Python::attach(|py| {
            // The log is written: what is printed from now on, if only by what goes away here, is
            // for standard error.
            let _ = self.host.call_method1(py, "print_to", (py.None(),));
            self.live = None;
            self.make = None;
        });
    }
}

/// The longest end of `text` that fits into `bytes` and begins at a character boundary: a traceback
/// says what happened last.
fn ending(text: &str, bytes: usize) -> &str {
    &text[text.ceil_char_boundary(text.len().saturating_sub(bytes))..]
}
