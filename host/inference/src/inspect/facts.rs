//! Collects the nodes of a model, its subgraphs included, and what it declares about values. All of
//! them are checked.

use std::collections::{HashMap, HashSet};

use super::graph::{
    DROPOUT, attribute_field, check_depth, check_operator, check_type, check_value, function_field,
    graph_field, is_in, node_field, random, tensor_field,
};
use super::signature::DeclaredValue;
use super::wire::{WireField, WireFields, WireValue};
use super::{InspectError, entry_of};

/// Value of `DATA_LOCATION` for data in the model itself.
const DEFAULT_LOCATION: i64 = 0;

/// Most steps from a value back to one whose rank is declared.
const MAX_STEPS: usize = 32;

/// Operators whose output has rank and type of their first input.
const SAME_RANK: &str = "AveragePool BatchNormalization Clip Concat Conv Identity LeakyRelu \
                         MaxPool Relu Resize Sigmoid Slice Softmax Split Transpose";

/// Further operators whose output has the type of their first input.
const SAME_TYPE: &str = "Abs Add Div Exp Expand Gather MatMul Mul Pow Reshape Sqrt Sub";

/// Operators whose results are booleans.
const CONDITIONS: &str = "And Equal Greater GreaterOrEqual IsInf IsNaN Less LessOrEqual Not Or Xor";

#[derive(Default)]
pub(super) struct OnnxNode<'a> {
    pub(super) operator: &'a str,
    pub(super) inputs: Vec<&'a str>,
    outputs: Vec<&'a str>,
    attributes: Vec<NodeAttribute<'a>>,
}

#[derive(Default)]
struct NodeAttribute<'a> {
    name: &'a str,
    number: Option<i64>,
    text: &'a str,
    numbers: Vec<i64>,
    tensor: Option<ValueFacts>,
}

#[derive(Clone, Default, PartialEq)]
pub(super) struct ValueFacts {
    /// Number of its type.
    pub(super) element: Option<i64>,
    /// Lengths; -1 for those that are not fixed.
    pub(super) shape: Option<Vec<i64>>,
    /// True for a constant with a number that an `int32` cannot hold.
    pub(super) is_wide: bool,
    pub(super) is_constant: bool,
    /// True for a small constant of `float32` without fractions.
    pub(super) is_whole: bool,
    /// True for a constant with a NaN.
    has_nan: bool,
    /// True for a constant with values of which all are false.
    is_false: bool,
}

/// All nodes of a model, and its values by name.
#[derive(Default)]
pub(super) struct GraphFacts<'a> {
    pub(super) opset: i64,
    pub(super) nodes: Vec<OnnxNode<'a>>,
    values: HashMap<&'a str, ValueFacts>,
    /// Index of the node that computes a value.
    producers: HashMap<&'a str, usize>,
    /// True if a constant has a NaN.
    pub(super) has_nan: bool,
}

impl<'a> OnnxNode<'a> {
    fn attribute(&self, name: &str) -> Option<&NodeAttribute<'a>> {
        self.attributes.iter().find(|attribute| attribute.name == name)
    }

    /// Returns an attribute that is a number, if the node has it.
    pub(super) fn number(&self, name: &str) -> Option<i64> {
        self.attribute(name).map(|it| it.number.unwrap_or_default())
    }

    /// Returns an attribute that is a text; an empty one without it.
    pub(super) fn text(&self, name: &str) -> &'a str {
        self.attribute(name).map_or("", |it| it.text)
    }

    /// Returns an attribute that is a list of numbers; an empty one without it.
    pub(super) fn numbers(&self, name: &str) -> &[i64] {
        self.attribute(name).map_or(&[], |it| &it.numbers)
    }

    /// Returns an input by its index; an empty name without it.
    pub(super) fn input(&self, index: usize) -> &'a str {
        self.inputs.get(index).copied().unwrap_or_default()
    }

    pub(super) fn output(&self) -> &'a str {
        self.outputs.first().copied().unwrap_or_default()
    }

    /// Returns the value that makes the node random if it is not false.
    fn switch(&self) -> Option<&'a str> {
        Some(self.input(2)).filter(|name| self.operator == DROPOUT && !name.is_empty())
    }

    /// Returns the facts of a node that is a constant.
    fn constant(&self) -> Option<ValueFacts> {
        let [attribute] = &self.attributes[..] else { return None };
        if self.operator != "Constant" {
            return None;
        }
        let numbers = attribute.number.iter().chain(&attribute.numbers);
        let is_wide = numbers.copied().any(is_wide);
        let length = attribute.numbers.len();
        let shape = attribute.name.ends_with('s').then(|| vec![length as i64]);
        let listed = ValueFacts { shape, is_wide, is_constant: true, ..ValueFacts::default() };
        Some(attribute.tensor.clone().unwrap_or(listed))
    }
}

