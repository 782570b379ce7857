//! Tests of the checks, on models that are written by hand.

use gleaner_protocol::inference::{Element, TensorInfo};

use super::*;
use gleaner_test_support::onnx::{
    ANY, BOOL, FLOAT32, INT64, Proto, STRING, constant, doubled, external, graph, graph_attribute,
    model, model_with_opset, node, number_attribute, number_of, product, unary, value, value_of,
};

fn refusal(model: &[u8]) -> String {
    inspect(model).unwrap_err().to_string()
}

fn info(name: &str, element: Element, shape: &[Option<u32>]) -> TensorInfo {
    TensorInfo { name: name.to_owned(), element, shape: shape.to_vec() }
}

fn with_node(node: Proto) -> Proto {
    graph(&[node], &[], &[value("x", FLOAT32, &[1])], &[value("y", FLOAT32, &[1])])
}

fn with_input(input: Proto) -> Vec<u8> {
    model(&graph(&[], &[], &[input], &[value("y", FLOAT32, &[1])]))
}

#[test]
fn inputs_and_outputs_are_read_without_constants() {
    let f32 = Element::Float32;
    let signature = inspect(&product()).unwrap();
    assert_eq!(signature.inputs, [info("x", f32, &[None, Some(3)])]);
    assert_eq!(signature.outputs[0].tensor, info("y", f32, &[None, Some(2)]));
    assert!(signature.outputs[0].has_shape);
    for element in Element::ALL {
        let signature = inspect(&doubled(number_of(element), &[2, ANY])).unwrap();
        assert_eq!(signature.inputs, [info("x", element, &[Some(2), None])]);
    }
    // Old models list constants as inputs, too.
    let old = graph(
        &[node("Add", &["x", "w"], &["y"], &[])],
        &[constant("w", FLOAT32, &[1], &[0; 4])],
        &[value("x", FLOAT32, &[1]), value("w", FLOAT32, &[1])],
        &[value_of("y", &Proto::default().number(1, FLOAT32))],
    );
    let signature = inspect(&model(&old)).unwrap();
    assert_eq!(signature.inputs, [info("x", f32, &[Some(1)])]);
    assert!(!signature.outputs[0].has_shape);
}

#[test]
fn bytes_that_are_no_model_are_refused() {
    let no_model = "it is not an ONNX model: it is not a protobuf message with a version and a \
                    graph";
    let whole = product();
    let twice = Proto(whole.clone()).message(7, &graph(&[], &[], &[], &[])).0;
    let huge_name = Proto::default().number(1, 8).0;
    let huge_name = [&huge_name[..], &[0x12, 0xff, 0xff, 0xff, 0xff, 0xff, 0x7f]].concat();
    for bytes in [b"".as_slice(), b"\x89PNG\r\n", b"hello", &[0xff; 64], &twice, &huge_name] {
        assert_eq!(refusal(bytes), no_model);
    }
    for length in 0..whole.len() {
        assert!(inspect(&whole[..length]).is_err(), "{length}");
    }
    // Some changed bytes are still a model; none makes the check fail in another way.
    for index in 0..whole.len() {
        let mut changed = whole.clone();
        changed[index] ^= 0x55;
        let _ = inspect(&changed);
    }
}

#[test]
fn operators_of_other_domains_are_refused_in_subgraphs_too() {
    let foreign = || node("Gelu", &["x"], &["y"], &[]).text(7, "com.microsoft");
    let message =
        "it has operator `Gelu` of domain `com.microsoft`; only standard operators can run";
    assert_eq!(refusal(&model(&with_node(foreign()))), message);
    let branch = graph_attribute("then_branch", &with_node(foreign()));
    let nested = with_node(node("If", &["x"], &["y"], &[branch]));
    assert_eq!(refusal(&model(&nested)), message);
    let standard = node("Relu", &["x"], &["y"], &[]).text(7, "ai.onnx");
    assert!(inspect(&model(&with_node(standard))).is_ok());
    let function = Proto::default().text(1, "f").message(7, &foreign());
    let with_function = Proto(unary("Relu", FLOAT32, &[1])).message(25, &function).0;
    assert_eq!(refusal(&with_function), message);
}

