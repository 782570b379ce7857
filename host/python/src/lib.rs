//! The extension module `_gleaner`: the runtime's library, hosted by a Python interpreter.
//!
//! `data`, `frame`, `trigger`, `inference`, `log` and `scratch` are thin wrappers around the
//! modules of the same names in `gleaner_host::api`: they convert arguments and errors, and decide
//! nothing. `guest` calls the lambda. Plain values and exceptions are classes of the Python package
//! `gleaner`; `sdk` looks them up.
//!
//! Everything runs in one thread. Threads that receive samples never attach to the interpreter.
//! `unsafe` code is only in `array`, which lends frames and tensors to numpy, and in `memory`,
//! which counts allocations.

mod array;
mod context;
mod data;
mod frame;
mod guest;
mod inference;
mod log;
mod memory;
mod scratch;
mod sdk;
mod trigger;

use pyo3::prelude::*;

/// The module that `start.py` loads before the lambda's environment. `gleaner._host` imports numpy
/// later, in the sandboxed process.
#[pymodule]
mod _gleaner {
    use super::*;

    #[pymodule_export]
    use super::array::Frame;
    #[pymodule_export]
    use super::context::Context;
    #[pymodule_export]
    use super::data::{Field, Sample, Topic};
    #[pymodule_export]
    use super::guest::{main, time_left};
    #[pymodule_export]
    use super::inference::{Model, Tensor};
    #[pymodule_export]
    use super::scratch::Scratch;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
