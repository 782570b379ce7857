//! Log lines for people: `gleaner:lambda/log`. In one second of the lambda's time the host accepts
//! `log_lines` lines and `log_bytes` bytes, as set in `[limits]`: by default 100 lines and 400 KiB.
//! It drops and counts further lines.

use crate::world::gleaner::lambda::log as wit;
pub use crate::world::gleaner::lambda::log::Level;

/// Writes one line. `message` is truncated to 4,096 bytes, at a character boundary.
pub fn log(level: Level, message: &str) {
    wit::log(level, message);
}

/// Logs a problem on which the operator must act.
pub fn error(message: &str) {
    log(Level::Error, message);
}

/// Logs a loss of data or time.
pub fn warn(message: &str) {
    log(Level::Warn, message);
}

/// Logs a change of state.
pub fn info(message: &str) {
    log(Level::Info, message);
}

/// Logs a line for the lambda's author.
pub fn debug(message: &str) {
    log(Level::Debug, message);
}

/// Logs a detail for the lambda's author.
pub fn trace(message: &str) {
    log(Level::Trace, message);
}
