//! Each rule answers the calls in `cases/*.json` as they say: a call is a list of its name, what it
//! is given, and its answer. The Python SDK, where the rules stand a second time, answers the same;
//! but for cases that say why they are `not in Python`.

mod cases {
    pub mod causing;
    pub mod pictures;
    pub mod seeing;
    pub mod waking;
}

use serde_json::{Value, json};

/// What answers the calls of one case, one after the other: the name of a call, and what it is
/// given.
type Answers<'a> = Box<dyn FnMut(&str, &[Value]) -> Value + 'a>;

/// Replays all cases of a file; `start` is given what a case is about.
#[track_caller]
fn replay(file: &str, cases: &str, start: impl Fn(&Value) -> Answers<'static>) {
    let cases: Vec<Value> = serde_json::from_str(cases).unwrap();
    assert!(!cases.is_empty(), "{file}");
    for case in &cases {
        let mut answers = start(&case["given"]);
        for (n, call) in case["calls"].as_array().unwrap().iter().enumerate() {
            let [name, arguments @ .., wanted] = call.as_array().unwrap().as_slice() else {
                panic!("{call} is no call")
            };
            let arguments = arguments.iter().map(plain).collect::<Vec<_>>();
            let name = name.as_str().unwrap();
            assert_eq!(
                &answers(name, &arguments),
                wanted,
                "{file}: {}: call {n}, {name}",
                case["name"]
            );
        }
    }
}

/// A long text may be written shorter.
fn plain(given: &Value) -> Value {
    match given {
        Value::Object(repeated) if repeated.contains_key("times") => {
            json!(text(&repeated["of"]).repeat(whole(&repeated["times"])))
        }
        Value::Array(items) => items.iter().map(plain).collect(),
        given => given.clone(),
    }
}

/// A number that may be none.
fn float(given: &Value) -> f64 {
    given.as_f64().unwrap_or_else(|| given["float"].as_str().unwrap().parse().unwrap())
}

fn text(given: &Value) -> &str {
    given.as_str().unwrap()
}

fn whole(given: &Value) -> usize {
    given.as_u64().unwrap() as usize
}

fn ns(given: &Value) -> i64 {
    given.as_i64().unwrap()
}

/// Nothing, or why not.
fn refused<T>(result: Result<T, impl ToString>) -> Value {
    result.err().map_or(Value::Null, |error| json!(error.to_string()))
}
