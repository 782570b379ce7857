//! A message type with all types it refers to, resolved and measured.

use std::collections::{HashMap, HashSet};

use sha2::{Digest, Sha256};

use super::layout::{Layout, SkipTable};
use super::parse::{self, Count, Element, FieldDefinition, Primitive};

/// Nesting limit of types. ROS 2's own deepest (diagnostics, visualization) stay below 10.
const MAX_DEPTH: usize = 32;
/// Limit of fields of a type, those of nested types included. Each level of nesting can double
/// them, so one page of text could otherwise define billions.
const MAX_FIELDS: usize = 20_000;

/// A message type with all types it refers to, ready for [`super::FieldPath::compile`].
#[derive(Debug)]
pub struct Definitions {
    type_name: String,
    /// Every reachable type; the root is the last.
    structs: Vec<Struct>,
    /// Further layouts of the type, which have none themselves.
    others: Vec<Self>,
}

#[derive(Debug)]
pub(super) struct Struct {
    pub(super) name: String,
    pub(super) fields: Vec<FieldDefinition<usize>>,
    pub(super) layout: Layout,
    /// Minimum size of a value in bytes, without padding; at least 1.
    pub(super) least: usize,
    /// Number of fields, those of nested types included.
    weight: usize,
}

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    #[error("line {line}: expected {wanted}, found `{text}`")]
    Syntax {
        /// Line number, from 1.
        line: usize,
        /// The line, truncated to 80 characters.
        text: String,
        wanted: &'static str,
    },
    #[error("field `{field}` of type `{type_name}` has type `{missing}`, which is not defined")]
    Undefined { type_name: String, field: String, missing: String },
    #[error("type `{type_name}` is defined twice, differently")]
    Conflict { type_name: String },
    #[error("type `{type_name}` has two fields `{field}`")]
    DuplicateField { type_name: String, field: String },
    #[error("type `{type_name}` contains itself")]
    Recursive { type_name: String },
    #[error("type `{type_name}` nests deeper than {MAX_DEPTH} levels")]
    TooDeep { type_name: String },
    #[error("type `{type_name}` has more than {MAX_FIELDS} fields or 4 GiB")]
    TooLarge { type_name: String },
}

impl Definitions {
    /// Parses the ros2msg text of `type_name` (`pkg/msg/Type` or `pkg/Type`): the fields of that
    /// type, then those of the types it refers to, each after a line of `=` and a line `MSG:
    /// pkg/Type`. `builtin_interfaces/Time` and `Duration` are built in.
    ///
    /// # Errors
    ///
    /// [`MessageError`] for malformed lines, missing or contradictory definitions, types that
    /// contain themselves, and excessive depth or size.
    pub fn parse(type_name: &str, text: &str) -> Result<Self, MessageError> {
        let root = short_name(type_name);
        let mut parts: HashMap<String, Vec<FieldDefinition<String>>> = HashMap::new();
        for part in parse::parts(text)? {
            let name = part.name.map_or_else(|| root.clone(), short_name);
            match parts.get(&name) {
                Some(known) if *known != part.fields => {
                    return Err(MessageError::Conflict { type_name: name });
                }
                Some(_) => {}
                None => {
                    parts.insert(name, part.fields);
                }
            }
        }
        for builtin in ["builtin_interfaces/Time", "builtin_interfaces/Duration"] {
            parts.entry(builtin.to_owned()).or_insert_with(seconds_and_nanoseconds);
        }
        let mut resolver =
            Resolver { parts, structs: Vec::new(), known: HashMap::new(), open: Vec::new() };
        resolver.resolve(&root)?;
        Ok(Self { type_name: full_name(&root), structs: resolver.structs, others: Vec::new() })
    }

    /// Returns the type's full name, `pkg/msg/Type`.
    pub fn type_name(&self) -> &str {
        &self.type_name
    }

    /// Returns the names of the type's own fields, in wire order.
    pub fn fields(&self) -> impl Iterator<Item = &str> {
        self.root().fields.iter().map(|field| field.name.as_str())
    }

    /// Adds further layouts of the type, which samples may have instead of this one: they are
    /// numbered from 1, and this one is 0.
    pub fn with_layouts(mut self, others: Vec<Self>) -> Self {
        self.others = others;
        self
    }

    /// Returns the layouts of the type by their numbers, itself first.
    pub fn layouts(&self) -> impl Iterator<Item = &Self> {
        std::iter::once(self).chain(&self.others)
    }

    /// Returns whether both define the same fields.
    ///
    /// Comments, constants and default values are no part of them.
    pub fn is_equivalent(&self, other: &Self) -> bool {
        // Both list a type before those that contain it, in the order of the fields.
        let is_same = |(a, b): (&Struct, &Struct)| a.name == b.name && a.fields == b.fields;
        self.structs.len() == other.structs.len()
            && self.structs.iter().zip(&other.structs).all(is_same)
    }

