//! Compiles field paths such as `a.b[3].c` to a skip program; errors name the valid alternatives.

use gleaner_rules::path::{MalformedPath, PathSegment, segments};

use super::cdr::{CdrError, Cursor, Endian};
use super::definitions::{Definitions, Struct, full_name};
use super::layout::{Layout, SkipTable};
use super::parse::{Count, Element, FieldDefinition};
use super::program::{Leaf, Op, walk};
use super::value::{MessageValue, ValueKind};
use gleaner_base::text::{hint, nearest};

/// A compiled path to one field of one message type.
#[derive(Debug)]
pub struct FieldPath {
    path: String,
    type_name: String,
    ops: Box<[Op]>,
    leaf: Leaf,
    /// The path in further layouts of the type, from number 1 on.
    others: Box<[Self]>,
}

/// Reasons why a path does not lead to a readable field.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PathError {
    /// The path is not of the form `a.b[3].c`.
    #[error(transparent)]
    Syntax(#[from] MalformedPath),
    #[error(
        "type `{type_name}` has no field `{field}`{}; it has: {}",
        hint(nearest),
        fields.join(", ")
    )]
    NoSuchField {
        type_name: String,
        field: String,
        /// The fields of the type, in wire order.
        fields: Vec<String>,
        /// The most similar name, if one is similar.
        nearest: Option<String>,
    },
    #[error("`{path}` is a whole `{type_name}`; name one of its fields: {}", fields.join(", "))]
    WholeStruct { path: String, type_name: String, fields: Vec<String> },
    #[error("field `{field}` of `{path}` is an array; write `{field}[0]` and so on")]
    NeedsIndex { path: String, field: String },
    /// The path continues after a value, or indexes a field that is not an array.
    #[error("field `{field}` of `{path}` is a single value with nothing inside")]
    NothingInside { path: String, field: String },
    #[error("field `{field}` of `{path}` has {len} elements, counted from 0")]
    OutOfRange { path: String, field: String, len: usize },
    /// A `wstring` is in the way. ROS 2's implementations disagree on the width of its characters,
    /// so neither it nor the fields after it can be located reliably.
    #[error(
        "`{path}` is or lies behind the wstring `{field}`, whose size on the wire is not defined"
    )]
    WideText { path: String, field: String },
    #[error(
        "`{path}` does not mean the same in all layouts of `{type_name}` on this topic: in that \
         with the fields {}, {}; in that with the fields {}, {}",
        first.0, first.1, second.0, second.1
    )]
    Layouts {
        path: String,
        type_name: String,
        /// Fields of one layout, and the meaning of the path in it.
        first: Box<(String, String)>,
        /// The same for another layout.
        second: Box<(String, String)>,
    },
}

impl FieldPath {
    /// Compiles `path`, such as `linear_acceleration.x`, `cov[3]` or `fields[2].name`, in all
    /// layouts of the type.
    ///
    /// # Errors
    ///
    /// [`PathError`], naming the type and its fields. [`PathError::Layouts`] if the path leads to a
    /// value in one layout, and to none or one of another kind in another.
    pub fn compile(definitions: &Definitions, path: &str) -> Result<Self, PathError> {
        let found = Self::compile_in(definitions, path);
        let mut others = Vec::new();
        for other in definitions.layouts().skip(1) {
            let again = Self::compile_in(other, path);
            match (&found, again) {
                (Ok(found), Ok(again)) if found.kind().is_like(again.kind()) => others.push(again),
                (Err(_), Err(_)) => {}
                (found, again) => {
                    return Err(PathError::Layouts {
                        path: path.to_owned(),
                        type_name: definitions.type_name().to_owned(),
                        first: Box::new(meaning(definitions, found)),
                        second: Box::new(meaning(other, &again)),
                    });
                }
            }
        }
        found.map(|found| Self { others: others.into(), ..found })
    }

    fn compile_in(definitions: &Definitions, path: &str) -> Result<Self, PathError> {
        let segments = segments(path)?;
        let mut compiler = Compiler { definitions, path, ops: Vec::new() };
        let leaf = compiler.enter_struct(definitions.root(), &segments)?;
        Ok(Self {
            path: path.to_owned(),
            type_name: definitions.type_name().to_owned(),
            ops: compiler.ops.into(),
            leaf,
            others: Box::default(),
        })
    }

    /// Returns the path in the layout with this number.
    ///
    /// # Errors
    ///
    /// [`CdrError::Layout`] if the type had no such layout when the path was compiled.
    #[inline]
    pub fn in_layout(&self, number: u16) -> Result<&Self, CdrError> {
        match number {
            0 => Ok(self),
            _ => self.others.get(usize::from(number) - 1).ok_or(CdrError::Layout(number)),
        }
    }

