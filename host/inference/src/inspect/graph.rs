//! Checks graphs with everything in them: nodes, attributes, subgraphs and constants.

use std::collections::HashSet;

use super::InspectError;
use super::wire::{WireField, WireFields, WireValue};

/// Depth to which graphs may be nested. Libraries parse them by recursion.
const MAX_DEPTH: usize = 16;

/// Fields of `GraphProto`.
pub(super) mod graph_field {
    pub(in crate::inspect) const NODE: u64 = 1;
    pub(in crate::inspect) const INITIALIZER: u64 = 5;
    pub(in crate::inspect) const INPUT: u64 = 11;
    pub(in crate::inspect) const OUTPUT: u64 = 12;
    pub(in crate::inspect) const VALUE_INFO: u64 = 13;
    pub(in crate::inspect) const SPARSE_INITIALIZER: u64 = 15;
}

/// Fields of `NodeProto`.
pub(super) mod node_field {
    pub(in crate::inspect) const INPUT: u64 = 1;
    pub(in crate::inspect) const OUTPUT: u64 = 2;
    pub(in crate::inspect) const OPERATOR: u64 = 4;
    pub(in crate::inspect) const ATTRIBUTE: u64 = 5;
    pub(super) const DOMAIN: u64 = 7;
}

/// Fields of `FunctionProto`.
mod function_field {
    pub(super) const NODE: u64 = 7;
    pub(super) const ATTRIBUTE: u64 = 11;
}

/// Fields of `AttributeProto`.
pub(super) mod attribute_field {
    pub(in crate::inspect) const NAME: u64 = 1;
    pub(in crate::inspect) const NUMBER: u64 = 3;
    pub(in crate::inspect) const TEXT: u64 = 4;
    pub(in crate::inspect) const TENSOR: u64 = 5;
    pub(in crate::inspect) const GRAPH: u64 = 6;
    pub(in crate::inspect) const NUMBERS: u64 = 8;
    pub(super) const TENSORS: u64 = 10;
    pub(in crate::inspect) const GRAPHS: u64 = 11;
    pub(super) const TYPE: u64 = 14;
    pub(super) const TYPES: u64 = 15;
    pub(super) const SPARSE_TENSOR: u64 = 22;
    pub(super) const SPARSE_TENSORS: u64 = 23;
}

/// Fields of `TensorProto`.
pub(super) mod tensor_field {
    pub(in crate::inspect) const DIMS: u64 = 1;
    pub(in crate::inspect) const DATA_TYPE: u64 = 2;
    pub(in crate::inspect) const FLOAT_DATA: u64 = 4;
    pub(super) const INT32_DATA: u64 = 5;
    pub(in crate::inspect) const INT64_DATA: u64 = 7;
    pub(in crate::inspect) const NAME: u64 = 8;
    pub(in crate::inspect) const RAW_DATA: u64 = 9;
    pub(super) const EXTERNAL_DATA: u64 = 13;
    pub(super) const DATA_LOCATION: u64 = 14;
}

/// Value of `DATA_LOCATION` for data in the model itself.
const DEFAULT_LOCATION: i64 = 0;

/// An operator with random results, unless its third input is absent or false.
const DROPOUT: &str = "Dropout";

/// Operators whose results differ from run to run, so that no decision could be repeated.
const RANDOM: [&str; 6] = [
    "Bernoulli",
    "Multinomial",
    "RandomNormal",
    "RandomNormalLike",
    "RandomUniform",
    "RandomUniformLike",
];

/// Returns whether a domain is that of the standard operators.
pub(super) fn is_standard(domain: &str) -> bool {
    matches!(domain, "" | "ai.onnx")
}

/// Checks a graph and its subgraphs.
pub(super) fn check_graph(graph: &[u8], depth: usize) -> Result<(), InspectError> {
    if depth > MAX_DEPTH {
        return Err(InspectError::TooDeep { max: MAX_DEPTH });
    }
    let mut switches = HashSet::new();
    for field in WireFields(graph) {
        let field = field?;
        match field.number {
            graph_field::NODE => switches.extend(check_node(field.fields()?, depth)?),
            graph_field::INITIALIZER => check_tensor(field.fields()?)?,
            graph_field::SPARSE_INITIALIZER => check_sparse(field)?,
            graph_field::INPUT | graph_field::OUTPUT | graph_field::VALUE_INFO => {
                check_value(field)?;
            }
            _ => {}
        }
    }
    check_switches(graph, switches)
}

/// Checks that values which make an operator random are constant and false.
fn check_switches(graph: &[u8], switches: HashSet<&str>) -> Result<(), InspectError> {
    if switches.is_empty() {
        return Ok(());
    }
    let mut constants = HashSet::new();
    for field in WireFields(graph) {
        let field = field?;
        let (name, is_false) = match field.number {
            graph_field::NODE => constant_node(field.fields()?)?,
            graph_field::INITIALIZER => constant(field.fields()?)?,
            _ => continue,
        };
        if switches.contains(name) {
            if !is_false {
                return Err(random(DROPOUT));
            }
            constants.insert(name);
        }
    }
    if constants.len() == switches.len() { Ok(()) } else { Err(random(DROPOUT)) }
}

/// Returns the output of a node, and whether the node is a constant that is false.
fn constant_node(node: WireFields<'_>) -> Result<(&str, bool), InspectError> {
    let (mut output, mut is_constant, mut is_false) = ("", false, false);
    for field in node {
        let field = field?;
        match field.number {
            node_field::OUTPUT => output = field.text()?,
            node_field::OPERATOR => is_constant = field.text()? == "Constant",
            node_field::ATTRIBUTE => {
                for field in field.fields()? {
                    let field = field?;
                    if field.number == attribute_field::TENSOR {
                        is_false = constant(field.fields()?)?.1;
                    }
                }
            }
            _ => {}
        }
    }
    Ok((output, is_constant && is_false))
}

