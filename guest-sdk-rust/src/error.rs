//! The error type of all calls to the host, and of the methods of a lambda.

use std::fmt;

use crate::bindings::gleaner::lambda::inference::InferenceError;
use crate::bindings::gleaner::lambda::scratch::ScratchError;
use crate::bindings::gleaner::lambda::trigger::TriggerError;
use crate::bindings::gleaner::lambda::types::DataError;

/// An error message. If a handler returns it, the wake is a fault. If the first `init` returns it,
/// the lambda does not start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    kind: Option<&'static str>,
    message: String,
}

/// Result of the calls to the host and of the methods of a lambda.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// Creates an error with this message.
    pub fn new(message: impl Into<String>) -> Self {
        Self { kind: None, message: message.into() }
    }

    /// Returns the case of the WIT variant with which the host refused a call, such as `no-room`;
    /// none for other errors.
    pub fn kind(&self) -> Option<&'static str> {
        self.kind
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

/// Converts any Rust error with `?`; the causes are appended to the message. (`Error` itself does
/// not implement `std::error::Error`, since the two implementations of `From` would overlap.)
impl<E: std::error::Error> From<E> for Error {
    fn from(error: E) -> Self {
        let mut message = error.to_string();
        let mut cause = error.source();
        while let Some(error) = cause {
            message = format!("{message}: {error}");
            cause = error.source();
        }
        Self::new(message)
    }
}

/// An error of the bindings, which has the name of its case in the WIT and a message.
pub(crate) trait HostError {
    fn into_parts(self) -> (&'static str, String);
}

/// Converts a result of the bindings. The errors that wit-bindgen generates print as code, so only
/// their case and message are kept.
pub(crate) fn into_result<T>(result: std::result::Result<T, impl HostError>) -> Result<T> {
    result.map_err(refused)
}

/// Converts an error of the bindings.
pub(crate) fn refused(error: impl HostError) -> Error {
    let (kind, message) = error.into_parts();
    Error { kind: Some(kind), message }
}

impl HostError for DataError {
    fn into_parts(self) -> (&'static str, String) {
        match self {
            Self::NoSuchInput(message) => ("no-such-input", message),
            Self::NoSuchField(message) => ("no-such-field", message),
            Self::WrongField(message) => ("wrong-field", message),
            Self::Malformed(message) => ("malformed", message),
            Self::NotAFrame(message) => ("not-a-frame", message),
            Self::NoRoom(message) => ("no-room", message),
            Self::OutOfRange(message) => ("out-of-range", message),
        }
    }
}

impl HostError for TriggerError {
    fn into_parts(self) -> (&'static str, String) {
        match self {
            Self::Invalid(message) => ("invalid", message),
            Self::TooMany(message) => ("too-many", message),
        }
    }
}

impl HostError for ScratchError {
    fn into_parts(self) -> (&'static str, String) {
        match self {
            Self::NoRoom(message) => ("no-room", message),
            Self::NoSuchEntry(message) => ("no-such-entry", message),
            Self::WrongName(message) => ("wrong-name", message),
        }
    }
}

impl HostError for InferenceError {
    fn into_parts(self) -> (&'static str, String) {
        match self {
            Self::Unavailable(message) => ("unavailable", message),
            Self::NoSuchModel(message) => ("no-such-model", message),
            Self::WrongInput(message) => ("wrong-input", message),
            Self::TooSlow(message) => ("too-slow", message),
            Self::Failed(message) => ("failed", message),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_error_keeps_its_kind_and_message() {
        let error =
            into_result::<()>(Err(DataError::NoRoom("no slot is free".to_owned()))).unwrap_err();
        assert_eq!(
            (error.kind(), error.to_string()),
            (Some("no-room"), "no slot is free".to_owned())
        );
    }

    #[test]
    fn any_rust_error_is_converted() {
        let parse = || -> Result<i32> { Ok("x".parse::<i32>()?) };
        let error = parse().unwrap_err();
        assert_eq!(
            (error.kind(), error.to_string()),
            (None, "invalid digit found in string".to_owned())
        );
    }
}