    /// Returns a digest that two definitions share if they define the same fields.
    pub fn layout_digest(&self) -> [u8; 32] {
        let mut digest = Sha256::new();
        for Struct { name, fields, .. } in &self.structs {
            digest.update(format!("{name} {fields:?}\n"));
        }
        digest.finalize().into()
    }

    pub(super) fn root(&self) -> &Struct {
        self.structs.last().expect("parse resolves the root or fails, and pushes it last")
    }

    pub(super) fn get(&self, index: usize) -> &Struct {
        &self.structs[index]
    }
}

/// Returns `pkg/msg/Type` as `pkg/Type`; anything else unchanged.
pub fn short_name(type_name: &str) -> String {
    match type_name.split_once("/msg/") {
        Some((package, name)) => format!("{package}/{name}"),
        None => type_name.to_owned(),
    }
}

/// Returns `pkg/Type` as `pkg/msg/Type`, the form of manifests and error messages.
pub(super) fn full_name(short_name: &str) -> String {
    match short_name.split_once('/') {
        Some((package, name)) => format!("{package}/msg/{name}"),
        None => short_name.to_owned(),
    }
}

fn seconds_and_nanoseconds() -> Vec<FieldDefinition<String>> {
    [("sec", Primitive::I32), ("nanosec", Primitive::U32)]
        .map(|(name, primitive)| FieldDefinition {
            name: name.to_owned(),
            element: Element::Primitive(primitive),
            count: Count::One,
        })
        .into()
}

/// Turns names into indices, innermost types first.
struct Resolver {
    parts: HashMap<String, Vec<FieldDefinition<String>>>,
    structs: Vec<Struct>,
    known: HashMap<String, usize>,
    /// The types being resolved, outermost first.
    open: Vec<String>,
}

impl Resolver {
    fn resolve(&mut self, name: &str) -> Result<usize, MessageError> {
        if let Some(&index) = self.known.get(name) {
            return Ok(index);
        }
        let type_name = name.to_owned();
        if self.open.contains(&type_name) {
            return Err(MessageError::Recursive { type_name });
        }
        if self.open.len() >= MAX_DEPTH {
            return Err(MessageError::TooDeep { type_name });
        }
        self.open.push(type_name);
        let mut fields = Vec::new();
        let mut names = HashSet::new();
        for field in self.parts.get(name).cloned().unwrap_or_default() {
            if !names.insert(field.name.clone()) {
                let type_name = name.to_owned();
                return Err(MessageError::DuplicateField { type_name, field: field.name });
            }
            fields.push(self.field(name, field)?);
        }
        // rosidl gives a type without fields this one byte, since C has no empty structs.
        if fields.is_empty() {
            fields.push(FieldDefinition {
                name: "structure_needs_at_least_one_member".to_owned(),
                element: Element::Primitive(Primitive::U8),
                count: Count::One,
            });
        }
        let measured = self.measure(name, fields)?;
        self.open.pop();
        self.structs.push(measured);
        let index = self.structs.len() - 1;
        self.known.insert(name.to_owned(), index);
        Ok(index)
    }

    fn field(
        &mut self,
        owner: &str,
        field: FieldDefinition<String>,
    ) -> Result<FieldDefinition<usize>, MessageError> {
        let FieldDefinition { name, element, count } = field;
        let element = match element {
            Element::Primitive(primitive) => Element::Primitive(primitive),
            Element::Text => Element::Text,
            Element::WideText => Element::WideText,
            Element::Struct(wanted) => {
                let found = self.lookup(owner, &wanted).ok_or_else(|| MessageError::Undefined {
                    type_name: owner.to_owned(),
                    field: name.clone(),
                    missing: wanted,
                })?;
                Element::Struct(self.resolve(&found)?)
            }
        };
        Ok(FieldDefinition { name, element, count })
    }

    /// A bare name means the owner's package, or `std_msgs/Header`, as in ROS 1.
    fn lookup(&self, owner: &str, wanted: &str) -> Option<String> {
        let wanted = short_name(wanted);
        let candidates = match (wanted.contains('/'), owner.split_once('/')) {
            (true, _) => vec![wanted],
            (false, Some((package, _))) => {
                vec![format!("{package}/{wanted}"), format!("std_msgs/{wanted}")]
            }
            (false, None) => vec![wanted],
        };
        candidates.into_iter().find(|name| self.parts.contains_key(name))
    }

