//! Models of every type run, and requests that do not fit them are refused.

use gleaner_protocol::inference::{Element, ModelFaultKind, ModelState};

use crate::support::{ModelProgram, TestTensor, fault, floats, granted, integers};
use gleaner_test_support::onnx::{
    ANY, BOOL, FLOAT32, FLOAT64, INT8, INT64, Proto, UINT8, doubled, graph, model, node, number_of,
    product, unary, value, value_of,
};

#[test]
fn a_model_is_opened_and_run_with_any_batch() {
    let program = ModelProgram::start(&[]);
    let mut lambda = program.lambda("yolo", &[granted("product", product())]);
    let opened = lambda.open("product").unwrap();
    assert_eq!(opened.runtime, "rten 0.27.0, cpu, 1 thread");
    assert_eq!(opened.inputs[0].to_string(), "float32 [?, 3]");
    assert_eq!((opened.outputs[0].name.as_str(), opened.outputs.len()), ("y", 1));
    for batch in 1..4 {
        let ones = vec![1.0; batch * 3];
        let outputs = lambda.run("product", &[floats("x", &[batch as u32, 3], &ones)]).unwrap();
        assert_eq!(outputs[0].shape, [batch as u32, 2]);
        assert_eq!(outputs[0].floats(), [9.0, 12.0].repeat(batch));
        assert!(lambda.run_ns > 0);
    }
    let loaded = program.loaded();
    assert_eq!((loaded.state, loaded.lambdas), (ModelState::Ready, vec!["yolo".to_owned()]));
    assert_eq!(loaded.reason, "`rten` is the first provider in the manifest");
    assert!(loaded.load_ns > 0);
    let last = program.stop();
    let model = &last.models[0];
    assert_eq!((model.runs, model.shared, model.failed), (3, 0, 0));
    assert!(model.run_ns > 0 && last.resident_bytes > 0 && last.clients == 1);
}

#[test]
fn every_type_of_elements_is_returned_as_it_is_declared() {
    let program = ModelProgram::start(&[]);
    let half = |value: f32| half::f16::from_f32(value).to_le_bytes().to_vec();
    let cases = [
        ("f32", Element::Float32, [1.5_f32, 3.0].map(|it| it.to_le_bytes().to_vec())),
        ("f16", Element::Float16, [1.5, 3.0].map(half)),
        ("f64", Element::Float64, [1.5_f64, 3.0].map(|it| it.to_le_bytes().to_vec())),
        ("i32", Element::Int32, [-4_i32, -8].map(|it| it.to_le_bytes().to_vec())),
        ("i64", Element::Int64, [-4_i64, -8].map(|it| it.to_le_bytes().to_vec())),
    ];
    let models: Vec<_> = cases
        .iter()
        .map(|(name, element, _)| granted(name, doubled(number_of(*element), &[1])))
        .chain([
            granted("not", unary("Not", BOOL, &[3])),
            granted("u8", unary("Identity", UINT8, &[3])),
            granted("i8", unary("Identity", INT8, &[3])),
        ])
        .collect();
    let mut lambda = program.lambda("types", &models);
    let mut run = |name: &str, element, input: Vec<u8>| {
        let shape = vec![(input.len() / Element::size(element)) as u32];
        lambda.open(name).unwrap();
        let input = TestTensor { name: "x".to_owned(), element, shape, bytes: input };
        let output = lambda.run(name, &[input]).unwrap().remove(0);
        assert_eq!(output.element, element);
        output.bytes
    };
    for (name, element, [input, output]) in cases {
        assert_eq!(run(name, element, input), output, "{name}");
    }
    assert_eq!(run("not", Element::Boolean, vec![0, 1, 200]), [1, 0, 0]);
    assert_eq!(run("u8", Element::Uint8, vec![0, 127, 255]), [0, 127, 255]);
    assert_eq!(run("i8", Element::Int8, vec![0, 127, 255]), [0, 127, 255]);
}

#[test]
fn numbers_that_the_backend_cannot_represent_are_refused() {
    let program = ModelProgram::start(&[]);
    let models = [granted("i64", doubled(INT64, &[1])), granted("f64", doubled(FLOAT64, &[1]))];
    let mut lambda = program.lambda("numbers", &models);
    lambda.open("i64").unwrap();
    let message =
        fault(ModelFaultKind::Failed, lambda.run("i64", &[integers("x", &[1], &[1 << 40])]));
    assert!(message.contains("1099511627776") && message.contains("int32"), "{message}");
    lambda.open("f64").unwrap();
    let bytes = 1e300_f64.to_le_bytes().to_vec();
    let input =
        TestTensor { name: "x".to_owned(), element: Element::Float64, shape: vec![1], bytes };
    let message = fault(ModelFaultKind::Failed, lambda.run("f64", &[input]));
    assert!(message.contains("float32"), "{message}");
}

#[test]
fn inputs_that_do_not_fit_are_refused_with_both_shapes() {
    let program = ModelProgram::start(&[]);
    let mut lambda = program.lambda("unfit", &[granted("m", unary("Relu", FLOAT32, &[1, 3]))]);
    let early = lambda.run("m", &[floats("x", &[1, 3], &[0.0; 3])]);
    let message = fault(ModelFaultKind::Unavailable, early);
    assert_eq!(message, "model `m` is not open; open it before its first run");
    lambda.open("m").unwrap();
    let mut refusal =
        |inputs: &[TestTensor]| fault(ModelFaultKind::WrongInput, lambda.run("m", inputs));
    assert_eq!(refusal(&[]), "model `m`: input `x` is missing");
    assert_eq!(
        refusal(&[floats("images", &[1, 3], &[0.0; 3])]),
        "model `m`: the model has no input `images`; its inputs are `x`"
    );
    assert_eq!(
        refusal(&[floats("x", &[1, 4], &[0.0; 4])]),
        "model `m`: input `x` is float32 [1, 4], and the model needs float32 [1, 3]"
    );
    assert_eq!(
        refusal(&[integers("x", &[1, 3], &[0; 3])]),
        "model `m`: input `x` is int64 [1, 3], and the model needs float32 [1, 3]"
    );
    assert!(lambda.run("m", &[floats("x", &[1, 3], &[-1.0, 0.0, 2.0])]).is_ok());
    assert_eq!(program.stop().models[0].failed, 4);
}

#[test]
fn an_undeclared_shape_of_an_output_is_learned_and_an_output_may_be_empty() {
    let program = ModelProgram::start(&[]);
    let output = || value_of("y", &Proto::default().number(1, FLOAT32));
    let learned = model(&graph(
        &[node("Relu", &["x"], &["y"], &[])],
        &[],
        &[value("x", FLOAT32, &[1, 2])],
        &[output()],
    ));
    let positives = model(&graph(
        &[node("NonZero", &["x"], &["y"], &[])],
        &[],
        &[value("x", FLOAT32, &[ANY])],
        &[value("y", INT64, &[1, ANY])],
    ));
    let models = [granted("learned", learned), granted("positives", positives)];
    let mut lambda = program.lambda("shapes", &models);
    assert_eq!(lambda.open("learned").unwrap().outputs[0].to_string(), "float32 [?, ?]");
    lambda.open("positives").unwrap();
    let found = lambda.run("positives", &[floats("x", &[3], &[0.0, 1.0, 2.0])]).unwrap();
    assert_eq!(found[0], integers("y", &[1, 2], &[1, 2]));
    let none = lambda.run("positives", &[floats("x", &[3], &[0.0; 3])]).unwrap();
    assert_eq!(none[0], integers("y", &[1, 0], &[]));
}
