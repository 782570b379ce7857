//! Resolves field paths, such as `a.b[3].c`, in the messages of a test.

use std::collections::BTreeMap;

use gleaner_rules::path::{MalformedPath, PathSegment, segments};
use gleaner_rules::text::quoted;

use super::error::nearest;
use crate::data::Value;

/// A path with valid syntax. Only a message shows whether the field exists.
pub(super) struct FieldPath {
    pub(super) text: String,
    /// Array and index if the path ends with an index: for `a.b[3]`, `a.b` and 3.
    element: Option<(String, usize)>,
}

/// The value at a path.
pub(super) enum FieldRef<'a> {
    Whole(&'a Value),
    /// One element of an array.
    Element(Value),
}

/// Reason why there is no value at a path.
pub(super) enum MissingField {
    /// The message has no such field. The text lists its fields.
    Field(String),
    /// The array is too short.
    Element(String),
}

impl FieldPath {
    /// Parses a path. The error names the position of the mistake.
    pub(super) fn new(text: &str) -> Result<Self, MalformedPath> {
        let element = match segments(text)?.last() {
            Some(PathSegment::Index(index)) => {
                text.rsplit_once('[').map(|(array, _)| (array.to_owned(), *index))
            }
            _ => None,
        };
        Ok(Self { text: text.to_owned(), element })
    }

    pub(super) fn find<'a>(
        &self,
        fields: &'a BTreeMap<String, Value>,
    ) -> Result<FieldRef<'a>, MissingField> {
        if let Some(value) = fields.get(&self.text) {
            return Ok(FieldRef::Whole(value));
        }
        let array =
            self.element.as_ref().and_then(|(array, index)| Some((fields.get(array)?, *index)));
        let Some((array, index)) = array else {
            return Err(MissingField::Field(known(&self.text, fields)));
        };
        let (len, element) = match array {
            Value::Numbers(numbers) => {
                (numbers.len(), numbers.get(index).copied().map(Value::Real))
            }
            Value::Bytes(bytes) => {
                (bytes.len(), bytes.get(index).map(|byte| Value::Unsigned((*byte).into())))
            }
            Value::Texts(texts) => (texts.len(), texts.get(index).cloned().map(Value::Text)),
            _ => return Err(MissingField::Field(known(&self.text, fields))),
        };
        let why = || {
            MissingField::Element(format!(
                "it has {len} elements where `{}` wants element {index}",
                self.text
            ))
        };
        element.map(FieldRef::Element).ok_or_else(why)
    }
}

impl FieldRef<'_> {
    pub(super) fn value(&self) -> &Value {
        match self {
            Self::Whole(value) => value,
            Self::Element(value) => value,
        }
    }

    /// Returns the value as a 64-bit float; true is 1. None if it is not a number.
    pub(super) fn number(&self) -> Option<f64> {
        match self.value() {
            Value::Boolean(value) => Some(f64::from(u8::from(*value))),
            Value::Signed(value) => Some(*value as f64),
            Value::Unsigned(value) => Some(*value as f64),
            Value::Real(value) => Some(*value),
            _ => None,
        }
    }
}

/// Returns the end of an error message: the most similar field, and all fields.
pub(super) fn known(path: &str, fields: &BTreeMap<String, Value>) -> String {
    let near = nearest(path, fields.keys().map(String::as_str));
    let hint = near.map_or(String::new(), |near| format!("; did you mean `{near}`?"));
    format!("{hint}; it has {}", quoted(fields.keys().map(String::as_str)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_element_is_found_in_its_array_unless_it_is_set_itself() {
        let fields = BTreeMap::from([
            ("cov".to_owned(), Value::Numbers(vec![1.0, 2.0])),
            ("cov[1]".to_owned(), Value::Real(9.0)),
            ("raw".to_owned(), Value::Bytes(vec![7])),
        ]);
        let number = |path: &str| {
            FieldPath::new(path).unwrap().find(&fields).ok().and_then(|found| found.number())
        };
        assert_eq!(
            [number("cov[0]"), number("cov[1]"), number("raw[0]")],
            [Some(1.0), Some(9.0), Some(7.0)]
        );
        let missing = |path: &str| match FieldPath::new(path).unwrap().find(&fields) {
            Err(MissingField::Field(why)) => why,
            Err(MissingField::Element(why)) => why,
            Ok(_) => panic!("{path} was found"),
        };
        assert_eq!(missing("cov[2]"), "it has 2 elements where `cov[2]` wants element 2");
        assert_eq!(missing("cob"), "; did you mean `cov`?; it has `cov`, `cov[1]`, `raw`");
    }
}
