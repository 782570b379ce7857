//! Runs models by rten, a library that is part of this program. It uses the processor only, and a
//! run cannot be interrupted.
//!
//! It computes in `f32`, `i32`, `i8` and `u8`: other types are converted at the edge.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::sync::Arc;

use gleaner_protocol::inference::{Element, TensorInfo};
use rten::{Model, ModelOptions, NodeId, RunOptions, ThreadPool, Value, ValueOrView, ValueView};
use rten_gemm::GemmExecutor;
use rten_tensor::{Layout, Tensor, TensorView};

use super::elements::{floats, from_floats, from_integers, integers, numbers};
use super::{Backend, BackendError, LoadOptions, LoadedGraph, StopSignal, TensorValue};

/// The version of rten, as the workspace pins it.
const VERSION: &str = "rten 0.27.0";

/// Operators that multiply 8-bit integers.
const CONVOLUTION: &str = "ConvInteger";
const PRODUCT: &str = "MatMulInteger";

/// The backend of rten.
#[derive(Debug, Clone, Copy, Default)]
pub struct RtenBackend;

struct RtenGraph {
    model: Model,
    pool: Arc<ThreadPool>,
    inputs: Vec<NodeId>,
    outputs: Vec<(NodeId, TensorInfo)>,
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
        if let Some((operator, why)) = inexact(&signature.operators) {
            return Err(BackendError::new(format_args!(
                "it has operator `{operator}`, which rten computes inexactly {why}; use ONNX \
                 Runtime, or a model of floats"
            )));
        }
        load(model, options)
    }
}

/// Returns an operator whose results would be wrong, without an error, and where.
fn inexact(operators: &BTreeSet<String>) -> Option<(&'static str, &'static str)> {
    // It pads with 0 in place of the zero point of its input, so that a usual quantized detector
    // misses objects.
    if operators.contains(CONVOLUTION) {
        return Some((CONVOLUTION, "at padded edges"));
    }
    // On x86-64 without VNNI, sums of two products saturate in 16 bits.
    let saturates = operators.contains(PRODUCT) && products_saturate();
    saturates.then_some((PRODUCT, "on this processor, as that lacks VNNI"))
}

/// Loads a graph, whatever its operators are.
fn load(model: Vec<u8>, options: &LoadOptions<'_>) -> Result<Box<dyn LoadedGraph>, BackendError> {
    let signature = options.signature;
    let outputs = signature.outputs.iter().map(|output| &output.tensor);
    let model = ModelOptions::with_all_ops().load(model).map_err(BackendError::new)?;
    let node = |name: &str| model.node_id(name).map_err(BackendError::new);
    let inputs = signature.inputs.iter().map(|info| node(&info.name)).collect::<Result<_, _>>()?;
    let outputs = outputs
        .map(|info| Ok((node(&info.name)?, info.clone())))
        .collect::<Result<_, BackendError>>()?;
    let pool = Arc::new(ThreadPool::with_num_threads(options.threads as usize));
    Ok(Box::new(RtenGraph { model, pool, inputs, outputs }))
}

