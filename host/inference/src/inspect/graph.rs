//! Fields of graphs, and checks of their operators, types and depth.

use super::InspectError;
use super::wire::WireField;

/// Depth to which graphs and types may be nested. Libraries parse them by recursion.
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
    pub(in crate::inspect) const DOMAIN: u64 = 7;
}

/// Fields of `FunctionProto`.
pub(super) mod function_field {
    pub(in crate::inspect) const NODE: u64 = 7;
    pub(in crate::inspect) const ATTRIBUTE: u64 = 11;
}

/// Fields of `AttributeProto`.
pub(super) mod attribute_field {
    pub(in crate::inspect) const NAME: u64 = 1;
    pub(in crate::inspect) const NUMBER: u64 = 3;
    pub(in crate::inspect) const TEXT: u64 = 4;
    pub(in crate::inspect) const TENSOR: u64 = 5;
    pub(in crate::inspect) const GRAPH: u64 = 6;
    pub(in crate::inspect) const NUMBERS: u64 = 8;
    pub(in crate::inspect) const TENSORS: u64 = 10;
    pub(in crate::inspect) const GRAPHS: u64 = 11;
    pub(in crate::inspect) const TYPE: u64 = 14;
    pub(in crate::inspect) const TYPES: u64 = 15;
    pub(in crate::inspect) const SPARSE_TENSOR: u64 = 22;
    pub(in crate::inspect) const SPARSE_TENSORS: u64 = 23;
}

/// Fields of `TensorProto`.
pub(super) mod tensor_field {
    pub(in crate::inspect) const DIMS: u64 = 1;
    pub(in crate::inspect) const DATA_TYPE: u64 = 2;
    pub(in crate::inspect) const FLOAT_DATA: u64 = 4;
    pub(in crate::inspect) const INT32_DATA: u64 = 5;
    pub(in crate::inspect) const INT64_DATA: u64 = 7;
    pub(in crate::inspect) const NAME: u64 = 8;
    pub(in crate::inspect) const RAW_DATA: u64 = 9;
    pub(in crate::inspect) const EXTERNAL_DATA: u64 = 13;
    pub(in crate::inspect) const DATA_LOCATION: u64 = 14;
}

/// An operator with random results, unless its third input is absent or false.
pub(super) const DROPOUT: &str = "Dropout";

/// Operators whose results differ from run to run, so that no decision could be repeated.
const RANDOM: &str = "Bernoulli Multinomial RandomNormal RandomNormalLike RandomUniform \
                      RandomUniformLike";

/// Returns whether an operator is in a list of names with spaces between them.
pub(super) fn is_in(list: &str, operator: &str) -> bool {
    list.split(' ').any(|listed| listed == operator)
}

/// Returns whether a domain is that of the standard operators.
pub(super) fn is_standard(domain: &str) -> bool {
    matches!(domain, "" | "ai.onnx")
}

pub(super) fn random(operator: &str) -> InspectError {
    InspectError::Random { operator: operator.to_owned() }
}

pub(super) fn check_depth(depth: usize) -> Result<(), InspectError> {
    if depth > MAX_DEPTH { Err(InspectError::TooDeep { max: MAX_DEPTH }) } else { Ok(()) }
}

pub(super) fn check_operator(domain: &str, operator: &str) -> Result<(), InspectError> {
    if is_in(RANDOM, operator) {
        return Err(random(operator));
    }
    if is_standard(domain) {
        return Ok(());
    }
    Err(InspectError::Domain { domain: domain.to_owned(), operator: operator.to_owned() })
}

/// Checks the type of a value: types of sequences and options are nested, too.
pub(super) fn check_value(value: WireField<'_>) -> Result<(), InspectError> {
    value.fields()?.of(&[2]).try_for_each(|field| check_type(field?, 0))
}

pub(super) fn check_type(type_field: WireField<'_>, depth: usize) -> Result<(), InspectError> {
    check_depth(depth)?;
    for field in type_field.fields()? {
        let field = field?;
        // Of the types, those of sequences, maps and options contain a further one.
        let inner: &[u64] = match field.number {
            1 => {
                check_tensor_type(field)?;
                continue;
            }
            4 | 9 => &[1],
            5 => &[2],
            _ => continue,
        };
        field.fields()?.of(inner).try_for_each(|field| check_type(field?, depth + 1))?;
    }
    Ok(())
}

/// Checks that the dimensions of the type of a tensor are messages.
fn check_tensor_type(tensor: WireField<'_>) -> Result<(), InspectError> {
    for shape in tensor.fields()?.of(&[2]) {
        for dimension in shape?.fields()? {
            dimension?.fields()?.try_for_each(|field| field.map(drop))?;
        }
    }
    Ok(())
}
