//! Runs models by rten, a library that is part of this program. It uses the processor only, and a
//! run cannot be interrupted.
//!
//! It computes in `f32`, `i32`, `i8` and `u8`: other types are converted at the edge.

use std::borrow::Cow;
use std::sync::Arc;

use gleaner_protocol::inference::Element;
use rten::{Model, ModelOptions, NodeId, RunOptions, ThreadPool, Value, ValueOrView, ValueView};
use rten_gemm::GemmExecutor;
use rten_tensor::{Layout, Tensor, TensorView};

use super::elements::{floats, from_floats, from_integers, integers, numbers};
use super::{Backend, BackendError, LoadOptions, LoadedGraph, StopSignal, TensorValue};
use crate::inspect::{OutputInfo, RtenFinding, RtenRuleKind};

/// The version of rten, as the workspace pins it.
const VERSION: &str = "rten 0.27.0";

#[derive(Debug, Clone, Copy, Default)]
pub struct RtenBackend;

struct RtenGraph {
    model: Model,
    pool: Arc<ThreadPool>,
    inputs: Vec<NodeId>,
    outputs: Vec<(NodeId, OutputInfo)>,
    /// The reason why a run with a NaN is refused.
    hides_nan: Option<String>,
}

impl Backend for RtenBackend {
    fn version(&self) -> String {
        VERSION.to_owned()
    }

    fn load(
        &self,
        model: Vec<u8>,
        options: &LoadOptions<'_>,
    ) -> Result<Box<dyn LoadedGraph>, BackendError> {
        let signature = options.signature;
        let outputs = signature.outputs.iter().map(|output| &output.tensor);
        if let Some(info) =
            signature.inputs.iter().chain(outputs).find(|it| it.element == Element::Int16)
        {
            let (name, element) = (&info.name, info.element);
            return Err(BackendError::new(format_args!(
                "`{name}` has elements of type {element}, which rten does not support"
            )));
        }
        let refuses = |finding: &&RtenFinding| match finding.kind {
            RtenRuleKind::Model => true,
            RtenRuleKind::Processor => products_saturate(),
            RtenRuleKind::Nan => false,
        };
        match signature.rten.iter().find(refuses) {
            Some(finding) => Err(BackendError::new(&finding.message)),
            None => load(model, options),
        }
    }
}

/// Loads a graph, whatever its operators are.
fn load(model: Vec<u8>, options: &LoadOptions<'_>) -> Result<Box<dyn LoadedGraph>, BackendError> {
    let signature = options.signature;
    let model = ModelOptions::with_all_ops().load(model).map_err(BackendError::new)?;
    let node = |name: &str| model.node_id(name).map_err(BackendError::new);
    let inputs = signature.inputs.iter().map(|info| node(&info.name)).collect::<Result<_, _>>()?;
    let outputs = signature.outputs.iter();
    let outputs = outputs
        .map(|info| Ok((node(&info.tensor.name)?, info.clone())))
        .collect::<Result<_, BackendError>>()?;
    let hides_nan = signature.rten.iter().find(|finding| finding.kind == RtenRuleKind::Nan);
    let hides_nan = hides_nan.map(|finding| finding.message.clone());
    let pool = Arc::new(ThreadPool::with_num_threads(options.threads as usize));
    Ok(Box::new(RtenGraph { model, pool, inputs, outputs, hides_nan }))
}

impl LoadedGraph for RtenGraph {
    fn run(
        &mut self,
        inputs: &[TensorValue],
        _stop: &StopSignal,
    ) -> Result<Vec<TensorValue>, BackendError> {
        if let Some(reason) = self.hides_nan.as_ref().filter(|_| inputs.iter().any(has_nan)) {
            return Err(BackendError::new(format_args!("an input has a NaN: {reason}")));
        }
        let values =
            self.inputs.iter().zip(inputs).map(|(node, input)| Ok((*node, value_of(input)?)));
        let values = values.collect::<Result<Vec<_>, BackendError>>()?;
        let nodes: Vec<NodeId> = self.outputs.iter().map(|(node, _)| *node).collect();
        let options = RunOptions::default().with_thread_pool(Some(Arc::clone(&self.pool)));
        let results = self.model.run(values, &nodes, Some(options)).map_err(BackendError::new)?;
        let infos = self.outputs.iter().map(|(_, info)| info);
        infos.zip(results).map(|(info, value)| output_of(info, value)).collect()
    }
}

