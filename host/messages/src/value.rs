//! Values that field paths read.

use std::fmt;

/// The kind of value that a field path leads to, known before any message is read.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum ValueKind {
    /// `bool`.
    Bool,
    /// `int8` to `int64`.
    Signed,
    /// `uint8` to `uint64`, `byte`, `char`.
    Unsigned,
    /// `float32`, `float64`.
    Real,
    /// `string`.
    Text,
    /// An array or sequence of `uint8`, `byte` or `char`.
    Bytes,
    /// An array or sequence of any other primitive.
    Numbers,
    /// An array or sequence of `string`.
    Texts,
}

impl ValueKind {
    /// Returns whether a caller may treat both kinds alike.
    pub(super) fn is_like(self, other: Self) -> bool {
        self == other || (self.is_number() && other.is_number())
    }

    /// Returns whether [`super::FieldPath::number`] can read it.
    pub fn is_number(self) -> bool {
        matches!(self, Self::Bool | Self::Signed | Self::Unsigned | Self::Real)
    }
}

impl fmt::Display for ValueKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bool => "a boolean",
            Self::Signed | Self::Unsigned => "an integer",
            Self::Real => "a floating-point number",
            Self::Text => "a string",
            Self::Bytes => "an array of bytes",
            Self::Numbers => "an array of numbers",
            Self::Texts => "an array of strings",
        })
    }
}

/// A field's value, borrowed from the message where possible.
#[derive(Clone, Debug, PartialEq)]
pub enum MessageValue<'a> {
    /// A boolean; any byte but 0 is true.
    Bool(bool),
    Signed(i64),
    Unsigned(u64),
    /// A floating-point number; `float32` is widened, which is exact.
    Real(f64),
    Text(&'a str),
    Bytes(&'a [u8]),
    /// Numbers as `f64`. 64-bit integers beyond 2^53 are rounded; booleans are 0 and 1.
    Numbers(Vec<f64>),
    Texts(Vec<&'a str>),
}
