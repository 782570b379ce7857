//! Parses a node's description of a message type: the service
//! `type_description_interfaces/srv/GetTypeDescription`, read from CDR.
//!
//! A response contains the fields of the type and of all types it refers to, and often the texts
//! that they were generated from. The hash of the type, received in another way, is that of the
//! fields; so the fields are trusted if they have this hash, and the texts if they define the same
//! fields. All of it still goes through the parser of all definitions.
//!
//! Allocations are bounded by the size of the response, and every name is checked.
//!
//! Sources: REP 2016 and the `.msg` and `.srv` files of `type_description_interfaces`.

mod hash;

use std::borrow::Cow;
use std::collections::HashMap;
use std::fmt::Write as _;
use std::sync::Arc;

use gleaner_base::chain;

use super::cdr::{CdrError, Cursor, Endian};
use super::definitions::{Definitions, MessageError, full_name, short_name};
use super::encode::CdrWriter;
use super::sources::{SourcesError, collect_types, is_name};
use hash::hash;
pub use hash::type_hash;

/// The encoding of texts that are `.msg` files.
const MSG: &str = "msg";
/// The types of kinds 2 to 11.
const NUMBERS: [&str; 10] = [
    "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64",
];

/// The prefix by which rmw_cyclonedds matches a response to its request.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct RequestHeader(pub [u64; 2]);

#[derive(Debug)]
pub struct DescribedDefinitions {
    /// The text of the type and all types it refers to, as [`Definitions::parse`] expects it.
    pub text: Arc<str>,
    /// The reason why `text` was generated from the fields, if the texts of the response are not
    /// used.
    pub without_texts: Option<String>,
}

/// Reasons why a response cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TypeDescriptionError {
    #[error("cannot parse the response: {0}")]
    Cdr(#[from] CdrError),
    #[error("the node refuses: {0:?}")]
    Refused(String),
    #[error("it describes `{found}`, not the requested type")]
    Another { found: String },
    #[error("it describes a type with hash {found}, but the writer announced {announced}")]
    Hash { found: String, announced: String },
    #[error("it contains an invalid name: {0:?}")]
    Name(String),
    #[error("field `{field}` has kind {kind}, which no `.msg` file can express")]
    Kind { field: String, kind: u8 },
    #[error("its definition cannot be used")]
    Definition(#[from] SourcesError),
    #[error("the definition cannot be used")]
    Text(#[from] MessageError),
}

/// Encodes a request for `type_name` with `hash`, texts included; preceded by `header`, if given.
pub fn request(type_name: &str, hash: &str, header: Option<RequestHeader>) -> Vec<u8> {
    let mut cdr = CdrWriter::new();
    cdr.string(&full_name(&short_name(type_name))).string(hash).u8(1);
    let header = header.map_or(Vec::new(), |RequestHeader(words)| {
        words.iter().flat_map(|word| word.to_le_bytes()).collect()
    });
    // The header has 16 bytes, so the rest stays aligned.
    [header, cdr.bytes().to_vec()].concat()
}

impl RequestHeader {
    /// Splits a response into its header and the rest. `None` if it is too short.
    pub fn split(cdr: &[u8], endian: Endian) -> Option<(Self, &[u8])> {
        let mut cursor = Cursor::new(cdr, endian);
        let header = Self([cursor.u64().ok()?, cursor.u64().ok()?]);
        Some((header, cdr.get(16..)?))
    }
}

impl DescribedDefinitions {
    /// Parses a response without header, which describes `type_name`. `announced` is the hash that
    /// it must have.
    pub fn read(
        type_name: &str,
        announced: &str,
        cdr: &[u8],
        endian: Endian,
    ) -> Result<Self, TypeDescriptionError> {
        let response = TypeResponse::read(&mut Cursor::new(cdr, endian))?;
        let root = short_name(type_name);
        let found = short_name(&response.types[0].name);
        if found != root {
            return Err(TypeDescriptionError::Another { found: cut(&found) });
        }
        let found = hash(&response.types)?;
        if found != announced {
            return Err(TypeDescriptionError::Hash { found, announced: cut(announced) });
        }
        let from_fields = from_fields(&root, &response.types)?;
        Ok(match from_texts(&root, &response, &from_fields) {
            Ok(text) => Self { text, without_texts: None },
            Err(why) => Self { text: from_fields, without_texts: Some(why) },
        })
    }
}

/// A successful response, parsed but not checked.
struct TypeResponse<'a> {
    /// The requested type, then those it refers to.
    types: Vec<TypeFields<'a>>,
    /// `pkg/Type`, encoding and text.
    texts: Vec<(String, &'a str, &'a str)>,
}

struct TypeFields<'a> {
    name: Cow<'a, str>,
    fields: Vec<TypeField<'a>>,
}

#[derive(Clone)]
struct TypeField<'a> {
    name: &'a str,
    kind: u8,
    capacity: u64,
    text_capacity: u64,
    nested: Cow<'a, str>,
}