#[test]
fn data_in_other_files_is_refused_wherever_it_is() {
    let message = "the data of tensor `w` is in another file, `../secret`; save the model with its \
                   data in one file";
    let outside = || external("w", "../secret");
    let empty = || graph(&[], &[], &[], &[value("y", FLOAT32, &[1])]);
    let initializer = graph(&[], &[outside()], &[], &[value("y", FLOAT32, &[1])]);
    let attribute = Proto::default().text(1, "value").message(5, &outside());
    let list = Proto::default().text(1, "values").message(10, &outside());
    let sparse = Proto::default().message(1, &outside());
    let branch = graph_attribute("then_branch", &initializer);
    for graph in [
        initializer.clone(),
        with_node(node("Constant", &[], &["y"], &[attribute])),
        with_node(node("Constant", &[], &["y"], &[list])),
        with_node(node("If", &["x"], &["y"], &[branch])),
        empty().message(15, &sparse),
        with_node(node("Constant", &[], &["y"], &[Proto::default().message(22, &sparse)])),
    ] {
        assert_eq!(refusal(&model(&graph)), message);
    }
    let location_only = Proto::default().text(8, "w").number(14, 1);
    assert!(refusal(&model(&empty().message(5, &location_only))).contains("another file"));
}

#[test]
fn versions_of_operators_and_depth_are_bounded() {
    let graph = with_node(node("Relu", &["x"], &["y"], &[]));
    for (version, is_accepted) in [(6, false), (7, true), (24, true), (25, false), (-1, false)] {
        assert_eq!(inspect(&model_with_opset(&graph, version)).is_ok(), is_accepted, "{version}");
    }
    assert_eq!(
        refusal(&model_with_opset(&graph, 3)),
        "it needs version 3 of the standard operators; versions 7 to 24 can run"
    );
    let without = Proto::default().number(1, 8).message(7, &graph).0;
    assert_eq!(refusal(&without), "it does not name the version of the standard operators");
    let mut nested = graph;
    for depth in 1..5000 {
        nested = with_node(node("If", &["x"], &["y"], &[graph_attribute("then_branch", &nested)]));
        let deep = model(&nested);
        assert_eq!(inspect(&deep).is_ok(), depth <= 16, "{depth}");
        if depth > 40 {
            break;
        }
    }
    let sequence = |inner: &Proto| Proto::default().message(4, &Proto::default().message(1, inner));
    let mut kind = Proto::default();
    for _ in 0..1000 {
        kind = sequence(&kind);
    }
    let deep_type = Proto::default().text(1, "x").message(2, &kind);
    assert_eq!(refusal(&with_input(deep_type)), "its graphs are nested more than 16 deep");
}

#[test]
fn inputs_that_a_lambda_cannot_give_are_refused_by_name() {
    let kind = |field: u64| {
        Proto::default()
            .text(1, "x")
            .message(2, &Proto::default().message(field, &Proto::default()))
    };
    for (field, found) in [(4, "a sequence"), (5, "a map"), (8, "a sparse tensor"), (9, "optional")]
    {
        assert_eq!(
            refusal(&with_input(kind(field))),
            format!("input `x` is {found}; a lambda can use tensors of numbers and booleans")
        );
    }
    assert_eq!(
        refusal(&with_input(value("x", STRING, &[1]))),
        "input `x` has elements of type string; supported are float32, float16, float64, int8, \
         int16, int32, int64, uint8, boolean"
    );
    let shapeless = value_of("x", &Proto::default().number(1, BOOL));
    assert_eq!(
        refusal(&with_input(shapeless)),
        "input `x` has no declared shape; export the model with it"
    );
    assert_eq!(
        refusal(&with_input(Proto::default().text(1, "x"))),
        "input `x` has no declared type; export the model with it"
    );
    for length in [0, -2, 1 << 40] {
        assert_eq!(
            refusal(&with_input(value("x", INT64, &[1, length]))),
            format!("input `x` has a length of {length} in dimension 1")
        );
    }
    assert!(refusal(&with_input(value("x", INT64, &[1; 9]))).contains("9 dimensions"));
    let many: Vec<Proto> = (0..257).map(|index| value(&index.to_string(), FLOAT32, &[1])).collect();
    let too_many = "it has more than the 256 inputs that are allowed";
    assert_eq!(refusal(&model(&graph(&[], &[], &many, &[]))), too_many);
    // Constants do not count.
    let constants = (0..300).map(|index| constant(&index.to_string(), FLOAT32, &[1], &[0; 4]));
    let constants: Vec<Proto> = constants.collect();
    assert!(inspect(&model(&graph(&[], &constants, &many, &[]))).is_ok());
    let twice = [value("x", FLOAT32, &[1]), value("x", FLOAT32, &[1])];
    assert_eq!(refusal(&model(&graph(&[], &[], &twice, &[]))), "two inputs have the name `x`");
}

