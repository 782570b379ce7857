//! The error type of all calls to the host, and of the methods of a lambda.

use std::fmt;

use crate::world::gleaner::lambda::inference::InferenceError;
use crate::world::gleaner::lambda::scratch::ScratchError;
use crate::world::gleaner::lambda::trigger::TriggerError;
use crate::world::gleaner::lambda::types::DataError;

/// An error message. If a handler returns it, the wake is a fault. If the first `init` returns it,
/// the lambda does not start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Error {
    kind: Option<ErrorKind>,
    message: String,
}

/// Result of the calls to the host and of the methods of a lambda.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// Creates an error with this message.
    pub fn new(message: impl Into<String>) -> Self {
        Self { kind: None, message: message.into() }
    }

    /// Returns the reason for which the host refused a call; none for other errors.
    pub fn kind(&self) -> Option<ErrorKind> {
        self.kind
    }

    /// Returns whether the host refused a call for this reason, such as
    /// [`ScratchErrorKind::NoSuchEntry`].
    pub fn is(&self, kind: impl Into<ErrorKind>) -> bool {
        self.kind == Some(kind.into())
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

/// An error of the bindings, which has a message in each case.
pub(crate) trait HostError {
    fn into_parts(self) -> (ErrorKind, String);
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

/// Generates the kinds of an area: the cases of its error in the WIT, without their messages.
macro_rules! error_kinds {
    ($($area:ident: $kind:ident of $error:ident { $($case:ident),+ })+) => {
        /// The reason for which the host refused a call, by the area of the call.
        ///
        /// It prints as the name of the case in the WIT, such as `no-room`.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[non_exhaustive]
        pub enum ErrorKind {
            $(#[doc = concat!("A refusal with a [`", stringify!($error), "`].")] $area($kind),)+
        }

        impl ErrorKind {
            fn case(self) -> &'static str {
                match self { $($(Self::$area($kind::$case) => stringify!($case),)+)+ }
            }
        }

        $(
            #[doc = concat!("Case of a [`", stringify!($error), "`], which describes each.")]
            #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
            #[non_exhaustive]
            #[allow(missing_docs)]
            pub enum $kind { $($case),+ }

            impl From<$kind> for ErrorKind {
                fn from(kind: $kind) -> Self {
                    Self::$area(kind)
                }
            }

            impl HostError for $error {
                fn into_parts(self) -> (ErrorKind, String) {
                    // The bindings are generated from the WIT, so a new case does not compile here.
                    match self { $(Self::$case(message) => ($kind::$case.into(), message)),+ }
                }
            }
        )+
    };
}

error_kinds! {
    Data: DataErrorKind of DataError {
        NoSuchInput, NoSuchField, WrongField, Malformed, NotAFrame, NoRoom, OutOfRange
    }
    Trigger: TriggerErrorKind of TriggerError { Invalid, TooMany }
    Scratch: ScratchErrorKind of ScratchError { NoRoom, NoSuchEntry, WrongName }
    Inference: InferenceErrorKind of InferenceError {
        Unavailable, NoSuchModel, WrongInput, TooSlow, Failed
    }
}

impl fmt::Display for ErrorKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.case().char_indices().try_for_each(|(at, letter)| {
            let dash = if at > 0 && letter.is_ascii_uppercase() { "-" } else { "" };
            write!(f, "{dash}{}", letter.to_ascii_lowercase())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_error_keeps_its_kind_and_message() {
        let refused = DataError::NotAFrame("it is a text".to_owned());
        let error = into_result::<()>(Err(refused)).unwrap_err();
        assert!(error.is(DataErrorKind::NotAFrame) && !error.is(ScratchErrorKind::NoRoom));
        assert_eq!(error.kind().unwrap().to_string(), "not-a-frame");
        assert_eq!(error.to_string(), "it is a text");
    }

    #[test]
    fn any_rust_error_is_converted() {
        let parse = || -> Result<i32> { Ok("x".parse::<i32>()?) };
        let error = parse().unwrap_err();
        assert_eq!((error.kind(), &*error.to_string()), (None, "invalid digit found in string"));
    }
}
