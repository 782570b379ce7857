//! The extension module `_gleaner`: the runtime's library, hosted by a Python interpreter.
//!
//! `data`, `frame`, `trigger`, `inference`, `log` and `scratch` are thin skins over the files of
//! the same names in `gleaner_host::api`: they convert arguments and errors, and decide nothing.
//! `guest` wakes the lambda. Plain values and exceptions are classes of the Python package
//! `gleaner`, defined once, there; `sdk` finds them.
//!
//! One thread runs all of it. No thread that receives samples ever attaches to the interpreter, and
//! nothing here is `unsafe` but `array`, which lends the pixels of a frame to numpy, and `memory`,
//! which notices where there is none left.

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

/// What `start.py` loads, before anything of the lambda's environment: `gleaner._host` imports
/// numpy, once the process is shut.
#[pymodule]
mod _gleaner {
    use super::*;

    #[pymodule_export]
    use super::context::Context;
    #[pymodule_export]
    use super::data::{Field, Sample, Topic};
    #[pymodule_export]
    use super::frame::Frame;
    #[pymodule_export]
    use super::guest::main;
    #[pymodule_export]
    use super::inference::{Model, Tensor};
    #[pymodule_export]
    use super::scratch::Scratch;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
