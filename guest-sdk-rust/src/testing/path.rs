//! Paths of fields, such as `a.b[3].c`, and what they find in messages of a test.

use std::collections::BTreeMap;

use super::error::{nearest, quoted};
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
    pub(super) fn new(text: &str) -> Result<Self, String> {
        if let Some(rest) = malformed_at(text) {
            return Err(format!("path `{text}` is malformed at `{rest}`; write it like `a.b[3].c`"));
        }
        let last = text.strip_suffix(']').and_then(|text| text.rsplit_once('['));
        let element = last.and_then(|(array, index)| Some((array.to_owned(), index.parse().ok()?)));
        Ok(Self { text: text.to_owned(), element })
    }

    pub(super) fn find<'a>(&self, fields: &'a BTreeMap<String, Value>) -> Result<Found<'a>, Missing> {
        if let Some(value) = fields.get(&self.text) {
            return Ok(Found::Whole(value));
        }
        let array = self.element.as_ref().and_then(|(array, index)| Some((fields.get(array)?, *index)));
        let Some((array, index)) = array else { return Err(Missing::Field(known(&self.text, fields))) };
        let (len, element) = match array {
            Value::Numbers(numbers) => (numbers.len(), numbers.get(index).copied().map(Value::Real)),
            Value::Bytes(bytes) => (bytes.len(), bytes.get(index).map(|byte| Value::Unsigned((*byte).into()))),
            Value::Texts(texts) => (texts.len(), texts.get(index).cloned().map(Value::Text)),
            _ => return Err(Missing::Field(known(&self.text, fields))),
        };
        let why = || Missing::Element(format!("it has {len} elements where `{}` wants element {index}", self.text));
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

/// What is left of `text` where it is no path any more.
fn malformed_at(text: &str) -> Option<&str> {
    let mut rest = text;
    loop {
        let name = rest.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(rest.len());
        if name == 0 {
            return Some(rest);
        }
        rest = &rest[name..];
        while let Some(inside) = rest.strip_prefix('[') {
            let digits = inside.find(|c: char| !c.is_ascii_digit()).unwrap_or(inside.len());
            match inside[digits..].strip_prefix(']').filter(|_| digits > 0) {
                Some(after) => rest = after,
                None => return Some(rest),
            }
        }
        if rest.is_empty() {
            return None;
        }
        match rest.strip_prefix('.') {
            Some(after) => rest = after,
            None => return Some(rest),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_of_one_form() {
        for good in ["a", "a.b", "a[0]", "a_1[2][3].b.c[4]"] {
            assert!(Path::new(good).is_ok(), "{good}");
        }
        for (bad, rest) in
            [("", ""), (".a", ".a"), ("a.", ""), ("a[]", "[]"), ("a[1", "[1"), ("a b", " b"), ("a[1]b", "b")]
        {
            let said = Path::new(bad).err().unwrap_or_default();
            assert!(said.contains(&format!("malformed at `{rest}`")), "{bad}: {said}");
        }
    }

    #[test]
    fn an_element_is_found_in_its_array_unless_it_is_given_itself() {
        let fields = BTreeMap::from([
            ("cov".to_owned(), Value::Numbers(vec![1.0, 2.0])),
            ("cov[1]".to_owned(), Value::Real(9.0)),
            ("raw".to_owned(), Value::Bytes(vec![7])),
        ]);
        let number = |path: &str| Path::new(path).unwrap().find(&fields).ok().and_then(|found| found.number());
        assert_eq!([number("cov[0]"), number("cov[1]"), number("raw[0]")], [Some(1.0), Some(9.0), Some(7.0)]);
        let missing = |path: &str| match Path::new(path).unwrap().find(&fields) {
            Err(Missing::Field(why)) => why,
            Err(Missing::Element(why)) => why,
            Ok(_) => panic!("{path} was found"),
        };
        assert_eq!(missing("cov[2]"), "it has 2 elements where `cov[2]` wants element 2");
        assert_eq!(missing("cob"), "; did you mean `cov`?; it has `cov`, `cov[1]`, `raw`");
    }
}