/// Returns whether products of 8-bit integers are inexact on this processor.
fn products_saturate() -> bool {
    GemmExecutor::<u8, i8, i32>::default().may_saturate()
}

fn has_nan(input: &TensorValue) -> bool {
    let is_float = matches!(input.element, Element::Float32 | Element::Float16 | Element::Float64);
    let values = is_float.then(|| floats(input.element, &input.bytes).ok()).flatten();
    values.is_some_and(|values| values.iter().any(|value| value.is_nan()))
}

fn value_of(input: &TensorValue) -> Result<ValueOrView<'_>, BackendError> {
    let shape: Vec<usize> = input.shape.iter().map(|length| *length as usize).collect();
    let bytes = &input.bytes;
    match input.element {
        element @ (Element::Float32 | Element::Float16 | Element::Float64) => {
            tensor(&shape, floats(element, bytes)?)
        }
        element @ (Element::Int32 | Element::Int64 | Element::Boolean) => {
            tensor(&shape, integers(element, bytes)?)
        }
        Element::Int8 => tensor(&shape, numbers::<i8>(bytes)),
        Element::Uint8 => tensor(&shape, numbers::<u8>(bytes)),
        element @ Element::Int16 => {
            Err(BackendError::new(format_args!("rten does not support {element}")))
        }
    }
}

fn tensor<'a, T: Clone>(
    shape: &[usize],
    data: Cow<'a, [T]>,
) -> Result<ValueOrView<'a>, BackendError>
where
    ValueView<'a>: From<TensorView<'a, T>>,
    Value: From<Tensor<T>>,
{
    match data {
        Cow::Borrowed(data) => {
            ValueView::from_shape(shape, data).map(ValueOrView::View).map_err(BackendError::new)
        }
        Cow::Owned(data) => {
            Value::from_shape(shape, data).map(ValueOrView::Value).map_err(BackendError::new)
        }
    }
}

fn output_of(output: &OutputInfo, value: Value) -> Result<TensorValue, BackendError> {
    let info = &output.tensor;
    let lengths = value.shape();
    if output.has_shape && lengths.len() != info.shape.len() {
        let (name, declared, found) = (&info.name, info.shape.len(), lengths.len());
        return Err(BackendError::new(format_args!(
            "output `{name}` is declared with {declared} dimensions, and rten returned {found}"
        )));
    }
    let lengths = lengths.iter().map(|length| u32::try_from(*length));
    let shape = lengths.collect::<Result<Vec<_>, _>>().map_err(BackendError::new)?;
    let element = info.element;
    let bytes = match (element, value) {
        (Element::Float32 | Element::Float16 | Element::Float64, Value::FloatTensor(tensor)) => {
            from_floats(element, &tensor.into_data())
        }
        (Element::Int32 | Element::Int64 | Element::Boolean, Value::Int32Tensor(tensor)) => {
            from_integers(element, &tensor.into_data())
        }
        (Element::Int8, Value::Int8Tensor(tensor)) => {
            tensor.into_data().into_iter().map(i8::cast_unsigned).collect()
        }
        (Element::Uint8, Value::UInt8Tensor(tensor)) => tensor.into_data(),
        (_, other) => {
            let (name, found) = (&info.name, other.dtype());
            return Err(BackendError::new(format_args!(
                "output `{name}` is declared as {element}, and rten returned {found}"
            )));
        }
    };
    Ok(TensorValue { element, shape, bytes })
}

#[cfg(test)]
mod tests;
