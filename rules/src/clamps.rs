//! Limits of one call of a lambda: the size of results and of field paths.

use std::fmt;
use std::ops::Range;

use crate::text::cut;

pub const SAMPLES_PER_CALL: usize = 256;
pub const TEXTS_PER_FIELD: usize = 4096;
pub const PATH_BYTES: usize = 1024;

/// The limits `call_bytes` and `call_items` of one call, from `[limits]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PerCall {
    /// Maximum number of bytes.
    pub bytes: usize,
    /// Maximum number of values of a column or list.
    pub items: usize,
}

/// Length of a value, by its kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Length {
    /// A number or a boolean.
    One,
    /// Text, in bytes.
    Text(usize),
    Bytes(usize),
    Numbers(usize),
    Texts(usize),
}

impl PerCall {
    /// Returns the maximum number of samples that one call returns.
    pub fn samples(self) -> usize {
        self.items.min(SAMPLES_PER_CALL)
    }

    /// Refuses a value that is too long for one call. Values are never cut.
    ///
    /// # Errors
    ///
    /// [`WrongField`], with the length.
    pub fn value(self, path: &str, length: Length) -> Result<(), WrongField> {
        let (len, most) = match length {
            Length::One => return Ok(()),
            Length::Text(bytes) | Length::Bytes(bytes) => (bytes, self.bytes),
            Length::Numbers(numbers) => (numbers, self.items),
            Length::Texts(texts) => (texts, self.items.min(TEXTS_PER_FIELD)),
        };
        if len <= most {
            return Ok(());
        }
        Err(WrongField::new(
            path,
            format!("has {len} items; one call returns at most {most}: read it with `cdr`"),
        ))
    }

    /// Returns the range of `len` bytes from `offset`, clamped to a length of `whole` and to the
    /// limit of one call.
    pub fn piece(self, whole: usize, offset: u64, len: u32) -> Range<usize> {
        piece(whole, offset, self.bytes.min(len as usize))
    }
}

/// Returns the range of `len` bytes from `offset`, clamped to a length of `whole`.
pub fn piece(whole: usize, offset: u64, len: usize) -> Range<usize> {
    let from = usize::try_from(offset).unwrap_or(usize::MAX).min(whole);
    from..from + len.min(whole - from)
}

/// A field that is not a number, is too long, or belongs to another input.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrongField {
    /// The path, or the start of a long one.
    pub path: String,
    /// The reason, which follows the path in the message.
    pub why: String,
}

impl WrongField {
    /// Creates the error; `why` follows the path in the message.
    pub fn new(path: &str, why: impl Into<String>) -> Self {
        Self { path: path.to_owned(), why: why.into() }
    }

    /// Returns the error for a field of `type_name` that is read as a number and is not one.
    pub fn no_number(path: &str, type_name: &str) -> Self {
        Self::new(path, format!("of `{type_name}` is not a number; `get` reads it"))
    }

    /// Returns the error for a field of the input `belongs`, used on the input `used`.
    pub fn elsewhere(path: &str, belongs: &str, used: &str) -> Self {
        Self::new(path, format!("belongs to input `{belongs}`, not to `{used}`"))
    }
}

impl fmt::Display for WrongField {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "field `{}` {}", self.path, self.why)
    }
}

impl std::error::Error for WrongField {}

/// Refuses a path that is too long, before it is parsed.
///
/// # Errors
///
/// [`WrongField`], with the length.
pub fn path(path: &str) -> Result<(), WrongField> {
    let len = path.len();
    if len <= PATH_BYTES {
        return Ok(());
    }
    Err(WrongField::new(cut(path, 64), format!("has {len} bytes; a path has at most {PATH_BYTES}")))
}