impl<'a> GraphFacts<'a> {
    /// Adds the facts of a graph and of its subgraphs.
    ///
    /// # Errors
    ///
    /// [`InspectError`] names the first operator, constant or type that is refused.
    pub(super) fn add(&mut self, graph: &'a [u8], depth: usize) -> Result<(), InspectError> {
        check_depth(depth)?;
        let mut switches: HashSet<&str> = HashSet::new();
        // Values of this graph: true for constants that are false.
        let mut are_false: HashMap<&str, bool> = HashMap::new();
        for field in WireFields(graph) {
            let field = field?;
            match field.number {
                graph_field::NODE => {
                    let node = self.add_node(field.fields()?, depth)?;
                    switches.extend(node.switch());
                    let is_false = node.constant().is_some_and(|it| it.is_false);
                    for output in &node.outputs {
                        *are_false.entry(output).or_insert(true) &= is_false;
                    }
                }
                graph_field::INITIALIZER => {
                    let (name, facts) = tensor(field.fields()?)?;
                    *are_false.entry(name).or_insert(true) &= facts.is_false;
                    self.declare(name, facts);
                }
                graph_field::SPARSE_INITIALIZER => check_sparse(field)?,
                graph_field::INPUT | graph_field::OUTPUT | graph_field::VALUE_INFO => {
                    check_value(field)?;
                    let declared = DeclaredValue::of(field)?;
                    if let Some(tensor) = declared.tensor {
                        let shape = tensor.shape.filter(|it| it.len() == tensor.dimensions);
                        let element = tensor.element;
                        let facts = ValueFacts { element, shape, ..ValueFacts::default() };
                        self.declare(declared.name, facts);
                    }
                }
                _ => {}
            }
        }
        match switches.iter().all(|name| are_false.get(name) == Some(&true)) {
            true => Ok(()),
            false => Err(random(DROPOUT)),
        }
    }

    /// Notes the facts of a value. Of a value that is declared twice, constants count.
    fn declare(&mut self, name: &'a str, facts: ValueFacts) {
        self.has_nan |= facts.has_nan;
        let known = self.values.entry(name).or_default();
        known.is_wide |= facts.is_wide;
        known.is_constant |= facts.is_constant;
        known.is_whole |= facts.is_whole;
        known.element = facts.element.or(known.element);
        known.shape = facts.shape.or(known.shape.take());
    }

