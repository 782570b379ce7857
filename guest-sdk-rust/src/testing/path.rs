//! Paths of fields, such as `a.b[3].c`, and what they find in messages of a test.

use std::collections::BTreeMap;

use gleaner_rules::path::{Malformed, Segment, segments};
use gleaner_rules::text::quoted;

use super::error::nearest;
use super::types::Value;

/// A path of the right form. Which fields there are, only messages say.
pub(super) struct Path {
    pub(super) text: String,
    /// Of `a.b[3]`: `a.b`, and 3.
    element: Option<(String, usize)>,
}

/// What stands at a path.
pub(super) enum Found<'a> {
    Whole(&'a Value),
    /// One element of an array.
    Element(Value),
}

/// Why nothing does.
pub(super) enum Missing {
    /// The message has no such field; the names of those it has.
    Field(String),
    /// Its array is too short.
    Element(String),
}

impl Path {
    /// The message says where `text` goes wrong.
    pub(super) fn new(text: &str) -> Result<Self, Malformed> {
        let element = match segments(text)?.last() {
            Some(Segment::Index(index)) => {
                text.rsplit_once('[').map(|(array, _)| (array.to_owned(), *index))
            }
            _ => None,
        };
        Ok(Self { text: text.to_owned(), element })
    }

    pub(super) fn find<'a>(
        &self,
        fields: &'a BTreeMap<String, Value>,
    ) -> Result<Found<'a>, Missing> {
        if let Some(value) = fields.get(&self.text) {
            return Ok(Found::Whole(value));
        }
        let array =
            self.element.as_ref().and_then(|(array, index)| Some((fields.get(array)?, *index)));
        let Some((array, index)) = array else {
            return Err(Missing::Field(known(&self.text, fields)));
        };
        let (len, element) = match array {
            Value::Numbers(numbers) => {
                (numbers.len(), numbers.get(index).copied().map(Value::Real))
            }
            Value::Bytes(bytes) => {
                (bytes.len(), bytes.get(index).map(|byte| Value::Unsigned((*byte).into())))
            }
            Value::Texts(texts) => (texts.len(), texts.get(index).cloned().map(Value::Text)),
            _ => return Err(Missing::Field(known(&self.text, fields))),
        };
        let why = || {
            Missing::Element(format!(
                "it has {len} elements where `{}` wants element {index}",
                self.text
            ))
        };
        element.map(Found::Element).ok_or_else(why)
    }
}

impl Found<'_> {
    pub(super) fn value(&self) -> &Value {
        match self {
            Self::Whole(value) => value,
            Self::Element(value) => value,
        }
    }

    /// As a 64-bit float, if it is a number; true is 1.
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

/// What would have been right, for the end of a message.
pub(super) fn known(path: &str, fields: &BTreeMap<String, Value>) -> String {
    let near = nearest(path, fields.keys().map(String::as_str));
    let hint = near.map_or(String::new(), |near| format!("; did you mean `{near}`?"));
    format!("{hint}; it has {}", quoted(fields.keys().map(String::as_str)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_element_is_found_in_its_array_unless_it_is_given_itself() {
        let fields = BTreeMap::from([
            ("cov".to_owned(), Value::Numbers(vec![1.0, 2.0])),
            ("cov[1]".to_owned(), Value::Real(9.0)),
            ("raw".to_owned(), Value::Bytes(vec![7])),
        ]);
        let number = |path: &str| {
            Path::new(path).unwrap().find(&fields).ok().and_then(|found| found.number())
        };
        assert_eq!(
            [number("cov[0]"), number("cov[1]"), number("raw[0]")],
            [Some(1.0), Some(9.0), Some(7.0)]
        );
        let missing = |path: &str| match Path::new(path).unwrap().find(&fields) {
            Err(Missing::Field(why)) => why,
            Err(Missing::Element(why)) => why,
            Ok(_) => panic!("{path} was found"),
        };
        assert_eq!(missing("cov[2]"), "it has 2 elements where `cov[2]` wants element 2");
        assert_eq!(missing("cob"), "; did you mean `cov`?; it has `cov`, `cov[1]`, `raw`");
    }
}
