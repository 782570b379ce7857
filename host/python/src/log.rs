//! `gleaner:lambda/log` over `gleaner_host::api::log`.

use gleaner_host::api::log::Level;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// Parses the WIT name of a level.
pub(crate) fn level(name: &str) -> PyResult<Level> {
    Ok(match name {
        "error" => Level::Error,
        "warn" => Level::Warn,
        "info" => Level::Info,
        "debug" => Level::Debug,
        "trace" => Level::Trace,
        _ => {
            let message =
                "the level of a log line must be `error`, `warn`, `info`, `debug` or `trace`";
            return Err(PyValueError::new_err(message));
        }
    })
}
