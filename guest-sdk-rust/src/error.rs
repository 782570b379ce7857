//! One error for everything that a lambda may meet.

use std::fmt;

use crate::bindings::gleaner::lambda::inference::InferenceError;
use crate::bindings::gleaner::lambda::scratch::ScratchError;
use crate::bindings::gleaner::lambda::trigger::TriggerError;
use crate::bindings::gleaner::lambda::types::DataError;

/// A message that ends the wake as a fault, or `init` with a refusal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    kind: Option<&'static str>,
    message: String,
}

/// What the methods of a lambda return.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// An error that says `message`.
    pub fn new(message: impl Into<String>) -> Self {
        Self { kind: None, message: message.into() }
    }

    /// Which refusal of the host it was, as the WIT names it, such as `no-room`; none for other
    /// errors.
    pub fn kind(&self) -> Option<&'static str> {
        self.kind
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

/// Any error of Rust becomes one with `?`, its causes behind it. (`Error` itself is none, or this
/// would overlap.)
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

/// A refusal of the host: the name of its case in the WIT, and its message.
pub(crate) trait Refusal {
    fn said(self) -> (&'static str, String);
}

/// An answer of the host as a result of this crate. What wit-bindgen makes of a refusal prints as
/// code, not as words.
pub(crate) fn answer<T>(answer: std::result::Result<T, impl Refusal>) -> Result<T> {
    answer.map_err(|refusal| {
        let (kind, message) = refusal.said();
        Error { kind: Some(kind), message }
    })
}

impl Refusal for DataError {
    fn said(self) -> (&'static str, String) {
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

impl Refusal for TriggerError {
    fn said(self) -> (&'static str, String) {
        match self {
            Self::Invalid(message) => ("invalid", message),
            Self::TooMany(message) => ("too-many", message),
        }
    }
}

impl Refusal for ScratchError {
    fn said(self) -> (&'static str, String) {
        match self {
            Self::NoRoom(message) => ("no-room", message),
            Self::NoSuchEntry(message) => ("no-such-entry", message),
            Self::WrongName(message) => ("wrong-name", message),
        }
    }
}

impl Refusal for InferenceError {
    fn said(self) -> (&'static str, String) {
        match self {
            Self::NoRuntime(message) => ("no-runtime", message),
            Self::NoSuchModel(message) => ("no-such-model", message),
            Self::WrongInput(message) => ("wrong-input", message),
            Self::Failed(message) => ("failed", message),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_keeps_its_kind_and_its_words() {
        let error = answer::<()>(Err(DataError::NoRoom("no slot is free".to_owned()))).unwrap_err();
        assert_eq!(
            (error.kind(), error.to_string()),
            (Some("no-room"), "no slot is free".to_owned())
        );
    }

    #[test]
    fn any_error_of_rust_becomes_one() {
        let parse = || -> Result<i32> { Ok("x".parse::<i32>()?) };
        let error = parse().unwrap_err();
        assert_eq!(
            (error.kind(), error.to_string()),
            (None, "invalid digit found in string".to_owned())
        );
    }
}
