//! Reads the inputs and outputs of a model.

use std::collections::HashSet;

use gleaner_protocol::inference::{Element, MAX_DIMENSIONS, TensorInfo};

use super::graph::{graph_field, tensor_field};
use super::rten_rules::RtenFinding;
use super::wire::{NoMessage, WireField, WireFields};
use super::{InspectError, MAX_TENSORS};

/// Names of the types of elements, in the order of their numbers in ONNX, which begin with 1.
const ELEMENTS: &str = "float32 uint8 int8 uint16 int16 int32 int64 string boolean \
                        float16 float64 uint32 uint64 complex64 complex128 bfloat16";

/// The inputs and outputs of a model, as its file declares them.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ModelSignature {
    /// Its inputs, without those that have a default value.
    pub inputs: Vec<TensorInfo>,
    pub outputs: Vec<OutputInfo>,
    /// Rules of rten that hold for it.
    pub rten: Vec<RtenFinding>,
    /// Entries of its metadata that describe a detector, by key.
    pub metadata: Vec<(String, String)>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutputInfo {
    /// Name, type and shape; an empty shape if it is not declared.
    pub tensor: TensorInfo,
    /// True if the number of dimensions is declared.
    pub has_shape: bool,
}

pub(super) struct DeclaredValue<'a> {
    pub(super) name: &'a str,
    pub(super) tensor: Option<DeclaredTensor>,
    /// Name of its type, if it is no tensor.
    other: Option<&'static str>,
}

#[derive(Default)]
pub(super) struct DeclaredTensor {
    pub(super) element: Option<i64>,
    /// The first lengths, as many as a tensor may have.
    pub(super) shape: Option<Vec<i64>>,
    /// Number of dimensions, also of those that `shape` leaves out.
    pub(super) dimensions: usize,
}

impl ModelSignature {
    /// Reads the inputs and outputs of a graph.
    pub(super) fn of(graph: &[u8]) -> Result<ModelSignature, InspectError> {
        // Constants first: older models declare each as an input, too.
        let constants = WireFields(graph).of(&[graph_field::INITIALIZER]);
        let constants: HashSet<&str> =
            constants.map(|tensor| name_of_tensor(tensor?)).collect::<Result<_, _>>()?;
        let (mut inputs, mut outputs) = (Vec::new(), Vec::new());
        for field in WireFields(graph) {
            let field = field?;
            let (what, list) = match field.number {
                graph_field::INPUT => ("inputs", &mut inputs),
                graph_field::OUTPUT => ("outputs", &mut outputs),
                _ => continue,
            };
            let declared = DeclaredValue::of(field)?;
            if what == "inputs" && constants.contains(declared.name) {
                continue;
            }
            if list.len() == MAX_TENSORS {
                return Err(InspectError::TooMany { what });
            }
            list.push(declared);
        }
        let inputs = inputs.iter().map(|input| {
            let found = input.info("input")?;
            match found.has_shape {
                true => Ok(found.tensor),
                false => Err(undeclared("input", input.name, "shape")),
            }
        });
        let inputs: Vec<TensorInfo> = inputs.collect::<Result<_, InspectError>>()?;
        let outputs: Vec<OutputInfo> =
            outputs.iter().map(|output| output.info("output")).collect::<Result<_, _>>()?;
        distinct("input", inputs.iter().map(|info| info.name.as_str()))?;
        distinct("output", outputs.iter().map(|info| info.tensor.name.as_str()))?;
        Ok(ModelSignature { inputs, outputs, ..ModelSignature::default() })
    }
}

fn distinct<'a>(
    what: &'static str,
    names: impl Iterator<Item = &'a str>,
) -> Result<(), InspectError> {
    let mut seen = HashSet::new();
    match names.into_iter().find(|name| !seen.insert(*name)) {
        Some(name) => Err(InspectError::Twice { what, name: name.to_owned() }),
        None => Ok(()),
    }
}

