//! The hash of a type, RIHS01 of REP 2016, from its description or from its text.
//!
//! Names, types and order of all fields count; comments, constants and default values do not.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;

use sha2::{Digest, Sha256};

use super::{NUMBERS, TypeDescriptionError, TypeField, TypeFields, a_type, a_word};
use crate::definitions::{Definitions, full_name, short_name};

/// Prefix of hashes of the first, and so far only, version.
const VERSION: &str = "RIHS01_";

/// Returns the hash of `type_name` (`pkg/msg/Type` or `pkg/Type`), whose definition is `text`, with
/// all types it refers to: the hash that nodes of Iron and newer announce with their writers.
///
/// # Errors
///
/// [`TypeDescriptionError`] if the text is invalid, or the name is not that of a message type.
///
/// Source: REP 2016; `rcl_calculate_type_hash` and `rosidl_adapter`, by which `char` is `uint8`.
pub fn type_hash(type_name: &str, text: &str) -> Result<String, TypeDescriptionError> {
    let root = short_name(type_name);
    // From here on, each line is known to be valid, and no type contains itself.
    Definitions::parse(&root, text)?;
    let mut parts: HashMap<String, Vec<TypeField<'_>>> = HashMap::new();
    for name in ["builtin_interfaces/Time", "builtin_interfaces/Duration"] {
        parts.insert(
            name.to_owned(),
            ["int32 sec", "uint32 nanosec"].map(field).into_iter().flatten().collect(),
        );
    }
    // The part that begins at a line `MSG: pkg/Type`, after the line of `=`.
    let (mut name, mut fields) = (root.clone(), Vec::new());
    let text = text.trim_start_matches('\u{feff}');
    for line in text.lines().map(str::trim).chain(["MSG:"]) {
        if let Some(next) = line.strip_prefix("MSG:") {
            let done = std::mem::replace(&mut name, short_name(next.trim()));
            parts.insert(done, std::mem::take(&mut fields));
        } else {
            fields.extend(field(line));
        }
    }
    let mut found = BTreeMap::new();
    let first = resolved(&root, &parts, &mut found);
    let types: Vec<TypeFields<'_>> = std::iter::once(first).chain(found.into_values()).collect();
    hash(&types)
}

/// Returns a type whose fields have the full names of their types, which go to `found`.
fn resolved<'t>(
    name: &str,
    parts: &HashMap<String, Vec<TypeField<'t>>>,
    found: &mut BTreeMap<String, TypeFields<'t>>,
) -> TypeFields<'t> {
    let mut fields = parts.get(name).cloned().unwrap_or_default();
    // rosidl gives a type without fields this one.
    if fields.is_empty() {
        fields.extend(field("uint8 structure_needs_at_least_one_member"));
    }
    for field in fields.iter_mut().filter(|field| !field.nested.is_empty()) {
        let wanted = short_name(&field.nested);
        let package = name.split_once('/').map_or("", |(package, _)| package);
        // The rule of `Definitions::parse`.
        let own = format!("{package}/{wanted}");
        let full = match wanted.contains('/') {
            true => wanted,
            false if parts.contains_key(&own) => own,
            false => format!("std_msgs/{wanted}"),
        };
        field.nested = full_name(&full).into();
        if !found.contains_key(&full) {
            let nested = resolved(&full, parts, found);
            found.insert(full, nested);
        }
    }
    TypeFields { name: full_name(name).into(), fields }
}

/// Parses a valid line; `None` if it declares no field.
fn field(line: &str) -> Option<TypeField<'_>> {
    let (ty, rest) = line.split('#').next()?.trim().split_once(char::is_whitespace)?;
    let rest = rest.trim_start();
    let (name, value) =
        rest.split_at(rest.find(|c: char| c.is_whitespace() || c == '=').unwrap_or(rest.len()));
    if value.trim_start().starts_with('=') {
        return None;
    }
    let (base, size) = ty.split_once('[').map_or((ty, None), |(base, size)| (base, Some(size)));
    let number = |text: &str| text.trim_end_matches(']').parse().unwrap_or(0);
    let (group, capacity) = match size {
        None => (0, 0),
        Some("]") => (3, 0),
        Some(size) => size.strip_prefix("<=").map_or((1, number(size)), |bound| (2, number(bound))),
    };
    let (base, bound) = base.split_once("<=").map_or((base, None), |(base, n)| (base, Some(n)));
    let listed = NUMBERS.iter().zip(2..).find(|(name, _)| **name == base).map(|(_, kind)| kind);
    let kind = match (base, bound) {
        ("char", _) => 3,
        ("bool", _) => 15,
        ("byte", _) => 16,
        ("string", None) => 17,
        ("wstring", None) => 18,
        ("string", _) => 21,
        ("wstring", _) => 22,
        _ => listed.unwrap_or(1),
    };
    let nested = Cow::Borrowed(if kind == 1 { base } else { "" });
    let text_capacity = bound.map_or(0, number);
    Some(TypeField { name, kind: group * 48 + kind, capacity, text_capacity, nested })
}

/// Returns the hash of types: SHA-256 of their fields as JSON. Their names are valid, so nothing in
/// the JSON has to be escaped.
pub(super) fn hash(types: &[TypeFields<'_>]) -> Result<String, TypeDescriptionError> {
    let one = |one: &TypeFields<'_>| -> Result<String, TypeDescriptionError> {
        let name = a_type(&one.name)?;
        let fields = one.fields.iter().map(|field| {
            let nested = if field.nested.is_empty() { "" } else { a_type(&field.nested)? };
            Ok(format!(
                "{{\"name\": \"{}\", \"type\": {{\"type_id\": {}, \"capacity\": {}, \
                 \"string_capacity\": {}, \
                 \"nested_type_name\": \"{nested}\"}}}}",
                a_word(field.name)?,
                field.kind,
                field.capacity,
                field.text_capacity,
            ))
        });
        let fields: Vec<String> = fields.collect::<Result<_, TypeDescriptionError>>()?;
        Ok(format!("{{\"type_name\": \"{name}\", \"fields\": [{}]}}", fields.join(", ")))
    };
    let types: Vec<String> = types.iter().map(one).collect::<Result<_, TypeDescriptionError>>()?;
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
