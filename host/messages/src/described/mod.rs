//! What a node says of a message type: the service
//! `type_description_interfaces/srv/GetTypeDescription`, read from CDR.
//!
//! An answer has the fields of the type and of all it refers to, and often the texts that they were
//! made from. The type's hash, which came by another way, is that of the fields; so the fields are
//! believed if they have this hash, and the texts if they say the same as the fields. Nothing more
//! is believed: all goes through the parser of every definition.
//!
//! What never happens here: an allocation larger than the answer asks bytes for; a name taken for
//! one that is none.
//!
//! Sources: REP 2016 and the `.msg` and `.srv` files of `type_description_interfaces`; the hash is
//! SHA-256 of the fields as JSON, spelled as `rcl_calculate_type_hash` does.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::sync::Arc;

use gleaner_base::chain;
use sha2::{Digest, Sha256};

use super::cdr::{CdrError, Cursor, Endian};
use super::definitions::{Definitions, full_name, short_name};
use super::encode::CdrWriter;
use super::sources::{SourcesError, gather, is_name};

/// How hashes of the first, and so far only, version begin.
const VERSION: &str = "RIHS01_";
/// The encoding of texts that are `.msg` files.
const MSG: &str = "msg";

/// By which rmw_cyclonedds tells whose question an answer belongs to, in front of both.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Header(pub [u64; 2]);

/// Definitions as a node described them.
#[derive(Debug)]
pub struct Described {
    /// The text of the type and of all it refers to, as [`Definitions::parse`] reads it.
    pub text: Arc<str>,
    /// Why the texts that came along are not those, if they are not.
    pub without_texts: Option<String>,
}

/// Why an answer is of no use.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum DescribedError {
    #[error("the answer cannot be read: {0}")]
    Cdr(#[from] CdrError),
    #[error("it answers that it cannot: {0:?}")]
    Refused(String),
    #[error("it describes `{found}` instead")]
    Another { found: String },
    #[error("it describes a type of hash {found}, the writer announced {announced}")]
    Hash { found: String, announced: String },
    #[error("a name in it is none: {0:?}")]
    Name(String),
    #[error("field `{field}` is of kind {kind}, which no `.msg` file can say")]
    Kind { field: String, kind: u8 },
    #[error("what it describes cannot be used")]
    Definition(#[from] SourcesError),
}

/// Asks for `type_name` of `hash`, with its texts; in front of it `header`, where there is one.
pub fn question(type_name: &str, hash: &str, header: Option<Header>) -> Vec<u8> {
    let mut cdr = CdrWriter::new();
    cdr.string(&full_name(&short_name(type_name))).string(hash).u8(1);
    let header = header.map_or(Vec::new(), |Header(words)| {
        words.iter().flat_map(|word| word.to_le_bytes()).collect()
    });
    // 16 bytes: what follows stays aligned.
    [header, cdr.bytes().to_vec()].concat()
}

impl Header {
    /// The header of an answer, and what follows it. `None` if it is too short for one.
    pub fn split(cdr: &[u8], endian: Endian) -> Option<(Self, &[u8])> {
        let mut cursor = Cursor::new(cdr, endian);
        let header = Self([cursor.u64().ok()?, cursor.u64().ok()?]);
        Some((header, cdr.get(16..)?))
    }
}

impl Described {
    /// Definitions of `type_name` out of an answer, which has no header any more. `announced` is
    /// the hash that it has to have.
    pub fn read(
        type_name: &str,
        announced: &str,
        cdr: &[u8],
        endian: Endian,
    ) -> Result<Self, DescribedError> {
        let answer = Answer::read(&mut Cursor::new(cdr, endian))?;
        let root = short_name(type_name);
        let found = short_name(answer.types[0].name);
        if found != root {
            return Err(DescribedError::Another { found: cut(&found) });
        }
        let found = hash(&answer.types)?;
        if found != announced {
            return Err(DescribedError::Hash { found, announced: cut(announced) });
        }
        let from_fields = from_fields(&root, &answer.types)?;
        Ok(match from_texts(&root, &answer, &from_fields) {
            Ok(text) => Self { text, without_texts: None },
            Err(why) => Self { text: from_fields, without_texts: Some(why) },
        })
    }
}

/// What a successful answer says, as it came.
struct Answer<'a> {
    /// The type that was asked for, then those it refers to.
    types: Vec<Type<'a>>,
    /// `pkg/Type`, encoding and text.
    texts: Vec<(String, &'a str, &'a str)>,
}

struct Type<'a> {
    name: &'a str,
    fields: Vec<Field<'a>>,
}

struct Field<'a> {
    name: &'a str,
    kind: u8,
    capacity: u64,
    text_capacity: u64,
    nested: &'a str,
}

impl<'a> Answer<'a> {
    fn read(cdr: &mut Cursor<'a>) -> Result<Self, DescribedError> {
        let successful = cdr.u8()? != 0;
        let why = cdr.text()?;
        if !successful {
            return Err(DescribedError::Refused(cut(why)));
        }
        let mut types = vec![Type::read(cdr)?];
        // A name of no characters and a count.
        for _ in 0..cdr.count(8)? {
            types.push(Type::read(cdr)?);
        }
        let mut texts = Vec::new();
        for _ in 0..cdr.count(12)? {
            texts.push((short_name(cdr.text()?), cdr.text()?, cdr.text()?));
        }
        Ok(Self { types, texts })
    }
}

