//! The same through ONNX Runtime, where `ORT_DYLIB_PATH` names its library.

use std::time::Duration;

use gleaner_protocol::inference::{Element, ModelFaultKind};

use crate::support::{ModelProgram, TestModel, TestTensor, fault, floats, granted};
use gleaner_test_support::onnx::{ANY, endless, number_of, product, unary};

/// Returns the path of the library, if there is one for tests.
pub fn library() -> Option<String> {
    let library = std::env::var("ORT_DYLIB_PATH").ok();
    if library.is_none() {
        println!("skipped: ORT_DYLIB_PATH names no library of ONNX Runtime");
    }
    library
}

fn has_gpu() -> bool {
    std::path::Path::new("/dev/nvidiactl").exists()
}

/// Returns a model that runs by any provider.
pub fn by(name: &str, bytes: Vec<u8>, providers: &[&str]) -> TestModel {
    let mut model = granted(name, bytes);
    model.grant.providers = providers.iter().map(|name| (*name).to_owned()).collect();
    model
}

#[test]
fn a_gpu_runs_models_in_the_sandbox() {
    let Some(library) = library() else { return };
    if !has_gpu() {
        return println!("skipped: this machine has no GPU of NVIDIA");
    }
    let program = ModelProgram::start(&["--ort-lib", &library]);
    let mut lambda = program.lambda("gpu", &[by("m", product(), &["cuda"])]);
    let opened = lambda.open("m").unwrap();
    assert!(opened.runtime.ends_with(", cuda, 1 thread"), "{}", opened.runtime);
    for _ in 0..3 {
        let outputs = lambda.run("m", &[floats("x", &[2, 3], &[1.0; 6])]).unwrap();
        assert_eq!(outputs[0].floats(), [9.0, 12.0, 9.0, 12.0]);
    }
    println!("{}", opened.runtime);
}

#[test]
fn it_is_used_where_it_is_found_and_no_gpu_is_replaced_silently() {
    let Some(library) = library() else { return };
    if has_gpu() {
        return println!("skipped: this machine has a GPU of NVIDIA");
    }
    let program = ModelProgram::start(&["--ort-lib", &library]);
    let models = [
        by("any", product(), &[]),
        by("gpu", product(), &["tensorrt", "cuda"]),
        by("either", product(), &["cuda", "cpu"]),
    ];
    let mut lambda = program.lambda("ort", &models);
    let opened = lambda.open("any").unwrap();
    assert!(opened.runtime.starts_with("onnxruntime 1."), "{}", opened.runtime);
    assert!(opened.runtime.ends_with(", cpu, 1 thread"), "{}", opened.runtime);
    assert_eq!(program.loaded().reason, "the manifest names no provider");
    let outputs = lambda.run("any", &[floats("x", &[2, 3], &[1.0; 6])]).unwrap();
    assert_eq!(outputs[0].floats(), [9.0, 12.0, 9.0, 12.0]);
    let message = fault(ModelFaultKind::Failed, lambda.open("gpu"));
    assert!(
        message.contains("`tensorrt` failed") && message.contains("`cuda` failed"),
        "{message}"
    );
    program.loaded();
    assert!(lambda.open("either").unwrap().runtime.contains(", cpu, "));
    let reason = program.loaded().reason;
    assert!(reason.starts_with("`cuda` failed: "), "{reason}");
    assert!(reason.ends_with("`cpu` is the next provider in the manifest"), "{reason}");
    println!("{message}\n{reason}");
}

#[test]
fn every_type_of_elements_passes_it() {
    let Some(library) = library() else { return };
    let program = ModelProgram::start(&["--ort-lib", &library]);
    for element in Element::ALL {
        let model = by("m", unary("Identity", number_of(element), &[2]), &["onnxruntime"]);
        let mut lambda = program.lambda("types", &[model]);
        lambda.open("m").unwrap();
        let bytes: Vec<u8> = match element {
            Element::Boolean => vec![1, 0],
            _ => (1..=2 * element.size() as u8).collect(),
        };
        let input = TestTensor { name: "x".to_owned(), element, shape: vec![2], bytes };
        let output = lambda.run("m", std::slice::from_ref(&input)).unwrap().remove(0);
        assert_eq!((output.element, output.bytes), (element, input.bytes), "{element}");
    }
}

#[test]
fn an_endless_model_is_interrupted_and_others_go_on() {
    let Some(library) = library() else { return };
    let program = ModelProgram::start(&["--ort-lib", &library, "--run-max", "20"]);
    let models = [
        by("endless", endless(&[ANY]), &["onnxruntime"]),
        by("product", product(), &["onnxruntime"]),
    ];
    let mut lambda = program.lambda("stuck", &models);
    lambda.open("endless").unwrap();
    lambda.open("product").unwrap();
    for _ in 0..3 {
        let soon = Some(Duration::from_millis(50));
        let slow = lambda.run_until("endless", &[floats("x", &[1], &[1.0])], soon);
        fault(ModelFaultKind::TooSlow, slow);
        let outputs = lambda.run("product", &[floats("x", &[1, 3], &[1.0; 3])]).unwrap();
        assert_eq!(outputs[0].floats(), [9.0, 12.0]);
    }
    assert_eq!(program.stop().models.iter().map(|model| model.failed).sum::<u64>(), 3);
}

#[test]
fn an_endless_first_run_and_one_without_a_deadline_are_interrupted() {
    let Some(library) = library() else { return };
    let program = ModelProgram::start(&["--ort-lib", &library, "--run-max", "0.5"]);
    let models = [
        by("static", endless(&[1]), &["onnxruntime"]),
        by("dynamic", endless(&[ANY]), &["onnxruntime"]),
        by("product", product(), &["onnxruntime"]),
    ];
    let mut lambda = program.lambda("stuck", &models);
    lambda.open("static").unwrap();
    assert!(program.loaded().reason.contains("a run on zeros failed"));
    lambda.open("dynamic").unwrap();
    let message =
        fault(ModelFaultKind::TooSlow, lambda.run("dynamic", &[floats("x", &[1], &[1.0])]));
    assert_eq!(message, "model `dynamic.onnx` was interrupted");
    lambda.open("product").unwrap();
    assert!(lambda.run("product", &[floats("x", &[1, 3], &[1.0; 3])]).is_ok());
    assert_eq!(program.in_use(), [None, None]);
}
