//! Tests of the rules: each refuses a model that this version of rten computes wrongly.

use super::*;
use crate::backend::ExecutionProvider;
use crate::backend::elements::bytes;
use crate::inspect::{ModelSignature, inspect};
use gleaner_test_support::onnx::{
    BOOL, FLOAT32, INT8, INT32, INT64, Proto, UINT8, constant, graph, model_with_opset, node,
    number_attribute, number_of, numbers_attribute, value, value_of,
};

const ZERO_POINTS: [(&str, i32); 2] = [("za", 10), ("zb", 128)];

/// A model of one node, its input, and its right output.
struct Wrong {
    operator: &'static str,
    opset: i64,
    attributes: Vec<Proto>,
    input: TensorValue,
    /// Constants after the input; one with an empty name is absent.
    constants: Vec<(&'static str, Proto)>,
    right: TensorValue,
}

fn floats_of(shape: &[u32], values: &[f32]) -> TensorValue {
    TensorValue { element: Element::Float32, shape: shape.to_vec(), bytes: bytes(values) }
}

fn float(value: f32) -> TensorValue {
    floats_of(&[1], &[value])
}

fn wide(shape: &[u32], values: &[i64]) -> TensorValue {
    TensorValue { element: Element::Int64, shape: shape.to_vec(), bytes: bytes(values) }
}

fn text_attribute(name: &str, text: &str) -> Proto {
    Proto::default().text(1, name).text(4, text).number(20, 3)
}

fn floats_constant(name: &str, shape: &[i64], values: &[f32]) -> Proto {
    constant(name, FLOAT32, shape, &bytes(values))
}

fn wide_constant(name: &str, shape: &[i64], values: &[i64]) -> Proto {
    constant(name, INT64, shape, &bytes(values))
}

impl Wrong {
    fn new(operator: &'static str, input: TensorValue, right: TensorValue) -> Self {
        let (attributes, constants) = (Vec::new(), Vec::new());
        Self { operator, opset: 17, attributes, input, constants, right }
    }

    fn with(mut self, attributes: &[Proto]) -> Self {
        self.attributes.extend_from_slice(attributes);
        self
    }

    fn and(mut self, name: &'static str, constant: Proto) -> Self {
        self.constants.push((name, constant));
        self
    }