impl<'a> TypeResponse<'a> {
    fn read(cdr: &mut Cursor<'a>) -> Result<Self, TypeDescriptionError> {
        let successful = cdr.u8()? != 0;
        let why = cdr.text()?;
        if !successful {
            return Err(TypeDescriptionError::Refused(cut(why)));
        }
        let mut types = vec![TypeFields::read(cdr)?];
        // Minimum size: an empty name and a count.
        for _ in 0..cdr.count(8)? {
            types.push(TypeFields::read(cdr)?);
        }
        let mut texts = Vec::new();
        for _ in 0..cdr.count(12)? {
            texts.push((short_name(cdr.text()?), cdr.text()?, cdr.text()?));
        }
        Ok(Self { types, texts })
    }
}

impl<'a> TypeFields<'a> {
    fn read(cdr: &mut Cursor<'a>) -> Result<Self, CdrError> {
        let name = cdr.text()?.into();
        let mut fields = Vec::new();
        // Minimum size: three empty strings and 17 bytes of numbers.
        for _ in 0..cdr.count(29)? {
            let field = TypeField {
                name: cdr.text()?,
                kind: cdr.u8()?,
                capacity: cdr.u64()?,
                text_capacity: cdr.u64()?,
                nested: cdr.text()?.into(),
            };
            // Skip the default value, which is not in the messages.
            cdr.skip_text()?;
            fields.push(field);
        }
        Ok(Self { name, fields })
    }
}

/// Generates the text of `.msg` files with these fields.
fn from_fields(root: &str, types: &[TypeFields<'_>]) -> Result<Arc<str>, TypeDescriptionError> {
    let mut texts = HashMap::new();
    for one in types {
        let mut text = String::new();
        for field in &one.fields {
            let _ = writeln!(text, "{} {}", in_msg(field)?, field.name);
        }
        texts.insert(short_name(&one.name), text);
    }
    collected(root, &texts)
}

/// Returns the texts of the response, if present and equivalent to `fields`.
fn from_texts(root: &str, response: &TypeResponse<'_>, fields: &str) -> Result<Arc<str>, String> {
    let texts = response.texts.iter().filter(|(_, encoding, _)| *encoding == MSG);
    let texts: HashMap<String, String> =
        texts.map(|(name, _, text)| (name.clone(), (*text).to_owned())).collect();
    if !texts.contains_key(root) {
        return Err("it contains no `.msg` text".to_owned());
    }
    let text = collected(root, &texts)
        .map_err(|error| format!("its text cannot be used: {}", chain(&error)))?;
    let parse = |text: &str| Definitions::parse(root, text).map_err(|error| error.to_string());
    if !parse(&text)?.is_equivalent(&parse(fields)?) {
        return Err("its text differs from its description".to_owned());
    }
    Ok(text)
}

fn collected(
    root: &str,
    texts: &HashMap<String, String>,
) -> Result<Arc<str>, TypeDescriptionError> {
    let missing = || SourcesError::Missing { type_name: root.to_owned(), missing: root.to_owned() };
    Ok(collect_types(root, &|name| Ok(texts.get(name).cloned()))?.ok_or_else(missing)?)
}

/// Returns a field's type in the form of a `.msg` file. The numbers are those of
/// `type_description_interfaces/msg/FieldType`.
fn in_msg(field: &TypeField<'_>) -> Result<String, TypeDescriptionError> {
    let unknown = || TypeDescriptionError::Kind { field: cut(field.name), kind: field.kind };
    let base = match field.kind % 48 {
        1 => short_name(a_type(&field.nested)?),
        21 => format!("string<={}", field.text_capacity),
        22 => format!("wstring<={}", field.text_capacity),
        kind => {
            let name = match kind {
                2..=11 => NUMBERS[usize::from(kind) - 2],
                13 => "char",
                15 => "bool",
                16 => "byte",
                17 => "string",
                18 => "wstring",
                _ => return Err(unknown()),
            };
            name.to_owned()
        }
    };
    Ok(match field.kind / 48 {
        0 => base,
        1 => format!("{base}[{}]", field.capacity),
        2 => format!("{base}[<={}]", field.capacity),
        3 => format!("{base}[]"),
        _ => return Err(unknown()),
    })
}

fn a_type(name: &str) -> Result<&str, TypeDescriptionError> {
    is_name(&short_name(name)).then_some(name).ok_or_else(|| TypeDescriptionError::Name(cut(name)))
}

fn a_word(name: &str) -> Result<&str, TypeDescriptionError> {
    let is_word =
        !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    is_word.then_some(name).ok_or_else(|| TypeDescriptionError::Name(cut(name)))
}

/// Truncates untrusted text for an error message.
fn cut(text: &str) -> String {
    text.chars().take(160).collect()
}

#[cfg(test)]
mod tests;