    /// Returns whether reading it may walk over much of a message, because elements of variable
    /// size precede the field.
    pub fn walks(&self) -> bool {
        self.ops.iter().any(|op| matches!(op, Op::Each { .. } | Op::Times { .. }))
            || self.others.iter().any(Self::walks)
    }

    pub fn path(&self) -> &str {
        &self.path
    }

    /// Returns the message type it was compiled for, `pkg/msg/Type`.
    pub fn type_name(&self) -> &str {
        &self.type_name
    }

    pub fn kind(&self) -> ValueKind {
        self.leaf.kind()
    }

    /// Reads the field from `cdr`, a message of the path's type without encapsulation.
    ///
    /// # Errors
    ///
    /// [`CdrError`] if the bytes up to and including the field are not such a message; later bytes
    /// are not read.
    pub fn read<'a>(&self, cdr: &'a [u8], endian: Endian) -> Result<MessageValue<'a>, CdrError> {
        let mut cursor = Cursor::new(cdr, endian);
        walk(&self.ops, &mut cursor)?;
        self.leaf.read(&mut cursor)
    }

    /// Reads a boolean (0 or 1), an integer (rounded beyond 2^53) or a floating-point number.
    ///
    /// # Errors
    ///
    /// As [`FieldPath::read`], and [`CdrError::NotANumber`] if [`ValueKind::is_number`] is false.
    pub fn number(&self, cdr: &[u8], endian: Endian) -> Result<f64, CdrError> {
        let mut cursor = Cursor::new(cdr, endian);
        walk(&self.ops, &mut cursor)?;
        self.leaf.number(&mut cursor)
    }
}

/// Describes a layout and the meaning of a path in it.
fn meaning(definitions: &Definitions, found: &Result<FieldPath, PathError>) -> (String, String) {
    let fields: Vec<_> = definitions.fields().map(|field| format!("`{field}`")).collect();
    let meaning = match found {
        Ok(path) => format!("it is {}", path.kind()),
        Err(error) => error.to_string(),
    };
    (fields.join(", "), meaning)
}

struct Compiler<'d> {
    definitions: &'d Definitions,
    path: &'d str,
    ops: Vec<Op>,
}

