//! Parses paths of fields, such as `a.b[3].c`. Only the syntax is checked, not whether a field
//! exists.

use std::fmt;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathSegment<'p> {
    /// A field of a message.
    Name(&'p str),
    /// An element of an array.
    Index(usize),
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MalformedPath {
    pub path: String,
    /// The invalid rest of it.
    pub rest: String,
}

impl fmt::Display for MalformedPath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "path `{}` is malformed at `{}`; write it like `a.b[3].c`", self.path, self.rest)
    }
}

impl std::error::Error for MalformedPath {}

/// Returns the steps of `path`, at least one. The first one is a name, and so is each one after a
/// dot.
///
/// # Errors
///
/// [`MalformedPath`], with the invalid rest.
pub fn segments(path: &str) -> Result<Vec<PathSegment<'_>>, MalformedPath> {
    let malformed = |rest: &str| MalformedPath { path: path.to_owned(), rest: rest.to_owned() };
    let mut segments = Vec::new();
    let mut rest = path;
    loop {
        let is_part = |c: char| c.is_ascii_alphanumeric() || c == '_';
        let end = rest.find(|c| !is_part(c)).unwrap_or(rest.len());
        let (name, mut tail) = rest.split_at(end);
        if name.is_empty() {
            return Err(malformed(rest));
        }
        segments.push(PathSegment::Name(name));
        while let Some(inside) = tail.strip_prefix('[') {
            let (digits, behind) = inside.split_once(']').ok_or_else(|| malformed(tail))?;
            let is_number = digits.bytes().all(|byte| byte.is_ascii_digit());
            let index = digits.parse().ok().filter(|_| is_number);
            segments.push(PathSegment::Index(index.ok_or_else(|| malformed(tail))?));
            tail = behind;
        }
        if tail.is_empty() {
            return Ok(segments);
        }
        rest = tail.strip_prefix('.').ok_or_else(|| malformed(tail))?;
    }
}