    fn add_node(
        &mut self,
        fields: WireFields<'a>,
        depth: usize,
    ) -> Result<&OnnxNode<'a>, InspectError> {
        let (mut node, mut domain) = (OnnxNode::default(), "");
        for field in fields {
            let field = field?;
            match field.number {
                node_field::INPUT => node.inputs.push(field.text()?),
                node_field::OUTPUT => node.outputs.push(field.text()?),
                node_field::OPERATOR => node.operator = field.text()?,
                node_field::DOMAIN => domain = field.text()?,
                node_field::ATTRIBUTE => {
                    let attribute = self.attribute(field.fields()?, depth)?;
                    node.attributes.push(attribute);
                }
                _ => {}
            }
        }
        check_operator(domain, node.operator)?;
        if let Some(facts) = node.constant() {
            self.declare(node.output(), facts);
        }
        let index = self.nodes.len();
        for output in &node.outputs {
            self.producers.insert(output, index);
        }
        self.nodes.push(node);
        Ok(&self.nodes[index])
    }

    fn attribute(
        &mut self,
        fields: WireFields<'a>,
        depth: usize,
    ) -> Result<NodeAttribute<'a>, InspectError> {
        let mut attribute = NodeAttribute::default();
        for field in fields {
            let field = field?;
            match field.number {
                attribute_field::NAME => attribute.name = field.text()?,
                attribute_field::NUMBER => attribute.number = Some(field.number()?),
                // A text that is not UTF-8 is none that a rule compares with.
                attribute_field::TEXT => attribute.text = field.text().unwrap_or_default(),
                attribute_field::NUMBERS => field.numbers(&mut attribute.numbers)?,
                attribute_field::TENSOR => attribute.tensor = Some(tensor(field.fields()?)?.1),
                attribute_field::TENSORS => drop(tensor(field.fields()?)?),
                attribute_field::GRAPH | attribute_field::GRAPHS => {
                    self.add(field.bytes()?, depth + 1)?;
                }
                attribute_field::SPARSE_TENSOR | attribute_field::SPARSE_TENSORS => {
                    check_sparse(field)?;
                }
                attribute_field::TYPE | attribute_field::TYPES => check_type(field, 0)?,
                _ => {}
            }
        }
        Ok(attribute)
    }

    pub(super) fn value(&self, name: &str) -> Option<&ValueFacts> {
        self.values.get(name)
    }

    pub(super) fn producer(&self, name: &str) -> Option<&OnnxNode<'a>> {
        self.producers.get(name).map(|index| &self.nodes[*index])
    }

    /// Returns the type of a value, if it is declared or follows.
    pub(super) fn element(&self, name: &str) -> Option<i64> {
        self.element_in(name, MAX_STEPS)
    }

    fn element_in(&self, name: &str, steps: usize) -> Option<i64> {
        if let Some(element) = self.value(name).and_then(|it| it.element) {
            return Some(element);
        }
        let (steps, node) = (steps.checked_sub(1)?, self.producer(name)?);
        match node.operator {
            "Cast" => node.number("to"),
            "Shape" | "Size" | "NonZero" => Some(INT64),
            "Where" | "CastLike" => self.element_in(node.input(1), steps),
            operator if is_in(CONDITIONS, operator) => Some(BOOLEAN),
            operator if is_in(SAME_RANK, operator) || is_in(SAME_TYPE, operator) => {
                self.element_in(node.input(0), steps)
            }
            _ => None,
        }
    }

    /// Returns the number of dimensions of a value, if it is declared or follows.
    pub(super) fn rank(&self, name: &str) -> Option<usize> {
        self.rank_in(name, MAX_STEPS)
    }

    fn rank_in(&self, name: &str, steps: usize) -> Option<usize> {
        if let Some(shape) = self.value(name).and_then(|it| it.shape.as_ref()) {
            return Some(shape.len());
        }
        let (steps, node) = (steps.checked_sub(1)?, self.producer(name)?);
        let input = node.input(0);
        match node.operator {
            "Reshape" => {
                let shape = self.value(node.input(1))?.shape.as_ref()?;
                shape.first().and_then(|length| usize::try_from(*length).ok())
            }
            "Gemm" | "Flatten" => Some(2),
            "Cast" => self.rank_in(input, steps),
            operator if is_in(SAME_RANK, operator) => self.rank_in(input, steps),
            _ => None,
        }
    }
}

