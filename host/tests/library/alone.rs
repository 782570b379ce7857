//! A test that counts what its process has needs one without other tests: this program once more.

use std::env;
use std::process::{Command, Stdio};

/// Set in the process that runs one test only.
const ALONE: &str = "GLEANER_ALONE";

/// Runs the test `name` in a process of its own and returns `true`; in that process it returns
/// `false` at once, so that the test goes on.
///
/// # Panics
///
/// If the test fails there, or this program has no test of that name.
pub fn ran_elsewhere(name: &str) -> bool {
    if env::var_os(ALONE).is_some() {
        return false;
    }
    let mut test = Command::new(env::current_exe().expect("a program has a path"));
    test.args(["--exact", name, "--nocapture"]).env(ALONE, "1").stdin(Stdio::null());
    let output = test.output().expect("this program starts once more");
    let [said, errors] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    print!("{said}");
    assert!(output.status.success() && said.contains("1 passed"), "{}; {errors}", output.status);
    true
}
