//! Checks each rule against `cases/*.json`: a call is a list of its name, its arguments, and its
//! result. The Python SDK, which implements the rules again, passes the same cases, except those
//! with a reason why they are `not in Python`.

mod cases {
    pub mod causing;
    pub mod pictures;
    pub mod seeing;
    pub mod waking;
}

use serde_json::{Value, json};

/// Replies to the calls of one case, given the name of a call and its arguments.
type CaseReplies<'a> = Box<dyn FnMut(&str, &[Value]) -> Value + 'a>;

/// Replays all cases of a file; `start` gets the settings of a case.
#[track_caller]
fn replay(file: &str, cases: &str, start: impl Fn(&Value) -> CaseReplies<'static>) {
    let cases: Vec<Value> = serde_json::from_str(cases).unwrap();
    assert!(!cases.is_empty(), "{file}");
    for case in &cases {
        let mut reply = start(&case["given"]);
        for (n, call) in case["calls"].as_array().unwrap().iter().enumerate() {
            let [name, arguments @ .., wanted] = call.as_array().unwrap().as_slice() else {
                panic!("{call} is not a call")
            };
            let arguments = arguments.iter().map(plain).collect::<Vec<_>>();
            let name = name.as_str().unwrap();
            assert_eq!(
                &reply(name, &arguments),
                wanted,
                "{file}: {}: call {n}, {name}",
                case["name"]
            );
        }
    }
}

/// Expands the short form of a long text.
fn plain(given: &Value) -> Value {
    match given {
        Value::Object(repeated) if repeated.contains_key("times") => {
            json!(text(&repeated["of"]).repeat(whole(&repeated["times"])))
        }
        Value::Array(items) => items.iter().map(plain).collect(),
        given => given.clone(),
    }
}

/// Parses a number, which may be NaN or infinite.
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

/// Returns null, or the error text.
fn refused<T>(result: Result<T, impl ToString>) -> Value {
    result.err().map_or(Value::Null, |error| json!(error.to_string()))
}