    fn measure(
        &self,
        name: &str,
        fields: Vec<FieldDefinition<usize>>,
    ) -> Result<Struct, MessageError> {
        let too_large = || MessageError::TooLarge { type_name: name.to_owned() };
        let mut layout = Some(SkipTable::EMPTY);
        let (mut least, mut weight) = (0usize, 0usize);
        for field in &fields {
            let (element, element_least, element_weight) = match &field.element {
                Element::Primitive(p) => (Layout::Fixed(SkipTable::primitive(*p)), p.size(), 1),
                Element::Text | Element::WideText => (Layout::Variable, 4, 1),
                Element::Struct(index) => {
                    let inner = &self.structs[*index];
                    (inner.layout, inner.least, inner.weight.saturating_add(1))
                }
            };
            let (table, field_least) = match (field.count, element) {
                (Count::One, Layout::Fixed(table)) => (Some(table), element_least),
                (Count::One, Layout::Variable) => (None, element_least),
                (Count::Fixed(n), Layout::Fixed(table)) => {
                    let table = table.times(n).ok_or_else(too_large)?;
                    (Some(table), element_least.saturating_mul(n))
                }
                (Count::Fixed(n), Layout::Variable) => (None, element_least.saturating_mul(n)),
                (Count::Sequence, _) => (None, 4),
            };
            layout = match (layout, table) {
                (Some(before), Some(table)) => Some(before.then(&table).ok_or_else(too_large)?),
                _ => None,
            };
            least = least.saturating_add(field_least);
            weight = weight.saturating_add(element_weight);
        }
        if weight > MAX_FIELDS || least > u32::MAX as usize {
            return Err(too_large());
        }
        let layout = layout.map_or(Layout::Variable, Layout::Fixed);
        Ok(Struct { name: name.to_owned(), fields, layout, least, weight })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nested_types_resolve_by_full_name_and_within_the_package() {
        let text =
            "Inner a\nother/msg/Far b\n===\nMSG: pkg/Inner\nint8 x\n===\nMSG: other/Far\nint8 y\n";
        let definitions = Definitions::parse("pkg/msg/Outer", text).unwrap();
        assert_eq!(definitions.type_name(), "pkg/msg/Outer");
        assert_eq!(definitions.fields().collect::<Vec<_>>(), ["a", "b"]);
        // Some editors put a byte order mark in front.
        let marked = Definitions::parse("pkg/msg/Outer", &format!("\u{feff}{text}")).unwrap();
        assert!(definitions.is_equivalent(&marked));
        assert_eq!(definitions.layout_digest(), marked.layout_digest());
        let swapped = "int8 x\n===\nMSG: other/Far\nint8 y\n";
        let other = Definitions::parse("pkg/msg/Outer", swapped).unwrap();
        assert_ne!(definitions.layout_digest(), other.layout_digest());
    }

    #[test]
    fn time_is_known_without_its_definition() {
        assert!(Definitions::parse("p/T", "builtin_interfaces/Time stamp").is_ok());
    }

    #[test]
    fn a_type_that_contains_itself_is_refused() {
        let text = "p/A a\n===\nMSG: p/A\np/B[] b\n===\nMSG: p/B\np/A a\n";
        let refused = Definitions::parse("p/T", text).unwrap_err();
        assert_eq!(refused, MessageError::Recursive { type_name: "p/A".to_owned() });
    }

    #[test]
    fn endless_nesting_is_refused() {
        let mut deep = "p/T0 x\n".to_owned();
        for level in 0..40 {
            deep += &format!("===\nMSG: p/T{level}\np/T{} x\n", level + 1);
        }
        assert!(matches!(Definitions::parse("p/T", &deep), Err(MessageError::TooDeep { .. })));
    }

    #[test]
    fn a_page_that_expands_to_billions_of_fields_is_refused() {
        let mut text = "p/T0 x\n".to_owned();
        for level in 0..25 {
            text += &format!("===\nMSG: p/T{level}\np/T{0} a\np/T{0} b\n", level + 1);
        }
        text += "===\nMSG: p/T25\nstring s\n";
        assert!(matches!(Definitions::parse("p/T", &text), Err(MessageError::TooLarge { .. })));
    }

    #[test]
    fn a_missing_type_is_named() {
        let refused = Definitions::parse("p/T", "q/Gone[] x").unwrap_err();
        let expected = "field `x` of type `p/T` has type `q/Gone`, which is not defined";
        assert_eq!(refused.to_string(), expected);
    }

    #[test]
    fn contradictory_and_duplicate_definitions_are_refused() {
        let text = "p/A a\n===\nMSG: p/A\nint8 x\n===\nMSG: p/A\nint16 x\n";
        assert!(matches!(Definitions::parse("p/T", text), Err(MessageError::Conflict { .. })));
        let twice = Definitions::parse("p/T", "int8 x\nint8 x");
        assert!(matches!(twice, Err(MessageError::DuplicateField { .. })));
    }
}