impl LoadedGraph for RtenGraph {
    fn run(
        &mut self,
        inputs: &[TensorValue],
        _stop: &StopSignal,
    ) -> Result<Vec<TensorValue>, BackendError> {
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

fn output_of(info: &TensorInfo, value: Value) -> Result<TensorValue, BackendError> {
    let lengths = value.shape();
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
mod tests {
    use super::*;
    use crate::inspect::inspect;
    use crate::onnx::{INT8, INT32, UINT8, constant, graph, model, node, numbers_attribute, value};

    const ZERO_POINTS: [(&str, i32); 2] = [("za", 10), ("zb", 128)];

    /// A product of two 8-bit matrices with zero points.
    fn product([rows, inner, columns]: [i64; 3]) -> Vec<u8> {
        let zero_points =
            ZERO_POINTS.map(|(name, value)| constant(name, UINT8, &[], &[value as u8]));
        model(&graph(
            &[node("MatMulInteger", &["a", "b", "za", "zb"], &["y"], &[])],
            &zero_points,
            &[value("a", UINT8, &[rows, inner]), value("b", UINT8, &[inner, columns])],
            &[value("y", INT32, &[rows, columns])],
        ))
    }

    /// A convolution of 2 x 2 values in 2 channels with weights of 1, padded by one. The zero point
    /// is 10.
    fn padded_convolution() -> Vec<u8> {
        let constants =
            [constant("w", INT8, &[1, 2, 3, 3], &[1; 18]), constant("z", UINT8, &[], &[10])];
        let attributes = [("pads", 4), ("strides", 2), ("dilations", 2)]
            .map(|(name, length)| numbers_attribute(name, &vec![1; length]));
        model(&graph(
            &[node("ConvInteger", &["x", "w", "z"], &["y"], &attributes)],
            &constants,
            &[value("x", UINT8, &[1, 2, 2, 2])],
            &[value("y", INT32, &[1, 1, 2, 2])],
        ))
    }

    /// Calls `test` with the options to load a model.
    fn with_options<T>(model: &[u8], test: impl FnOnce(&LoadOptions<'_>) -> T) -> T {
        let signature = inspect(model).unwrap();
        let provider = super::super::ExecutionProvider::Cpu;
        test(&LoadOptions { provider, threads: 1, signature: &signature, engine: None })
    }

    #[test]
    fn convolutions_of_8_bit_integers_are_refused() {
        let bytes = padded_convolution();
        let refused =
            with_options(&bytes, |options| RtenBackend.load(bytes.clone(), options).err());
        assert_eq!(
            refused.unwrap().to_string(),
            "it has operator `ConvInteger`, which rten computes inexactly at padded edges; use \
             ONNX Runtime, or a model of floats"
        );
    }

    /// If this fails after an update of rten, its convolutions need not be refused any more.
    #[test]
    fn rten_still_pads_convolutions_of_8_bit_integers_with_another_value() {
        let bytes = padded_convolution();
        let mut graph = with_options(&bytes, |options| load(bytes.clone(), options).unwrap());
        let zeros =
            TensorValue { element: Element::Uint8, shape: vec![1, 2, 2, 2], bytes: vec![10; 8] };
        let outputs = graph.run(&[zeros], &StopSignal::default()).unwrap();
        println!("{:?}", outputs[0].bytes);
        assert_ne!(outputs[0].bytes, [0; 16]);
    }

    #[test]
    fn products_of_8_bit_integers_are_exact_or_refused() {
        // Multiples of the tiles of rten, and numbers that are none.
        for shape in [[8, 64, 32], [7, 67, 33], [1, 18, 5], [1, 3, 1]] {
            let bytes = product(shape);
            let loaded = with_options(&bytes, |options| RtenBackend.load(bytes.clone(), options));
            let mut graph = match loaded {
                Ok(graph) => graph,
                Err(error) => {
                    assert!(products_saturate(), "{error}");
                    return assert!(error.to_string().contains("`MatMulInteger`"), "{error}");
                }
            };
            let [rows, inner, columns] = shape.map(|length| length as usize);
            let matrix = |rows: usize, columns: usize| TensorValue {
                element: Element::Uint8,
                shape: vec![rows as u32, columns as u32],
                // The largest value is among them.
                bytes: (0..rows * columns).map(|index| 255 - (index * 37 % 251) as u8).collect(),
            };
            let (a, b) = (matrix(rows, inner), matrix(inner, columns));
            let [za, zb] = ZERO_POINTS.map(|(_, value)| value);
            let dot = |index: usize| -> i32 {
                let (row, column) = (index / columns, index % columns);
                let product = |k| {
                    let a = i32::from(a.bytes[row * inner + k]) - za;
                    a * (i32::from(b.bytes[k * columns + column]) - zb)
                };
                (0..inner).map(product).sum()
            };
            let expected: Vec<u8> =
                (0..rows * columns).flat_map(|index| dot(index).to_le_bytes()).collect();
            let outputs = graph.run(&[a.clone(), b.clone()], &StopSignal::default()).unwrap();
            assert!(outputs[0].bytes == expected, "{shape:?}");
        }
    }
}