fn undeclared(what: &'static str, name: &str, lacks: &'static str) -> InspectError {
    InspectError::Undeclared { what, name: name.to_owned(), lacks }
}

fn name_of_tensor<'a>(tensor: WireField<'a>) -> Result<&'a str, NoMessage> {
    tensor.fields()?.of(&[tensor_field::NAME]).try_fold("", |_, name| name?.text())
}

impl<'a> DeclaredValue<'a> {
    pub(super) fn of(value: WireField<'a>) -> Result<Self, NoMessage> {
        let mut declared = DeclaredValue { name: "", tensor: None, other: None };
        for field in value.fields()? {
            let field = field?;
            match field.number {
                1 => declared.name = field.text()?,
                2 => {
                    for field in field.fields()? {
                        let field = field?;
                        match field.number {
                            1 => declared.tensor = Some(DeclaredTensor::of(field)?),
                            4 => declared.other = Some("a sequence"),
                            5 => declared.other = Some("a map"),
                            8 => declared.other = Some("a sparse tensor"),
                            9 => declared.other = Some("optional"),
                            _ => {}
                        }
                    }
                }
                _ => {}
            }
        }
        Ok(declared)
    }

    fn info(&self, what: &'static str) -> Result<OutputInfo, InspectError> {
        let name = || self.name.to_owned();
        if let Some(found) = self.other {
            return Err(InspectError::NoTensor { what, name: name(), found });
        }
        let lacks = |lacks| undeclared(what, self.name, lacks);
        let tensor = self.tensor.as_ref().ok_or_else(|| lacks("type"))?;
        let number = tensor.element.ok_or_else(|| lacks("type"))?;
        let mut elements = (1..).zip(ELEMENTS.split(' '));
        let found = elements.find(|(known, _)| *known == number).map(|(_, name)| name);
        let is_it = |element: &Element| found == Some(element.name());
        let Some(element) = Element::ALL.into_iter().find(is_it) else {
            let found = found.map_or_else(|| number.to_string(), str::to_owned);
            return Err(InspectError::Element { what, name: name(), found });
        };
        let lengths = tensor.shape.as_deref().unwrap_or_default();
        if tensor.dimensions > MAX_DIMENSIONS {
            let (found, max) = (tensor.dimensions, MAX_DIMENSIONS);
            return Err(InspectError::Dimensions { what, name: name(), found, max });
        }
        let shape = lengths.iter().enumerate().map(|(dimension, length)| match *length {
            ANY => Ok(None),
            length => match u32::try_from(length) {
                Ok(known @ 1..) => Ok(Some(known)),
                _ => Err(InspectError::Length { what, name: name(), dimension, length }),
            },
        });
        let shape = shape.collect::<Result<_, _>>()?;
        let tensor_info = TensorInfo { name: name(), element, shape };
        Ok(OutputInfo { tensor: tensor_info, has_shape: tensor.shape.is_some() })
    }
}

/// A length that is not declared. Some programs write -1 for it.
const ANY: i64 = -1;

impl DeclaredTensor {
    fn of(tensor: WireField<'_>) -> Result<Self, NoMessage> {
        let mut declared = DeclaredTensor::default();
        for field in tensor.fields()? {
            let field = field?;
            match field.number {
                1 => declared.element = Some(field.number()?),
                2 => {
                    let shape = declared.shape.get_or_insert_default();
                    for dimension in field.fields()?.of(&[1]) {
                        let length = length_of(dimension?.fields()?)?;
                        declared.dimensions += 1;
                        if declared.dimensions <= MAX_DIMENSIONS {
                            shape.push(length);
                        }
                    }
                }
                _ => {}
            }
        }
        Ok(declared)
    }
}

fn length_of(dimension: WireFields<'_>) -> Result<i64, NoMessage> {
    let mut length = ANY;
    for field in dimension {
        let field = field?;
        match field.number {
            1 => length = field.number()?,
            2 => length = ANY,
            _ => {}
        }
    }
    Ok(length)
}
