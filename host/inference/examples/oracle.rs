//! Runs models that another program sends, for `tests/models/oracle.py`, which knows the results.
//!
//! The argument is the library of ONNX Runtime; without it, rten runs the models. A line of
//! standard input is a case, `{"model": PATH, "inputs": [[TYPE, SHAPE, HEX], ...]}`; the answer is
//! a line with `refused`, `failed` or `outputs`. With `--rules`, the rules for rten are printed as
//! rows of a table.

use std::error::Error;
use std::fmt::Display;
use std::io::{BufRead, stdin};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use gleaner_base::hex;
use gleaner_inference::backend::{
    Backend, ExecutionProvider, LoadOptions, OnnxRuntime, RtenBackend, StopSignal, TensorValue,
};
use gleaner_inference::inspect::{RTEN_RULES, inspect};
use serde_json::{Value, json};

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
        let answer = ran.unwrap_or_else(|_| Err(failed("it panicked")));
        println!("{}", answer.unwrap_or_else(|reason| reason));
    }
    Ok(())
}

fn refused(reason: impl Display) -> Value {
    json!({ "refused": reason.to_string() })
}

fn failed(reason: impl Display) -> Value {
    json!({ "failed": reason.to_string() })
}

/// Returns the answer with the outputs, or the one with the reason why there are none.
fn run(backend: &dyn Backend, case: &Value) -> Result<Value, Value> {
    let path = case["model"].as_str().unwrap_or_default();
    let model = std::fs::read(path).map_err(failed)?;
    let signature = inspect(&model).map_err(refused)?;
    let provider = ExecutionProvider::Cpu;
    let options = LoadOptions { provider, threads: 1, signature: &signature, engine: None };
    let mut graph = backend.load(model, &options).map_err(refused)?;
    let given = case["inputs"].as_array().map(Vec::as_slice).unwrap_or_default();
    let inputs = signature.inputs.iter().zip(given).map(|(info, given)| {
        let fits = given[0] == info.element.name();
        let bytes = bytes_of(given[2].as_str().unwrap_or_default());
        let shape = serde_json::from_value(given[1].clone()).ok();
        let value = shape.zip(bytes).filter(|_| fits);
        let value = value.map(|(shape, bytes)| TensorValue { element: info.element, shape, bytes });
        value.ok_or_else(|| failed(format_args!("no value for input `{}`", info.name)))
    });
    let inputs = inputs.collect::<Result<Vec<_>, _>>()?;
    if inputs.len() != signature.inputs.len() || inputs.len() != given.len() {
        return Err(failed("another number of inputs"));
    }
    let outputs = graph.run(&inputs, &StopSignal::default()).map_err(failed)?;
    let outputs = outputs.iter().map(|it| json!([it.element.name(), it.shape, hex(&it.bytes)]));
    Ok(json!({ "outputs": outputs.collect::<Vec<_>>() }))
}

fn bytes_of(digits: &str) -> Option<Vec<u8>> {
    let pairs = digits.as_bytes().chunks(2);
    pairs.map(|pair| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()).collect()
}