impl Compiler<'_> {
    /// Emits the steps from the start of `owner` to the field named by `segments`.
    fn enter_struct(
        &mut self,
        owner: &Struct,
        segments: &[PathSegment<'_>],
    ) -> Result<Leaf, PathError> {
        let Some((PathSegment::Name(name), rest)) = segments.split_first() else {
            // `a[0][1]`: a second index on an array of structs.
            return Err(self.whole(owner));
        };
        let position = owner.fields.iter().position(|field| field.name == *name);
        let Some(position) = position else {
            let names = owner.fields.iter().map(|field| field.name.as_str());
            return Err(PathError::NoSuchField {
                type_name: full_name(&owner.name),
                field: (*name).to_owned(),
                fields: names.clone().map(str::to_owned).collect(),
                nearest: nearest(name, names).map(str::to_owned),
            });
        };
        for field in &owner.fields[..position] {
            self.skip(field)?;
        }
        let field = &owner.fields[position];
        match (field.count, rest) {
            (Count::One, rest) => self.enter_element(field, rest),
            (count, []) => match &field.element {
                Element::Primitive(primitive) => Ok(Leaf::Array(*primitive, count)),
                Element::Text => Ok(Leaf::Texts(count)),
                Element::WideText => Err(self.wide(field)),
                Element::Struct(_) => Err(self.needs_index(field)),
            },
            (count, [PathSegment::Index(index), rest @ ..]) => {
                self.skip_to_element(field, count, *index)?;
                self.enter_element(field, rest)
            }
            (_, [PathSegment::Name(_), ..]) => Err(self.needs_index(field)),
        }
    }

    /// Emits the steps into one element of `field`, which starts at the current position.
    fn enter_element(
        &mut self,
        field: &FieldDefinition<usize>,
        rest: &[PathSegment<'_>],
    ) -> Result<Leaf, PathError> {
        match (&field.element, rest) {
            (Element::Struct(index), []) => Err(self.whole(self.definitions.get(*index))),
            (Element::Struct(index), rest) => self.enter_struct(self.definitions.get(*index), rest),
            (Element::WideText, _) => Err(self.wide(field)),
            (Element::Primitive(primitive), []) => Ok(Leaf::Scalar(*primitive)),
            (Element::Text, []) => Ok(Leaf::Text),
            _ => Err(PathError::NothingInside {
                path: self.path.to_owned(),
                field: field.name.clone(),
            }),
        }
    }

    fn skip_to_element(
        &mut self,
        field: &FieldDefinition<usize>,
        count: Count,
        index: usize,
    ) -> Result<(), PathError> {
        let beyond = |len| PathError::OutOfRange {
            path: self.path.to_owned(),
            field: field.name.clone(),
            len,
        };
        match count {
            Count::Fixed(n) if index >= n => return Err(beyond(n)),
            Count::Sequence if u32::try_from(index).is_err() => {
                return Err(beyond(u32::MAX as usize));
            }
            Count::Sequence => self.ops.push(Op::Enter { index, least: self.least(field) }),
            _ => {}
        }
        match self.layout(field) {
            Layout::Fixed(table) => match table.times(index) {
                Some(table) => self.fixed(&table),
                // No message is that long: the element cannot exist.
                None => return Err(beyond(u32::MAX as usize)),
            },
            Layout::Variable => {
                let body = self.element_body(field)?;
                self.ops.push(Op::Times { body, n: index });
            }
        }
        Ok(())
    }

    fn skip(&mut self, field: &FieldDefinition<usize>) -> Result<(), PathError> {
        let least = self.least(field);
        match (field.count, self.layout(field)) {
            (Count::One, Layout::Fixed(table)) => self.fixed(&table),
            (Count::One, Layout::Variable) => {
                let body = self.element_body(field)?;
                self.ops.extend(body);
            }
            (Count::Fixed(n), Layout::Fixed(table)) => {
                let table = table.times(n).expect("measured when the definitions were parsed");
                self.fixed(&table);
            }
            (Count::Fixed(n), Layout::Variable) => {
                let body = self.element_body(field)?;
                self.ops.push(Op::Times { body, n });
            }
            (Count::Sequence, Layout::Fixed(table)) => self.ops.push(match &field.element {
                Element::Primitive(primitive) => Op::Primitives(primitive.size()),
                _ => Op::Structs { table, least },
            }),
            (Count::Sequence, Layout::Variable) => {
                let body = self.element_body(field)?;
                self.ops.push(Op::Each { body, least });
            }
        }
        Ok(())
    }

    /// Returns the steps over one element of `field`, which is of variable size.
    fn element_body(&self, field: &FieldDefinition<usize>) -> Result<Box<[Op]>, PathError> {
        let mut inner =
            Compiler { definitions: self.definitions, path: self.path, ops: Vec::new() };
        match &field.element {
            Element::Primitive(_) => {}
            Element::Text => inner.ops.push(Op::Text),
            Element::WideText => return Err(self.wide(field)),
            Element::Struct(index) => {
                for field in &self.definitions.get(*index).fields {
                    inner.skip(field)?;
                }
            }
        }
        Ok(inner.ops.into())
    }

    /// Emits a run of fixed size, joined to the run before it if there is one.
    fn fixed(&mut self, table: &SkipTable) {
        if let Some(Op::Fixed(before)) = self.ops.last_mut()
            && let Some(joined) = before.then(table)
        {
            *before = joined;
            return;
        }
        self.ops.push(Op::Fixed(*table));
    }

    fn layout(&self, field: &FieldDefinition<usize>) -> Layout {
        match &field.element {
            Element::Primitive(primitive) => Layout::Fixed(SkipTable::primitive(*primitive)),
            Element::Text | Element::WideText => Layout::Variable,
            Element::Struct(index) => self.definitions.get(*index).layout,
        }
    }

    fn least(&self, field: &FieldDefinition<usize>) -> usize {
        match &field.element {
            Element::Primitive(primitive) => primitive.size(),
            Element::Text | Element::WideText => 4,
            Element::Struct(index) => self.definitions.get(*index).least,
        }
    }

    fn whole(&self, owner: &Struct) -> PathError {
        PathError::WholeStruct {
            path: self.path.to_owned(),
            type_name: full_name(&owner.name),
            fields: owner.fields.iter().map(|field| field.name.clone()).collect(),
        }
    }

    fn needs_index(&self, field: &FieldDefinition<usize>) -> PathError {
        PathError::NeedsIndex { path: self.path.to_owned(), field: field.name.clone() }
    }

    fn wide(&self, field: &FieldDefinition<usize>) -> PathError {
        PathError::WideText { path: self.path.to_owned(), field: field.name.clone() }
    }
}
