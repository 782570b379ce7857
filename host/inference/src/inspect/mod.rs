//! Checks a model before a library parses it, and reads its inputs and outputs.
//!
//! - `wire`: fields of protobuf messages.
//! - `graph`: fields of graphs, operators, types and depth.
//! - `signature`: inputs and outputs.
//! - `facts`: nodes, constants and what is declared of values, with their checks.
//! - `rten_rules`: results of rten that are wrong.
//!
//! These are own checks: the types of `rten-onnx` copy all weights, take memory for a length before
//! they compare it with the file, follow subgraphs to any depth, and have no functions and no
//! sparse tensors.

mod facts;
mod graph;
mod rten_rules;
mod signature;
#[cfg(test)]
mod tests;
mod wire;

use gleaner_protocol::inference::Element;

use facts::{GraphFacts, check_function};
use wire::{NoMessage, WireField, WireFields};

pub use rten_rules::{RTEN_RULES, RtenFinding, RtenRule, RtenRuleKind};
pub use signature::{ModelSignature, OutputInfo};

/// Oldest version of the standard operators that is accepted.
const OLDEST_OPSET: i64 = 7;
/// Newest version of the standard operators of which rten has some.
const NEWEST_OPSET: i64 = 24;

/// Largest number of inputs and of outputs.
const MAX_TENSORS: usize = 256;

/// Keys of the metadata that describe a detector; Ultralytics writes them.
const METADATA: [&str; 5] = ["task", "head", "stride", "end2end", "names"];

/// Most bytes of their values, so that they fit into a message; the names of COCO have 1.3 kB.
const METADATA_MAX: usize = 16 << 10;

/// Fields of `ModelProto`.
mod model_field {
    pub(super) const IR_VERSION: u64 = 1;
    pub(super) const GRAPH: u64 = 7;
    pub(super) const OPSET: u64 = 8;
    pub(super) const METADATA: u64 = 14;
    pub(super) const FUNCTIONS: u64 = 25;
}

/// The reason why a model is refused before it is loaded.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum InspectError {
    #[error("it is not an ONNX model: it is not a protobuf message with a version and a graph")]
    NoModel,
    #[error("its graphs are nested more than {max} deep")]
    TooDeep { max: usize },
    #[error("it has operator `{operator}` of domain `{domain}`; only standard operators can run")]
    Domain { domain: String, operator: String },
    #[error("it has operator `{operator}`, whose random results no replay could repeat")]
    Random { operator: String },
    #[error(
        "it needs version {version} of the standard operators; versions {OLDEST_OPSET} to \
         {NEWEST_OPSET} can run"
    )]
    Opset { version: i64 },
    #[error("it does not name the version of the standard operators")]
    NoOpset,
    #[error(
        "the data of tensor `{tensor}` is in another file, `{location}`; save the model with its \
         data in one file"
    )]
    ExternalData { tensor: String, location: String },
    #[error("it has more than the {MAX_TENSORS} {what} that are allowed")]
    TooMany { what: &'static str },
    #[error("{what} `{name}` is {found}; a lambda can use tensors of numbers and booleans")]
    NoTensor { what: &'static str, name: String, found: &'static str },
    #[error("{what} `{name}` has elements of type {found}; supported are {}", elements())]
    Element { what: &'static str, name: String, found: String },
    #[error("{what} `{name}` has no declared {lacks}; export the model with it")]
    Undeclared { what: &'static str, name: String, lacks: &'static str },
    #[error("{what} `{name}` has a length of {length} in dimension {dimension}")]
    Length { what: &'static str, name: String, dimension: usize, length: i64 },
    #[error("{what} `{name}` has {found} dimensions; {max} are allowed")]
    Dimensions { what: &'static str, name: String, found: usize, max: usize },
    #[error("two {what}s have the name `{name}`")]
    Twice { what: &'static str, name: String },
}

impl From<NoMessage> for InspectError {
    fn from(_: NoMessage) -> InspectError {
        InspectError::NoModel
    }
}

fn elements() -> String {
    Element::ALL.map(Element::name).join(", ")
}

/// Checks the file of a model, and returns its inputs and outputs.
pub fn inspect(model: &[u8]) -> Result<ModelSignature, InspectError> {
    let (mut graph, mut has_version, mut opset) = (None, false, None);
    let (mut has_functions, mut metadata, mut metadata_bytes) = (false, Vec::new(), 0);
    for field in WireFields(model) {
        let field = field?;
        match field.number {
            model_field::IR_VERSION => has_version = field.number().is_ok(),
            model_field::GRAPH if graph.is_none() => graph = Some(field.bytes()?),
            // Libraries would disagree on which of two counts.
            model_field::GRAPH => return Err(InspectError::NoModel),
            model_field::OPSET => {
                let (domain, version) = entry_of(field.fields()?)?;
                let version = version.map_or(Ok(0), |it| it.number())?;
                if graph::is_standard(domain) {
                    opset = Some(version);
                }
            }
            model_field::METADATA => {
                let (key, value) = entry_of(field.fields()?)?;
                // Only the values of known keys are read.
                let value = value.and_then(|it| it.text().ok()).unwrap_or_default();
                let is_plain = !value.contains(char::is_control);
                let is_read = is_plain && METADATA.contains(&key);
                metadata_bytes += if is_read { value.len() } else { 0 };
                if is_read && metadata_bytes <= METADATA_MAX {
                    metadata.push((key.to_owned(), value.to_owned()));
                }
            }
            model_field::FUNCTIONS => {
                has_functions = true;
                check_function(field.bytes()?)?;
            }
            _ => {}
        }
    }
    let graph = graph.filter(|_| has_version).ok_or(InspectError::NoModel)?;
    let mut facts = GraphFacts::default();
    facts.add(graph, 0)?;
    // After the operators: a model of foreign ones only may import no others.
    facts.opset = match opset {
        Some(version @ OLDEST_OPSET..=NEWEST_OPSET) => version,
        Some(version) => return Err(InspectError::Opset { version }),
        None => return Err(InspectError::NoOpset),
    };
    let signature = ModelSignature::of(graph)?;
    let rten = rten_rules::findings(&facts, has_functions);
    Ok(ModelSignature { rten, metadata, ..signature })
}

/// Returns the key of an entry, and the field with its value.
fn entry_of(fields: WireFields<'_>) -> Result<(&str, Option<WireField<'_>>), NoMessage> {
    let (mut key, mut value) = ("", None);
    for field in fields {
        let field = field?;
        match field.number {
            1 => key = field.text()?,
            2 => value = Some(field),
            _ => {}
        }
    }
    Ok((key, value))
}