    /// The model, whose output has no declared shape.
    fn model(&self) -> Vec<u8> {
        let shape: Vec<i64> = self.input.shape.iter().map(|it| i64::from(*it)).collect();
        let names: Vec<&str> = self.constants.iter().map(|(name, _)| *name).collect();
        let inputs = [&["x"], &names[..]].concat();
        let constants: Vec<Proto> =
            self.constants.iter().filter(|it| !it.0.is_empty()).map(|it| it.1.clone()).collect();
        let output = Proto::default().number(1, number_of(self.right.element));
        let graph = graph(
            &[node(self.operator, &inputs, &["y"], &self.attributes)],
            &constants,
            &[value("x", number_of(self.input.element), &shape)],
            &[value_of("y", &output)],
        );
        model_with_opset(&graph, self.opset)
    }
}

fn load_as(model: &[u8], signature: ModelSignature) -> Result<Box<dyn LoadedGraph>, BackendError> {
    let provider = ExecutionProvider::Cpu;
    let options = LoadOptions { provider, threads: 1, signature: &signature, engine: None };
    RtenBackend.load(model.to_vec(), &options)
}

fn load(model: &[u8]) -> Result<Box<dyn LoadedGraph>, BackendError> {
    load_as(model, inspect(model).unwrap())
}

fn refusal(model: &[u8]) -> String {
    load(model).err().unwrap().to_string()
}

/// Loads a model without the rules.
fn load_unchecked(model: &[u8]) -> Box<dyn LoadedGraph> {
    load_as(model, ModelSignature { rten: Vec::new(), ..inspect(model).unwrap() }).unwrap()
}

fn same_lower(kernel: [i64; 2]) -> [Proto; 3] {
    [
        text_attribute("auto_pad", "SAME_LOWER"),
        numbers_attribute("kernel_shape", &kernel),
        numbers_attribute("strides", &[1, 1]),
    ]
}

/// Models of all rules but those of `Nan` and `Processor`.
fn wrong_models() -> Vec<Wrong> {
    let row = || floats_of(&[1, 1, 1, 2], &[1.0, 2.0]);
    let row_of = |values: [f32; 2]| floats_of(&[1, 1, 1, 2], &values);
    let ones = || floats_constant("w", &[1, 1, 1, 2], &[1.0, 1.0]);
    let zeros = || floats_of(&[1, 2, 2], &[0.0; 4]);
    // A, B and C, the best: each overlaps the next by 0.6. C suppresses B, which leaves A.
    let boxes = [0.0, 0.0, 4.0, 10.0, 0.0, 2.5, 4.0, 12.5, 0.0, 5.0, 4.0, 15.0];
    let old = |wrong: Wrong| Wrong { opset: 9, ..wrong };
    let byte = |value: u8| TensorValue {
        element: Element::Uint8,
        shape: vec![1, 2, 2, 2],
        bytes: vec![value; 8],
    };
    let sums = TensorValue { element: Element::Int32, shape: vec![1, 1, 2, 2], bytes: vec![0; 16] };
    let yes = TensorValue { element: Element::Boolean, shape: vec![1], bytes: vec![1] };
    vec![
        Wrong::new(
            "NonMaxSuppression",
            floats_of(&[1, 3, 4], &boxes),
            wide(&[2, 3], &[0, 0, 2, 0, 0, 0]),
        )
        .and("scores", floats_constant("scores", &[1, 1, 3], &[0.7, 0.8, 0.9]))
        .and("count", wide_constant("count", &[], &[3]))
        .and("overlap", floats_constant("overlap", &[], &[0.5])),
        // Weights of a quarter of a pixel at a = -0.75, from the text of the operator.
        Wrong::new(
            "Resize",
            row_of([0.0, 1.0]),
            floats_of(&[1, 1, 1, 4], &[-0.105_468_75, 0.226_562_5, 0.773_437_5, 1.105_468_8]),
        )
        .with(&[text_attribute("mode", "cubic")])
        .and("", Proto::default())
        .and("scales", floats_constant("scales", &[4], &[1.0, 1.0, 1.0, 2.0])),
        old(Wrong::new("Softmax", zeros(), floats_of(&[1, 2, 2], &[0.25; 4]))),
        old(Wrong::new(
            "LogSoftmax",
            zeros(),
            floats_of(&[1, 2, 2], &[-std::f32::consts::LN_2 * 2.0; 4]),
        )),
        Wrong::new("ArgMax", floats_of(&[2], &[1.0, 1.0]), wide(&[1], &[0])),
        Wrong::new("ArgMin", floats_of(&[2], &[1.0, 1.0]), wide(&[1], &[0])),
        // Padded in front of the row.
        Wrong::new("Conv", row(), row_of([1.0, 3.0])).with(&same_lower([1, 2])).and("w", ones()),
        Wrong::new("MaxPool", row(), row_of([1.0, 2.0])).with(&same_lower([1, 2])),
        Wrong::new("AveragePool", row(), row_of([1.0, 1.5])).with(&same_lower([1, 2])),
        // All values are the zero point.
        Wrong::new("ConvInteger", byte(10), sums)
            .with(&[numbers_attribute("pads", &[1; 4]), numbers_attribute("strides", &[1; 2])])
            .with(&[numbers_attribute("dilations", &[1; 2])])
            .and("w", constant("w", INT8, &[1, 2, 3, 3], &[1; 18]))
            .and("z", constant("z", UINT8, &[], &[10])),
        Wrong::new("MatMul", floats_of(&[2, 1, 1], &[1.0, 2.0]), floats_of(&[2, 1], &[3.0, 6.0]))
            .and("w", floats_constant("w", &[1], &[3.0])),
        Wrong::new("Sign", float(0.0), float(0.0)),
        Wrong::new("Softplus", float(90.0), float(90.0)),
        Wrong::new("Cast", float(0.5), yes.clone()).with(&[number_attribute("to", BOOL)]),
        Wrong::new("CastLike", float(0.5), yes).and("like", constant("like", BOOL, &[1], &[0])),
        Wrong::new("Add", wide(&[1], &[0]), wide(&[1], &[3_000_000_000]))
            .and("w", wide_constant("w", &[1], &[3_000_000_000])),
    ]
}

#[test]
fn models_that_rten_computes_wrongly_are_refused_by_operator() {
    for wrong in wrong_models() {
        let (message, operator, opset) = (refusal(&wrong.model()), wrong.operator, wrong.opset);
        let begin =
            format!("it has operator `{operator}` of opset {opset}, for which rten computes");
        assert!(message.starts_with(&begin), "{message}");
        assert!(message.contains("; name `onnxruntime` in `providers`"), "{message}");
    }
}

/// If this fails after an update of rten, the rule for the operator can be removed.
#[test]
fn this_version_of_rten_still_computes_them_wrongly() {
    for wrong in wrong_models() {
        let found = load_unchecked(&wrong.model()).run(&[wrong.input], &StopSignal::default());
        assert_ne!(found.unwrap(), [wrong.right], "{}", wrong.operator);
    }
}

#[test]
fn the_same_operators_are_accepted_where_rten_is_right() {
    let shape = [1, 3, 4];
    let softmax = |axis: i64, shape: &[u32], opset: i64| {
        let values = floats_of(shape, &vec![0.0; shape.iter().product::<u32>() as usize]);
        let wrong = Wrong::new("Softmax", values.clone(), values);
        Wrong { opset, ..wrong.with(&[number_attribute("axis", axis)]) }
    };
    let row = || floats_of(&[1, 1, 1, 2], &[1.0, 2.0]);
    let numbers = || wide(&[1], &[0]);
    for right in [
        softmax(-1, &shape, 9),
        softmax(2, &shape, 9),
        softmax(1, &shape, 13),
        // Nothing is behind the axis, as in classifiers.
        softmax(1, &[1, 10, 1, 1], 9),
        Wrong::new("MaxPool", row(), row()).with(&same_lower([1, 3])),
        Wrong::new("Sign", numbers(), numbers()),
        Wrong::new("Cast", numbers(), row()).with(&[number_attribute("to", FLOAT32)]),
        Wrong::new("Add", numbers(), numbers())
            .and("w", wide_constant("w", &[1], &[i64::from(i32::MIN)])),
    ] {
        let loaded = load(&right.model());
        assert!(loaded.is_ok(), "{} {}", right.operator, loaded.err().unwrap());
    }
}

#[test]
fn a_nan_that_rten_would_hide_is_refused() {
    for operator in ["Relu", "Clip"] {
        let nan = || float(f32::NAN);
        let wrong = || Wrong::new(operator, nan(), nan());
        let bounded = if operator == "Clip" {
            wrong().and("low", floats_constant("low", &[], &[0.0]))
        } else {
            wrong()
        };
        let model = bounded.model();
        let run = |mut graph: Box<dyn LoadedGraph>, value: f32| {
            graph.run(&[float(value)], &StopSignal::default())
        };
        let hidden = run(load_unchecked(&model), f32::NAN).unwrap();
        assert_eq!(hidden, [float(0.0)], "{operator}");
        let checked = || load(&model).unwrap();
        assert_eq!(run(checked(), 2.0).unwrap(), [float(2.0)]);
        let message = run(checked(), f32::NAN).unwrap_err().to_string();
        assert!(message.starts_with("an input has a NaN: it has operator"), "{message}");
    }
    let with_weight = Wrong::new("Relu", float(0.0), float(0.0))
        .and("w", floats_constant("w", &[1], &[f32::NAN]));
    let message = refusal(&with_weight.model());
    assert!(message.contains("for which rten computes 0 or a bound for NaN"), "{message}");
}

/// A product of two 8-bit matrices with zero points.
fn product([rows, inner, columns]: [i64; 3]) -> Vec<u8> {
    let zero_points = ZERO_POINTS.map(|(name, value)| constant(name, UINT8, &[], &[value as u8]));
    let graph = graph(
        &[node("MatMulInteger", &["a", "b", "za", "zb"], &["y"], &[])],
        &zero_points,
        &[value("a", UINT8, &[rows, inner]), value("b", UINT8, &[inner, columns])],
        &[value("y", INT32, &[rows, columns])],
    );
    model_with_opset(&graph, 17)
}

#[test]
fn products_of_8_bit_integers_are_exact_or_refused() {
    // Multiples of the tiles of rten, and numbers that are none.
    for shape in [[8, 64, 32], [7, 67, 33], [1, 18, 5], [1, 3, 1]] {
        let mut graph = match load(&product(shape)) {
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