/// Returns the name of a tensor, and whether it has values and all are false.
fn constant(tensor: WireFields<'_>) -> Result<(&str, bool), InspectError> {
    let (mut name, mut has_values, mut is_false) = ("", false, true);
    for field in tensor {
        let field = field?;
        match field.number {
            tensor_field::NAME => name = field.text()?,
            tensor_field::RAW_DATA | tensor_field::INT32_DATA => {
                has_values = true;
                is_false &= match field.value {
                    WireValue::Varint(value) => value == 0,
                    WireValue::Bytes(bytes) => bytes.iter().all(|byte| *byte == 0),
                    WireValue::Fixed => false,
                };
            }
            _ => {}
        }
    }
    Ok((name, has_values && is_false))
}

fn random(operator: &str) -> InspectError {
    InspectError::Random { operator: operator.to_owned() }
}

/// Checks a function of the model, which is a graph without constants.
pub(super) fn check_functions(function: &[u8]) -> Result<(), InspectError> {
    for field in WireFields(function) {
        let field = field?;
        match field.number {
            // The caller of a function gives the value.
            function_field::NODE if check_node(field.fields()?, 0)?.is_some() => {
                return Err(random(DROPOUT));
            }
            function_field::ATTRIBUTE => check_attribute(field.fields()?, 0)?,
            _ => {}
        }
    }
    Ok(())
}

/// Checks a node; returns the value that makes it random if it is not false.
fn check_node(node: WireFields<'_>, depth: usize) -> Result<Option<&str>, InspectError> {
    let (mut domain, mut operator, mut inputs, mut third) = ("", "", 0_usize, "");
    for field in node {
        let field = field?;
        match field.number {
            node_field::INPUT => {
                inputs += 1;
                if inputs == 3 {
                    third = field.text()?;
                }
            }
            node_field::OPERATOR => operator = field.text()?,
            node_field::DOMAIN => domain = field.text()?,
            node_field::ATTRIBUTE => check_attribute(field.fields()?, depth)?,
            _ => {}
        }
    }
    if RANDOM.contains(&operator) {
        return Err(random(operator));
    }
    if is_standard(domain) {
        return Ok(Some(third).filter(|name| operator == DROPOUT && !name.is_empty()));
    }
    Err(InspectError::Domain { domain: domain.to_owned(), operator: operator.to_owned() })
}

fn check_attribute(attribute: WireFields<'_>, depth: usize) -> Result<(), InspectError> {
    for field in attribute {
        let field = field?;
        match field.number {
            attribute_field::GRAPH | attribute_field::GRAPHS => {
                check_graph(field.bytes()?, depth + 1)?;
            }
            attribute_field::TENSOR | attribute_field::TENSORS => check_tensor(field.fields()?)?,
            attribute_field::SPARSE_TENSOR | attribute_field::SPARSE_TENSORS => {
                check_sparse(field)?;
            }
            attribute_field::TYPE | attribute_field::TYPES => check_type(field, 0)?,
            _ => {}
        }
    }
    Ok(())
}

/// Checks a tensor with few values other than 0: two tensors, of values and of their places.
fn check_sparse(sparse: WireField<'_>) -> Result<(), InspectError> {
    for field in sparse.fields()? {
        let field = field?;
        if matches!(field.number, 1 | 2) {
            check_tensor(field.fields()?)?;
        }
    }
    Ok(())
}

fn check_tensor(tensor: WireFields<'_>) -> Result<(), InspectError> {
    let (mut name, mut location, mut is_external) = ("", "", false);
    for field in tensor {
        let field = field?;
        match field.number {
            tensor_field::NAME => name = field.text()?,
            tensor_field::DATA_LOCATION => is_external |= field.number()? != DEFAULT_LOCATION,
            tensor_field::EXTERNAL_DATA => {
                is_external = true;
                let (mut key, mut value) = ("", "");
                for field in field.fields()? {
                    let field = field?;
                    match field.number {
                        1 => key = field.text()?,
                        2 => value = field.text()?,
                        _ => {}
                    }
                }
                if key == "location" {
                    location = value;
                }
            }
            _ => {}
        }
    }
    if !is_external {
        return Ok(());
    }
    Err(InspectError::ExternalData { tensor: name.to_owned(), location: location.to_owned() })
}

/// Checks the type of a value: types of sequences and options are nested, too.
fn check_value(value: WireField<'_>) -> Result<(), InspectError> {
    for field in value.fields()? {
        let field = field?;
        if field.number == 2 {
            check_type(field, 0)?;
        }
    }
    Ok(())
}

fn check_type(type_field: WireField<'_>, depth: usize) -> Result<(), InspectError> {
    if depth > MAX_DEPTH {
        return Err(InspectError::TooDeep { max: MAX_DEPTH });
    }
    for field in type_field.fields()? {
        let field = field?;
        // Of the types, those of sequences, maps and options contain a further one.
        let inner = match field.number {
            1 => {
                check_tensor_type(field)?;
                continue;
            }
            4 | 9 => 1,
            5 => 2,
            _ => continue,
        };
        for field in field.fields()? {
            let field = field?;
            if field.number == inner {
                check_type(field, depth + 1)?;
            }
        }
    }
    Ok(())
}

/// Checks that the dimensions of the type of a tensor are messages.
fn check_tensor_type(tensor: WireField<'_>) -> Result<(), InspectError> {
    for field in tensor.fields()? {
        let shape = field?;
        if shape.number != 2 {
            continue;
        }
        for dimension in shape.fields()? {
            dimension?.fields()?.try_for_each(|field| field.map(drop))?;
        }
    }
    Ok(())
}
