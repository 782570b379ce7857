//! Models of the shared test data return what ONNX Runtime returned elsewhere.

use std::fs::File;
use std::io::BufReader;

use serde_json::Value;

use crate::onnx_runtime::{by, library};
use crate::support::{ModelProgram, TestTensor, floats, shared};

/// Reads an image as RGB.
fn image(path: &str) -> (Vec<u8>, usize, usize) {
    let file = BufReader::new(File::open(shared(path).unwrap()).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!(info.color_type, png::ColorType::Rgb);
    (pixels, info.width as usize, info.height as usize)
}

/// Returns the input of a model, as the reference describes it.
fn input(reference: &Value) -> TestTensor {
    let (pixels, width, height) = image(reference["model_input_png"].as_str().unwrap());
    let how = reference["preprocess"].as_str().unwrap();
    let channels = if how.starts_with("BGR") { [2, 1, 0] } else { [0, 1, 2] };
    let scale = if how.contains("x/255") { 255.0 } else { 1.0 };
    let plane =
        |channel: usize| pixels.chunks_exact(3).map(move |it| f32::from(it[channel]) / scale);
    let values: Vec<f32> = channels.into_iter().flat_map(plane).collect();
    let sum: f64 = values.iter().map(|value| f64::from(*value)).sum();
    let expected = reference["input_checksum"]["sum"].as_f64().unwrap();
    assert!((sum - expected).abs() <= expected * 1e-6, "{sum} instead of {expected}");
    let name = reference["input"]["name"].as_str().unwrap();
    floats(name, &[1, 3, height as u32, width as u32], &values)
}

fn sum(values: &[f32]) -> f64 {
    values.iter().map(|value| f64::from(*value)).sum()
}

fn largest(values: &[f32]) -> f64 {
    values.iter().fold(0.0, |most, value| most.max(f64::from(value.abs())))
}

/// Runs a model several times, prints the median time, and returns its output. If rten refuses it,
/// or there is no ONNX Runtime, there is none.
fn run(name: &str, reference: &Value, provider: &str, threads: u32) -> Option<Vec<f32>> {
    let bytes = std::fs::read(shared(&format!("models/{name}"))?).unwrap();
    let mut args = vec!["--memory".to_owned(), "4000000000".to_owned()];
    if provider == "onnxruntime" {
        args.extend(["--ort-lib".to_owned(), library()?]);
    }
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let program = ModelProgram::start(&args);
    let mut model = by("m", bytes, &[provider]);
    model.grant.threads = Some(threads);
    let mut lambda = program.lambda("parity", &[model]);
    let opened = match lambda.open("m") {
        Ok(opened) => opened,
        Err(fault) if fault.message.contains("for which rten computes") && provider == "rten" => {
            return None;
        }
        Err(fault) => panic!("{name}: {}", fault.message),
    };
    assert_eq!(opened.outputs.len(), 1);
    let mut input = input(reference);
    let mut times = Vec::new();
    let mut output = None;
    for round in 0..7 {
        output = lambda.run("m", std::slice::from_ref(&input)).ok();
        times.push(lambda.run_ns);
        // Another frame in between, so that each run is one.
        let last = input.bytes.len() - 1;
        input.bytes[last] ^= 1;
        if round % 2 == 0 {
            lambda.run("m", std::slice::from_ref(&input)).unwrap();
            times.push(lambda.run_ns);
        }
        input.bytes[last] ^= 1;
    }
    times.sort_unstable();
    println!(
        "{name}: {}: median {:.1} ms, min {:.1} ms of {}",
        opened.runtime,
        times[times.len() / 2] as f64 / 1e6,
        times[0] as f64 / 1e6,
        times.len()
    );
    let output = output.unwrap().remove(0);
    let shape: Vec<u64> = output.shape.iter().map(|length| u64::from(*length)).collect();
    assert_eq!(reference["outputs"][0]["shape"], serde_json::json!(shape));
    Some(output.floats())
}

fn references() -> Option<Value> {
    let text = std::fs::read_to_string(shared("models/reference.json")?).unwrap();
    Some(serde_json::from_str(&text).unwrap())
}

#[test]
fn float_models_return_the_reference_within_a_thousandth() {
    let Some(references) = references() else { return };
    let name = "yolox_nano.onnx";
    let reference = &references["models"][name];
    let expected = &reference["outputs"][0];
    for (provider, threads) in [("rten", 1), ("rten", 2), ("onnxruntime", 1), ("onnxruntime", 2)] {
        let Some(values) = run(name, reference, provider, threads) else { continue };
        let near = |found: f64, expected: &Value| {
            let expected = expected.as_f64().unwrap();
            let error = (found - expected).abs();
            assert!(error <= expected.abs() * 1e-3 + 1e-6, "{found} instead of {expected}");
        };
        near(sum(&values), &expected["sum"]);
        near(largest(&values), &expected["absmax"]);
        for (value, expected) in values.iter().zip(expected["first8"].as_array().unwrap()) {
            near(f64::from(*value), expected);
        }
    }
}

/// Returns the best score of each class, of outputs of shape [1, 4 + classes, boxes].
fn best_scores(values: &[f32], boxes: usize) -> Vec<f32> {
    let classes = values[4 * boxes..].chunks_exact(boxes);
    classes.map(|scores| scores.iter().copied().fold(0.0, f32::max)).collect()
}

#[test]
fn quantized_models_find_the_same_objects() {
    let Some(references) = references() else { return };
    for name in ["yolo11n_int8_320.onnx", "yolov8n_int8_640.onnx"] {
        let reference = &references["models"][name];
        let boxes = reference["outputs"][0]["shape"][2].as_u64().unwrap() as usize;
        assert_eq!(run(name, reference, "rten", 1), None, "rten refuses it");
        if let Some(values) = run(name, reference, "onnxruntime", 1) {
            let best = best_scores(&values, boxes);
            let detections = reference["decoded_detections_on_source_image"].as_array().unwrap();
            let mut seen = std::collections::HashSet::new();
            for detection in detections {
                let class = detection["cls"].as_u64().unwrap() as usize;
                // The first of a class is its best one.
                if seen.insert(class) {
                    let expected = detection["score"].as_f64().unwrap() as f32;
                    let found = best[class];
                    println!("{name}: class {class}: {found} for {expected}");
                    assert!((found - expected).abs() <= 0.05, "{name}: {found} for {expected}");
                }
            }
            println!("{name}: sum {} for {}", sum(&values), reference["outputs"][0]["sum"]);
        }
    }
}
