//! The WIT is one page for both languages: what it offers, the Rust SDK must offer. (`guest-sdk-python/tests/test_contract.py`
//! does the same for Python, and the compiler for the host.)

use gleaner_tests::root;

/// Names of the functions in a WIT file, as Rust spells them.
fn functions(wit: &str) -> Vec<String> {
    let lines = wit.lines().filter_map(|line| line.trim().split_once(": "));
    let functions = lines.filter(|(name, rest)| {
        let rest = rest.strip_prefix("static ").unwrap_or(rest);
        rest.starts_with("func(") && name.chars().all(|letter| letter.is_ascii_lowercase() || letter == '-')
    });
    functions.map(|(name, _)| name.replace('-', "_")).collect()
}

#[test]
fn the_rust_sdk_calls_every_function_of_the_interface() {
    let mut found = 0;
    for interface in ["data", "trigger", "inference", "log", "scratch"] {
        let read = |path: String| std::fs::read_to_string(root().join(&path)).unwrap_or_else(|_| panic!("no {path}"));
        let sdk = read(format!("guest-sdk-rust/src/{interface}.rs"));
        for function in functions(&read(format!("wit/{interface}.wit"))) {
            let called =
                [format!("self.0.{function}("), format!("::{function}(")].iter().any(|call| sdk.contains(call));
            assert!(called, "guest-sdk-rust/src/{interface}.rs does not call `{function}` of wit/{interface}.wit");
            found += 1;
        }
    }
    assert!(found >= 40, "only {found} functions were found in wit/");
}