#[test]
fn dropout_is_refused_unless_it_is_constantly_out_of_training() {
    let dropout = |inputs: &[&str]| node("Dropout", inputs, &["y"], &[]);
    let switch = |value: u8| constant("training", BOOL, &[], &[value]);
    let of = |nodes: &[Proto], constants: &[Proto]| {
        let output = value("y", FLOAT32, &[1]);
        let inputs = [value("x", FLOAT32, &[1]), value("training", BOOL, &[])];
        inspect(&model(&graph(nodes, constants, &inputs, &[output])))
    };
    let inputs = ["x", "", "training"];
    let as_node = |value: u8| {
        let attribute = Proto::default().text(1, "value").message(5, &switch(value));
        node("Constant", &[], &["training"], &[attribute])
    };
    let listed = Proto::default().number(2, BOOL).text(8, "training").number(5, 0);
    assert!(of(&[dropout(&["x"])], &[]).is_ok());
    assert!(of(&[dropout(&["x", "", ""])], &[]).is_ok());
    assert!(of(&[dropout(&inputs)], &[switch(0)]).is_ok());
    assert!(of(&[dropout(&inputs)], &[listed]).is_ok());
    assert!(of(&[as_node(0), dropout(&inputs)], &[]).is_ok());
    let random = Err(InspectError::Random { operator: "Dropout".to_owned() });
    assert_eq!(of(&[dropout(&inputs)], &[switch(1)]), random);
    assert_eq!(of(&[dropout(&inputs)], &[]), random, "a lambda gives it");
    assert_eq!(of(&[as_node(1), dropout(&inputs)], &[]), random);
    let empty = Proto::default().number(2, BOOL).text(8, "training");
    assert_eq!(of(&[dropout(&inputs)], &[empty]), random);
    let function = Proto::default().text(1, "f").message(7, &dropout(&inputs));
    let with_function = Proto(unary("Relu", FLOAT32, &[1])).message(25, &function).0;
    assert_eq!(inspect(&with_function), random);
}

#[test]
fn rules_for_rten_hold_in_subgraphs_and_by_what_values_are() {
    let findings = |model: &[u8]| inspect(model).unwrap().rten.len();
    let sign = |input: i64| unary("Sign", input, &[1]);
    assert_eq!([sign(FLOAT32), sign(INT64)].map(|it| findings(&it)), [1, 0]);
    let branch = graph_attribute("then_branch", &with_node(node("Sign", &["x"], &["y"], &[])));
    assert_eq!(findings(&model(&with_node(node("If", &["x"], &["y"], &[branch])))), 1);
    // The rank of the softmax follows from that of the shape, through a transposition.
    let softmax = |lengths: i64| {
        let nodes = [
            node("Reshape", &["x", "shape"], &["a"], &[]),
            node("Transpose", &["a"], &["b"], &[]),
            node("Softmax", &["b"], &["c"], &[number_attribute("axis", 2)]),
            node("Flatten", &["c"], &["y"], &[]),
        ];
        let shape =
            constant("shape", INT64, &[lengths], &1_i64.to_le_bytes().repeat(lengths as usize));
        let values = [value("x", FLOAT32, &[1])];
        model_with_opset(&graph(&nodes, &[shape], &values, &[value("y", FLOAT32, &[1, 1])]), 11)
    };
    assert_eq!([softmax(3), softmax(4)].map(|it| findings(&it)), [0, 1]);
    let function = Proto::default().text(1, "Relu").message(7, &node("Neg", &["x"], &["y"], &[]));
    let with_function = Proto(unary("Neg", FLOAT32, &[1])).message(25, &function).0;
    assert_eq!(findings(&with_function), 1);
}

#[test]
fn the_metadata_of_a_detector_is_read() {
    let entry = |key: &str, value: &str| Proto::default().text(1, key).text(2, value);
    let with = Proto(unary("Neg", FLOAT32, &[1]))
        .message(14, &entry("task", "pose"))
        .message(14, &entry("license", "AGPL-3.0"))
        .message(14, &entry("names", &"n".repeat(30_000)));
    let metadata = inspect(&with.0).unwrap().metadata;
    assert_eq!(metadata, [("task".to_owned(), "pose".to_owned())]);
}