impl<'a> Type<'a> {
    fn read(cdr: &mut Cursor<'a>) -> Result<Self, CdrError> {
        let name = cdr.text()?;
        let mut fields = Vec::new();
        // Three strings of no characters and 17 bytes of numbers.
        for _ in 0..cdr.count(29)? {
            let field = Field {
                name: cdr.text()?,
                kind: cdr.u8()?,
                capacity: cdr.u64()?,
                text_capacity: cdr.u64()?,
                nested: cdr.text()?,
            };
            // Its default, which is not in the messages.
            cdr.skip_text()?;
            fields.push(field);
        }
        Ok(Self { name, fields })
    }
}

/// The hash of types, whose names all are names: so nothing in the JSON has to be escaped.
fn hash(types: &[Type<'_>]) -> Result<String, DescribedError> {
    let one = |one: &Type<'_>| -> Result<String, DescribedError> {
        let name = a_type(one.name)?;
        let fields = one.fields.iter().map(|field| {
            let nested = if field.nested.is_empty() { "" } else { a_type(field.nested)? };
            Ok(format!(
                "{{\"name\": \"{}\", \"type\": {{\"type_id\": {}, \"capacity\": {}, \"string_capacity\": {}, \
                 \"nested_type_name\": \"{nested}\"}}}}",
                a_word(field.name)?,
                field.kind,
                field.capacity,
                field.text_capacity,
            ))
        });
        let fields: Vec<String> = fields.collect::<Result<_, DescribedError>>()?;
        Ok(format!("{{\"type_name\": \"{name}\", \"fields\": [{}]}}", fields.join(", ")))
    };
    let types: Vec<String> = types.iter().map(one).collect::<Result<_, DescribedError>>()?;
    let json = format!(
        "{{\"type_description\": {}, \"referenced_type_descriptions\": [{}]}}",
        types[0],
        types[1..].join(", ")
    );
    let digest = Sha256::digest(json);
    Ok(digest.iter().fold(VERSION.to_owned(), |mut hash, byte| {
        let _ = write!(hash, "{byte:02x}");
        hash
    }))
}

/// What `.msg` files with these fields would say.
fn from_fields(root: &str, types: &[Type<'_>]) -> Result<Arc<str>, DescribedError> {
    let mut texts = HashMap::new();
    for one in types {
        let mut text = String::new();
        for field in &one.fields {
            let _ = writeln!(text, "{} {}", in_msg(field)?, field.name);
        }
        texts.insert(short_name(one.name), text);
    }
    gathered(root, &texts)
}

/// The texts that came along, if they are there and say what `fields` says.
fn from_texts(root: &str, answer: &Answer<'_>, fields: &str) -> Result<Arc<str>, String> {
    let texts = answer.texts.iter().filter(|(_, encoding, _)| *encoding == MSG);
    let texts: HashMap<String, String> =
        texts.map(|(name, _, text)| (name.clone(), (*text).to_owned())).collect();
    if !texts.contains_key(root) {
        return Err("it sent no `.msg` text".to_owned());
    }
    let text = gathered(root, &texts)
        .map_err(|error| format!("the text that it sent cannot be used: {}", chain(&error)))?;
    let parse = |text: &str| Definitions::parse(root, text).map_err(|error| error.to_string());
    if !parse(&text)?.says_as(&parse(fields)?) {
        return Err("the text that it sent says something else than the description".to_owned());
    }
    Ok(text)
}

fn gathered(root: &str, texts: &HashMap<String, String>) -> Result<Arc<str>, DescribedError> {
    let missing = || SourcesError::Missing { type_name: root.to_owned(), missing: root.to_owned() };
    Ok(gather(root, &|name| Ok(texts.get(name).cloned()))?.ok_or_else(missing)?)
}

/// A field's type as a `.msg` file says it. The numbers are those of
/// `type_description_interfaces/msg/FieldType`.
fn in_msg(field: &Field<'_>) -> Result<String, DescribedError> {
    let unknown = || DescribedError::Kind { field: cut(field.name), kind: field.kind };
    let base = match field.kind % 48 {
        1 => short_name(a_type(field.nested)?),
        21 => format!("string<={}", field.text_capacity),
        22 => format!("wstring<={}", field.text_capacity),
        kind => {
            const NAMES: [&str; 10] = [
                "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64",
                "float32", "float64",
            ];
            let name = match kind {
                2..=11 => NAMES[usize::from(kind) - 2],
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

fn a_type(name: &str) -> Result<&str, DescribedError> {
    is_name(&short_name(name)).then_some(name).ok_or_else(|| DescribedError::Name(cut(name)))
}

fn a_word(name: &str) -> Result<&str, DescribedError> {
    let is_word =
        !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    is_word.then_some(name).ok_or_else(|| DescribedError::Name(cut(name)))
}

/// Enough of a foreign text to know it by.
fn cut(text: &str) -> String {
    text.chars().take(160).collect()
}

#[cfg(test)]
mod tests;
