//! Parses the ros2msg text format: lines become fields, with unresolved type names.
//!
//! Constants and default values are recognised and skipped: they are not in the bytes. Source: ROS
//! 2 interface definition (design.ros2.org, article 110); the separator between parts is that of
//! MCAP's `ros2msg` schema encoding.

use super::definitions::MessageError;

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Primitive {
    Bool,
    /// `uint8`, `byte` and `char`, which are the same on the wire.
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl Primitive {
    /// Returns the size on the wire in bytes, which is also the alignment.
    pub(super) fn size(self) -> usize {
        match self {
            Self::Bool | Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }
}

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Count {
    One,
    Fixed(usize),
    /// Bounded or not: the bound is not on the wire.
    Sequence,
}

/// The type of one element of a field. `S` is the form of a reference to a message type.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Element<S> {
    Primitive(Primitive),
    Text,
    WideText,
    Struct(S),
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct FieldDefinition<S> {
    pub(super) name: String,
    pub(super) element: Element<S>,
    pub(super) count: Count,
}

/// One `MSG:` part, or the root, of a definition text.
pub(super) struct DefinitionPart<'t> {
    /// The name after `MSG:`; `None` for the root.
    pub(super) name: Option<&'t str>,
    pub(super) fields: Vec<FieldDefinition<String>>,
}

/// Longest array of fixed length, so that sizes stay far from overflow.
const MAX_FIXED: usize = 1 << 28;

/// Splits a definition text into its parts and parses the fields of each.
pub(super) fn parts(text: &str) -> Result<Vec<DefinitionPart<'_>>, MessageError> {
    let text = text.trim_start_matches('\u{feff}');
    let mut parts = vec![DefinitionPart { name: None, fields: Vec::new() }];
    // A separator begins a part; the following line `MSG: pkg/Type` names it.
    let mut awaits_name = false;
    for (index, raw) in text.lines().enumerate() {
        let line = raw.trim();
        if line.len() >= 3 && line.bytes().all(|byte| byte == b'=') {
            awaits_name = true;
            continue;
        }
        if awaits_name {
            if line.is_empty() {
                continue;
            }
            let name = line.strip_prefix("MSG:").map(str::trim);
            let name =
                name.ok_or_else(|| syntax(index, line, "`MSG: pkg/Type` after a separator"))?;
            parts.push(DefinitionPart { name: Some(name), fields: Vec::new() });
            awaits_name = false;
            continue;
        }
        let Some(part) = parts.last_mut() else { continue };
        if let Some(field) = field(index, line)? {
            part.fields.push(field);
        }
    }
    Ok(parts)
}

/// Parses the field that a line declares; `None` for blank lines, comments and constants.
fn field(index: usize, line: &str) -> Result<Option<FieldDefinition<String>>, MessageError> {
    // A `#` inside a quoted default also cuts here: it cuts a value, which is not needed.
    let code = line.split('#').next().unwrap_or_default().trim();
    if code.is_empty() {
        return Ok(None);
    }
    let (ty, rest) = code
        .split_once(char::is_whitespace)
        .ok_or_else(|| syntax(index, line, "a type and a name"))?;
    let rest = rest.trim_start();
    let end = rest.find(|c: char| c.is_whitespace() || c == '=').unwrap_or(rest.len());
    let (name, value) = rest.split_at(end);
    let is_name = name.starts_with(|c: char| c.is_ascii_alphabetic())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    if !is_name {
        return Err(syntax(index, line, "a name of letters, digits and `_`"));
    }
    if value.trim_start().starts_with('=') {
        return Ok(None);
    }
    let (element, count) =
        field_type(ty).ok_or_else(|| syntax(index, line, "a known type form"))?;
    Ok(Some(FieldDefinition { name: name.to_owned(), element, count }))
}

fn field_type(ty: &str) -> Option<(Element<String>, Count)> {
    let (base, count) = match ty.split_once('[') {
        None => (ty, Count::One),
        Some((base, size)) => {
            let size = size.strip_suffix(']')?;
            let count = match size.strip_prefix("<=") {
                Some(bound) => bound.parse::<usize>().ok().map(|_| Count::Sequence)?,
                None if size.is_empty() => Count::Sequence,
                None => {
                    let n = size.parse().ok().filter(|n| (1..=MAX_FIXED).contains(n))?;
                    Count::Fixed(n)
                }
            };
            (base, count)
        }
    };
    Some((element(base)?, count))
}

fn element(base: &str) -> Option<Element<String>> {
    let text = |prefix: &str| {
        let bound = base.strip_prefix(prefix)?;
        let bound = bound.strip_prefix("<=").map(|bound| bound.parse::<usize>().is_ok());
        (base == prefix || bound == Some(true)).then_some(())
    };
    let primitive = match base {
        "bool" => Primitive::Bool,
        "uint8" | "byte" | "char" => Primitive::U8,
        "int8" => Primitive::I8,
        "uint16" => Primitive::U16,
        "int16" => Primitive::I16,
        "uint32" => Primitive::U32,
        "int32" => Primitive::I32,
        "uint64" => Primitive::U64,
        "int64" => Primitive::I64,
        "float32" => Primitive::F32,
        "float64" => Primitive::F64,
        _ if text("string").is_some() => return Some(Element::Text),
        _ if text("wstring").is_some() => return Some(Element::WideText),
        _ => {
            let is_type = base.starts_with(|c: char| c.is_ascii_alphabetic())
                && base.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'/'));
            return is_type.then(|| Element::Struct(base.to_owned()));
        }
    };
    Some(Element::Primitive(primitive))
}

fn syntax(index: usize, line: &str, wanted: &'static str) -> MessageError {
    // The line is untrusted and may be huge.
    MessageError::Syntax { line: index + 1, text: line.chars().take(80).collect(), wanted }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(line: &str) -> Option<(Element<String>, Count)> {
        field(0, line).unwrap().map(|field| (field.element, field.count))
    }

    #[test]
    fn every_type_form_is_parsed() {
        use Primitive::{F64, U8};
        assert_eq!(one("float64 x"), Some((Element::Primitive(F64), Count::One)));
        assert_eq!(one("byte[] data"), Some((Element::Primitive(U8), Count::Sequence)));
        assert_eq!(one("float64[9] k"), Some((Element::Primitive(F64), Count::Fixed(9))));
        assert_eq!(one("char[<=5] c"), Some((Element::Primitive(U8), Count::Sequence)));
        assert_eq!(one("string<=10[<=3] s"), Some((Element::Text, Count::Sequence)));
        assert_eq!(one("wstring<=4 w"), Some((Element::WideText, Count::One)));
        let point = Element::Struct("geometry_msgs/Point".to_owned());
        assert_eq!(one("geometry_msgs/Point[] p"), Some((point, Count::Sequence)));
    }

    #[test]
    fn constants_are_skipped_and_defaults_ignored() {
        for constant in ["int32 A=1", "int32 A = 0x10", "string S=\"a # b\"", "bool B=1"] {
            assert_eq!(one(constant), None, "{constant}");
        }
        assert!(one("int32 a 5 # five").is_some());
        assert!(one("string s \"a=b\"").is_some());
        assert!(one("string s \"").is_some());
        assert!(one("uint8[3] rgb [1, 2, 3]").is_some());
    }

    #[test]
    fn malformed_lines_name_their_line() {
        for line in
            ["int32", "int32[ x", "int32[0] x", "int32[-1] x", "i!t x", "int32 9x", "string<=x s"]
        {
            assert!(matches!(field(6, line), Err(MessageError::Syntax { line: 7, .. })), "{line}");
        }
    }
}
