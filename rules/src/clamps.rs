//! How much one call of a lambda hands out, and which paths it may ask with.

use std::fmt;
use std::ops::Range;

use crate::text::cut;

/// Most samples that one call hands out.
pub const SAMPLES_PER_CALL: usize = 256;
/// Longest list of strings in one field.
pub const TEXTS_PER_FIELD: usize = 4096;
/// Longest path of a field, in bytes.
pub const PATH_BYTES: usize = 1024;

/// What `[limits]` let one call hand out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PerCall {
    /// Bytes that it copies out.
    pub bytes: usize,
    /// Values of a column or of a list.
    pub items: usize,
}

/// How long a value is, by its sort.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Length {
    /// A number or a truth value.
    One,
    /// Bytes of a text.
    Text(usize),
    /// Bytes.
    Bytes(usize),
    /// Numbers.
    Numbers(usize),
    /// Texts.
    Texts(usize),
}

impl PerCall {
    /// Samples that one call hands out at most.
    pub fn samples(self) -> usize {
        self.items.min(SAMPLES_PER_CALL)
    }

    /// Refuses a value that is longer than one call hands out: it is never cut.
    ///
    /// # Errors
    ///
    /// [`WrongField`] says how long it is.
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
            format!("has {len} items, one call hands out {most}; read it with `cdr`"),
        ))
    }

    /// The place of `len` bytes from `offset` in a `whole` of so many, clamped to what it has and
    /// to what one call hands out.
    pub fn piece(self, whole: usize, offset: u64, len: u32) -> Range<usize> {
        piece(whole, offset, self.bytes.min(len as usize))
    }
}

/// The place of `len` bytes from `offset` in a `whole` of so many, clamped to what it has.
pub fn piece(whole: usize, offset: u64, len: usize) -> Range<usize> {
    let from = usize::try_from(offset).unwrap_or(usize::MAX).min(whole);
    from..from + len.min(whole - from)
}

/// A field that is no number, is too long, or belongs to another input.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrongField {
    /// The path, or the start of a long one.
    pub path: String,
    /// What is wrong with it.
    pub why: String,
}

impl WrongField {
    /// `why` goes on behind the path.
    pub fn new(path: &str, why: impl Into<String>) -> Self {
        Self { path: path.to_owned(), why: why.into() }
    }

    /// A field of `type_name` that is read as a number and is none.
    pub fn no_number(path: &str, type_name: &str) -> Self {
        Self::new(path, format!("of `{type_name}` is no number"))
    }

    /// A field of the input `belongs` that `asked` was asked for.
    pub fn elsewhere(path: &str, belongs: &str, asked: &str) -> Self {
        Self::new(path, format!("belongs to input `{belongs}`, not to `{asked}`"))
    }
}

impl fmt::Display for WrongField {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "field `{}` {}", self.path, self.why)
    }
}

impl std::error::Error for WrongField {}

/// Refuses a path that is too long, before anything looks at it.
///
/// # Errors
///
/// [`WrongField`] says how long it is.
pub fn path(path: &str) -> Result<(), WrongField> {
    let len = path.len();
    if len <= PATH_BYTES {
        return Ok(());
    }
    Err(WrongField::new(cut(path, 64), format!("has {len} bytes; a path has {PATH_BYTES} at most")))
}
