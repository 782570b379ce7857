//! Models that cannot be loaded are refused with the reason.

use gleaner_protocol::inference::{ModelFaultKind, ModelState};

use crate::support::{ModelProgram, TestModel, digest, fault, granted};
use gleaner_test_support::onnx::{
    FLOAT32, INT16, Proto, STRING, external, graph, model, model_with_opset, node, product, unary,
    value,
};

/// Opens a model that cannot be loaded; returns the reason.
#[track_caller]
fn refusal(program: &ModelProgram, model: TestModel) -> String {
    let name = model.grant.name.clone();
    let mut lambda = program.lambda("test", &[model]);
    let first = fault(ModelFaultKind::Failed, lambda.open(&name));
    // It is not tried again.
    assert_eq!(fault(ModelFaultKind::Failed, lambda.open(&name)), first);
    let report = program.loaded();
    assert_eq!((report.state, report.reason), (ModelState::Failed, first.clone()));
    first
}

#[test]
fn models_that_cannot_run_are_refused_with_the_reason_and_others_go_on() {
    let program = ModelProgram::start(&["--model-max", "100000"]);
    let outputs = || [value("y", FLOAT32, &[1])];
    let foreign = node("Gelu", &["x"], &["y"], &[]).text(7, "com.microsoft");
    let inputs = || [value("x", FLOAT32, &[1])];
    let text = graph(&[], &[], &[value("x", STRING, &[1])], &outputs());
    let outside = graph(&[], &[external("w", "weights.bin")], &inputs(), &outputs());
    for (name, bytes, reason) in [
        (
            "random",
            (0..5000_u32).map(|it| ((it * it) >> 3) as u8).collect(),
            "it is not an ONNX model",
        ),
        ("empty", Vec::new(), "it is not an ONNX model"),
        ("large", vec![0; 100_001], "it has 100001 bytes; 100000 are allowed"),
        ("unknown", unary("Frobnicate", FLOAT32, &[1]), "Frobnicate"),
        (
            "foreign",
            model(&graph(&[foreign], &[], &inputs(), &outputs())),
            "operator `Gelu` of domain `com.microsoft`",
        ),
        ("text", model(&text), "input `x` has elements of type string"),
        ("outside", model(&outside), "tensor `w` is in another file, `weights.bin`"),
        ("new", model_with_opset(&graph(&[], &[], &inputs(), &outputs()), 99), "version 99"),
        ("int16", unary("Identity", INT16, &[1]), "int16, which rten does not support"),
        ("cut", product()[..60].to_vec(), "it is not an ONNX model"),
        (
            "missing",
            model(&graph(&[], &[], &inputs(), &[value("z", FLOAT32, &[1])])),
            "Source node not found for output \"z\"",
        ),
    ] {
        let found = refusal(&program, granted(name, bytes));
        assert!(found.starts_with(&format!("model `{name}.onnx`: ")), "{found}");
        assert!(found.contains(reason), "{found}");
    }
    program.serves();
}

#[test]
fn a_file_with_another_digest_is_refused() {
    let program = ModelProgram::start(&[]);
    let mut model = granted("m", product());
    model.grant.sha256 = "0".repeat(64);
    let found = refusal(&program, model);
    let (needed, has) = ("0".repeat(64), digest(&product()));
    let reason = format!("its SHA-256 is {has}, and the lambda needs {needed}");
    assert_eq!(found, format!("model `m.onnx`: {reason}"));
}

#[test]
fn only_granted_models_are_opened() {
    let program = ModelProgram::start(&[]);
    let mut refused = granted("refused", unary("Relu", FLOAT32, &[1]));
    refused.grant.refused = Some("it has ended the process 3 times".to_owned());
    let mut lambda = program.lambda("one", &[granted("mine", product()), refused]);
    program.lambda("two", &[granted("other", product())]).open("other").unwrap();
    let message = fault(ModelFaultKind::NoSuchModel, lambda.open("other"));
    assert_eq!(message, "the manifest has no model `other`");
    fault(ModelFaultKind::NoSuchModel, lambda.run("other", &[]));
    let message = fault(ModelFaultKind::Failed, lambda.open("refused"));
    assert_eq!(message, "it has ended the process 3 times");
}

#[test]
fn an_unknown_provider_and_one_without_its_library_are_refused() {
    let program = ModelProgram::start(&["--ort-lib", "/none/libonnxruntime.so.1.23.2"]);
    let with = |providers: &[&str], threads| {
        let mut model = granted("m", product());
        model.grant.providers = providers.iter().map(|name| (*name).to_owned()).collect();
        model.grant.threads = Some(threads);
        model
    };
    let found = refusal(&program, with(&["gpu"], 1));
    assert!(found.contains("provider `gpu` is unknown; known are cpu, cuda"), "{found}");
    let found = refusal(&program, with(&["tensorrt", "cuda"], 1));
    assert!(found.contains("`tensorrt` failed: there is no ONNX Runtime: /none/lib"), "{found}");
    assert!(found.contains("; `cuda` failed: "), "{found}");
    let mut lambda = program.lambda("any", &[with(&[], 2)]);
    assert_eq!(lambda.open("m").unwrap().runtime, "rten 0.27.0, cpu, 2 threads");
    let reason = program.loaded().reason;
    assert!(reason.contains("the manifest names no provider"), "{reason}");
    assert!(reason.contains("/none/libonnxruntime.so.1.23.2"), "{reason}");
}

#[test]
fn a_hostile_message_length_does_not_take_memory() {
    let program = ModelProgram::start(&["--memory", "200000000"]);
    // A name of 2^40 bytes, inside of a graph of 2^41.
    let huge = [
        0x08, 8, 0x3a, 0x80, 0x80, 0x80, 0x80, 0x80, 0x40, 0x12, 0x80, 0x80, 0x80, 0x80, 0x80, 0x20,
    ];
    let nested = Proto::default().number(1, 8).message(7, &Proto(huge[9..].to_vec())).0;
    for (name, bytes) in [("huge", huge.to_vec()), ("nested", nested)] {
        assert!(refusal(&program, granted(name, bytes)).contains("it is not an ONNX model"));
    }
}
