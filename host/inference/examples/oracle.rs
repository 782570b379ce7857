//! Runs models that another program sends, for `tests/models/oracle.py`, which knows the results.
//!
//! The argument is the library of ONNX Runtime; without it, rten runs the models. A line of
//! standard input is a case, `{"model": PATH, "inputs": [[TYPE, SHAPE, HEX], ...]}`; the answer is
//! a line with `refused`, `failed` or `outputs`. With `--rules`, the rules for rten are printed as
//! rows of a table.

use std::error::Error;
use std::io::{BufRead, stdin};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use gleaner_base::hex;
use gleaner_inference::backend::{
    Backend, ExecutionProvider, LoadOptions, OnnxRuntime, RtenBackend, StopSignal, TensorValue,
};
use gleaner_inference::inspect::{RTEN_RULES, inspect};
use serde_json::{Value, json};

/// A model that was refused, or a run that failed.
enum Stopped {
    Refused(String),
    Failed(String),
}

fn main() -> Result<(), Box<dyn Error>> {
    let library = std::env::args().nth(1);
    if library.as_deref() == Some("--rules") {
        for rule in RTEN_RULES {
            let operators = match rule.operators {
                [] => "any".to_owned(),
                operators => operators.join(", "),
            };
            println!("| {operators} | {} | {} |", rule.when, rule.computes);
        }
        return Ok(());
    }
    let backend: Box<dyn Backend> = match library {
        Some(path) => Box::new(OnnxRuntime::open(Path::new(&path), "")?),
        None => Box::new(RtenBackend),
    };
    for line in stdin().lock().lines() {
        let case: Value = serde_json::from_str(&line?)?;
        let ran = catch_unwind(AssertUnwindSafe(|| run(backend.as_ref(), &case)));
        let answer = match ran.unwrap_or_else(|_| Err(Stopped::Failed("it panicked".to_owned()))) {
            Ok(outputs) => json!({ "outputs": outputs }),
            Err(Stopped::Refused(reason)) => json!({ "refused": reason }),
            Err(Stopped::Failed(reason)) => json!({ "failed": reason }),
        };
        println!("{answer}");
    }
    Ok(())
}

fn run(backend: &dyn Backend, case: &Value) -> Result<Vec<Value>, Stopped> {
    let refused = |error: &dyn Error| Stopped::Refused(error.to_string());
    let failed = |error: &dyn Error| Stopped::Failed(error.to_string());
    let path = case["model"].as_str().unwrap_or_default();
    let model = std::fs::read(path).map_err(|error| failed(&error))?;
    let signature = inspect(&model).map_err(|error| refused(&error))?;
    let provider = ExecutionProvider::Cpu;
    let options = LoadOptions { provider, threads: 1, signature: &signature, engine: None };
    let mut graph = backend.load(model, &options).map_err(|error| refused(&error))?;
    let given = case["inputs"].as_array().map(Vec::as_slice).unwrap_or_default();
    let inputs = signature.inputs.iter().zip(given).map(|(info, given)| {
        let fits = given[0] == info.element.name();
        let bytes = bytes_of(given[2].as_str().unwrap_or_default());
        let shape = serde_json::from_value(given[1].clone()).ok();
        let value = shape.zip(bytes).filter(|_| fits);
        let value = value.map(|(shape, bytes)| TensorValue { element: info.element, shape, bytes });
        value.ok_or_else(|| Stopped::Failed(format!("no value for input `{}`", info.name)))
    });
    let inputs = inputs.collect::<Result<Vec<_>, _>>()?;
    if inputs.len() != signature.inputs.len() || inputs.len() != given.len() {
        return Err(Stopped::Failed("another number of inputs".to_owned()));
    }
    let outputs = graph.run(&inputs, &StopSignal::default()).map_err(|error| failed(&error))?;
    Ok(outputs.iter().map(|it| json!([it.element.name(), it.shape, hex(&it.bytes)])).collect())
}

fn bytes_of(digits: &str) -> Option<Vec<u8>> {
    let pairs = digits.as_bytes().chunks(2);
    pairs.map(|pair| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()).collect()
}
