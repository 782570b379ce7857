//! Lines for people: `gleaner:lambda/log`. At most 100 in one second; the rest is dropped and
//! counted.

use crate::bindings::gleaner::lambda::log as wit;
pub use crate::bindings::gleaner::lambda::log::Level;

/// Writes one line; it is cut at 4,096 bytes.
pub fn log(level: Level, message: &str) {
    wit::log(level, message);
}

/// Someone must act.
pub fn error(message: &str) {
    log(Level::Error, message);
}

/// Data or time was lost.
pub fn warn(message: &str) {
    log(Level::Warn, message);
}

/// A state changed.
pub fn info(message: &str) {
    log(Level::Info, message);
}

/// For the lambda's author.
pub fn debug(message: &str) {
    log(Level::Debug, message);
}

/// For the lambda's author, in detail.
pub fn trace(message: &str) {
    log(Level::Trace, message);
}
