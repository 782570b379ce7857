//! Runs a test that measures its process in a process of its own: this program again.

use std::env;
use std::process::{Command, Stdio};

/// Variable that is set in the process that runs only one test.
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
    let [printed, errors] =
        [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text));
    print!("{printed}");
    assert!(output.status.success() && printed.contains("1 passed"), "{}; {errors}", output.status);
    true
}
