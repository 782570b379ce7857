//! Both languages implement the same WIT: each of its functions is in the Rust SDK, in the probes
//! and in the list of operations. (`guest-sdk-python/tests/test_contract.py` checks the Python SDK,
//! and the compiler the host.)

use std::collections::BTreeSet;
use std::fs;

use gleaner_test_support::operations::{Operation, Price};
use gleaner_tests::root;

/// The names of all functions of `wit/`, as `data.frame.mean-luma` or `data.now-ns`.
fn functions() -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for interface in ["data", "trigger", "inference", "log", "scratch"] {
        let (mut resource, wit) = (None, read(&format!("wit/{interface}.wit")));
        for line in wit.lines().map(str::trim) {
            if let Some(name) = line.strip_prefix("resource ") {
                resource = name.strip_suffix(" {");
            } else if line == "}" {
                resource = None;
            } else if let Some(name) = function(line) {
                let of = resource.map_or_else(String::new, |resource| format!("{resource}."));
                assert!(
                    found.insert(format!("{interface}.{of}{name}")),
                    "`{name}` is twice in {interface}.wit"
                );
            }
        }
    }
    found
}

fn function(line: &str) -> Option<&str> {
    let (name, rest) = line.split_once(": ")?;
    let is_name = name.chars().all(|letter| letter.is_ascii_lowercase() || letter == '-');
    (is_name && rest.strip_prefix("static ").unwrap_or(rest).starts_with("func(")).then_some(name)
}

fn read(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap_or_else(|_| panic!("no {path}"))
}

/// The last part of a name, as spelled in Rust and Python.
fn spelled(name: &str) -> String {
    name.rsplit('.').next().unwrap_or(name).replace('-', "_")
}

#[test]
fn the_list_of_operations_matches_the_interface() {
    let listed: BTreeSet<_> =
        Operation::ALL.iter().map(|operation| operation.name().to_owned()).collect();
    assert_eq!(
        listed.len(),
        Operation::ALL.len(),
        "an operation is twice in test-support/src/operations/list.rs"
    );
    let offered = functions();
    let lacking: Vec<_> = offered.difference(&listed).collect();
    let beyond: Vec<_> = listed.difference(&offered).collect();
    assert!(lacking.is_empty(), "missing in test-support/src/operations/list.rs: {lacking:?}");
    assert!(beyond.is_empty(), "missing in wit/: {beyond:?}");
    assert!(offered.len() >= 40, "only {} functions were found in wit/", offered.len());
}

#[test]
fn the_rust_sdk_calls_every_function_of_the_interface() {
    for name in functions() {
        let (interface, _) = name.split_once('.').expect("an interface");
        let (sdk, function) = (read(&format!("guest-sdk-rust/src/{interface}.rs")), spelled(&name));
        let called = [format!("self.0.{function}("), format!("::{function}(")]
            .iter()
            .any(|call| sdk.contains(call));
        assert!(called, "guest-sdk-rust/src/{interface}.rs does not call `{name}` of wit/");
    }
}

#[test]
fn twins_among_the_test_lambdas_call_every_function() {
    // `drives` tests that both get the same results, and `native` that the fake host of the Rust
    // SDK returns the same.
    for file in ["rust/src/lib.rs", "python/main.py"] {
        let text =
            ["probe", "keeper"].map(|name| read(&format!("tests/lambdas/{name}/{file}"))).concat();
        let words: BTreeSet<_> = text.split(|c: char| !c.is_alphanumeric() && c != '_').collect();
        for operation in Operation::ALL.iter().filter(|operation| operation.price() != Price::Never)
        {
            let name = operation.name();
            assert!(
                words.contains(&*spelled(name)),
                "neither probe nor keeper calls `{name}` in {file}"
            );
        }
    }
}