/// Checks a function of the model, which is a graph without constants.
pub(super) fn check_function(function: &[u8]) -> Result<(), InspectError> {
    let mut facts = GraphFacts::default();
    for field in WireFields(function) {
        let field = field?;
        match field.number {
            // The caller of a function gives the value.
            function_field::NODE if facts.add_node(field.fields()?, 0)?.switch().is_some() => {
                return Err(random(DROPOUT));
            }
            function_field::ATTRIBUTE => drop(facts.attribute(field.fields()?, 0)?),
            _ => {}
        }
    }
    Ok(())
}

/// Checks a tensor with few values other than 0: two tensors, of values and of their places.
fn check_sparse(sparse: WireField<'_>) -> Result<(), InspectError> {
    sparse.fields()?.of(&[1, 2]).try_for_each(|field| tensor(field?.fields()?).map(drop))
}

fn is_wide(number: i64) -> bool {
    i32::try_from(number).is_err()
}

/// Returns name and facts of a constant.
fn tensor(fields: WireFields<'_>) -> Result<(&str, ValueFacts), InspectError> {
    let (mut name, mut element, mut shape) = ("", None, Vec::new());
    let (mut raw, mut integers, mut has_nan) = (&[][..], Vec::new(), false);
    let (mut is_false, mut location, mut is_external) = (None, "", false);
    for field in fields {
        let field = field?;
        match field.number {
            tensor_field::DIMS => field.numbers(&mut shape)?,
            tensor_field::DATA_TYPE => element = Some(field.number()?),
            tensor_field::NAME => name = field.text()?,
            tensor_field::RAW_DATA | tensor_field::INT32_DATA => {
                let is_zero = match field.value {
                    WireValue::Varint(value) => value == 0,
                    WireValue::Bytes(bytes) => bytes.iter().all(|byte| *byte == 0),
                    WireValue::Fixed => false,
                };
                is_false = Some(is_zero && is_false != Some(false));
                if field.number == tensor_field::RAW_DATA {
                    raw = field.bytes()?;
                }
            }
            tensor_field::INT64_DATA => field.numbers(&mut integers)?,
            tensor_field::FLOAT_DATA => has_nan |= packed_nan(field),
            tensor_field::DATA_LOCATION => is_external |= field.number()? != DEFAULT_LOCATION,
            tensor_field::EXTERNAL_DATA => {
                is_external = true;
                let (key, value) = entry_of(field.fields()?)?;
                let value = value.map_or(Ok(""), |it| it.text())?;
                location = if key == "location" { value } else { location };
            }
            _ => {}
        }
    }
    if is_external {
        let (tensor, location) = (name.to_owned(), location.to_owned());
        return Err(InspectError::ExternalData { tensor, location });
    }
    let wide = |bytes: &[u8]| bytes.try_into().is_ok_and(|it| is_wide(i64::from_le_bytes(it)));
    let is_wide = integers.into_iter().any(is_wide)
        || element == Some(INT64) && raw.chunks_exact(8).any(wide);
    has_nan |= element == Some(FLOAT32) && raw.chunks_exact(4).any(is_nan);
    let is_whole = element == Some(FLOAT32)
        && (1..=SMALL).contains(&raw.len())
        && raw.chunks_exact(4).all(|it| float(it).fract() == 0.0);
    let shape = Some(shape);
    let (is_constant, is_false) = (true, is_false == Some(true));
    Ok((name, ValueFacts { element, shape, is_wide, is_constant, is_whole, has_nan, is_false }))
}

fn float(bytes: &[u8]) -> f32 {
    bytes.try_into().map_or(0.0, f32::from_le_bytes)
}

fn is_nan(bytes: &[u8]) -> bool {
    float(bytes).is_nan()
}

fn packed_nan(field: WireField<'_>) -> bool {
    matches!(field.value, WireValue::Bytes(bytes) if bytes.chunks_exact(4).any(is_nan))
}

/// Most bytes of a constant of which each number is looked at.
const SMALL: usize = 64;

/// Types of constants that are read.
const FLOAT32: i64 = 1;
pub(super) const INT64: i64 = 7;

pub(super) const BOOLEAN: i64 = 9;
