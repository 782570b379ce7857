//! Counts tests in the output of test runners.

use std::path::Path;

/// Output format of a test suite.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OutputFormat {
    /// Several Rust test programs, started by cargo.
    Libtest,
    /// Python's unittest with `-v`.
    Unittest,
    /// pytest with `-q`.
    Pytest,
    /// No counts: the exit status stands for one test.
    None,
}

/// Counts of the tests in a suite.
#[derive(Debug)]
pub(super) struct TestCounts {
    pub(super) passed: u64,
    pub(super) failed: u64,
    pub(super) skipped: u64,
    /// Names of the failed tests.
    pub(super) names: Vec<String>,
    format: OutputFormat,
    /// The test program that cargo started last.
    program: String,
    /// True while that program runs tests and has not printed its result.
    open: bool,
    /// Number of tests that unittest ran.
    ran: u64,
}

impl TestCounts {
    pub(super) fn new(format: OutputFormat) -> TestCounts {
        TestCounts {
            passed: 0,
            failed: 0,
            skipped: 0,
            names: Vec::new(),
            format,
            program: String::new(),
            open: false,
            ran: 0,
        }
    }

    /// Parses one line of output.
    pub(super) fn parse_line(&mut self, line: &str) {
        match self.format {
            OutputFormat::Libtest => self.parse_libtest(line),
            OutputFormat::Unittest => self.parse_unittest(line),
            OutputFormat::Pytest => self.parse_pytest(line),
            OutputFormat::None => {}
        }
    }

    /// Ends the suite. If it did not succeed, it has at least one failed test, named `status` if
    /// its output names none. A suite without tests is a failure, too.
    pub(super) fn end(&mut self, success: bool, status: &str) {
        self.close();
        if self.format == OutputFormat::None && success {
            self.passed = 1;
        }
        if !success && self.failed == 0 {
            self.fail(status);
        } else if self.passed + self.failed + self.skipped == 0 {
            self.fail("there are no tests");
        }
    }

    /// Adds the counts of `suite`.
    pub(super) fn add(&mut self, counts: TestCounts, suite: &str) {
        self.passed += counts.passed;
        self.failed += counts.failed;
        self.skipped += counts.skipped;
        self.names.extend(counts.names.into_iter().map(|name| format!("{suite}: {name}")));
    }

    fn parse_libtest(&mut self, line: &str) {
        let line = line.trim_start();
        if let Some((_, program)) =
            line.strip_prefix("Running ").and_then(|rest| rest.rsplit_once(" ("))
        {
            self.close();
            self.program = program_name(program.trim_end_matches(')'));
        } else if let Some(package) = line.strip_prefix("Doc-tests ") {
            self.close();
            self.program = format!("docs of {package}");
        } else if line
            .strip_prefix("running ")
            .is_some_and(|rest| rest.ends_with(" test") || rest.ends_with(" tests"))
        {
            self.close();
            self.open = true;
        } else if let Some(counts) = line.strip_prefix("test result: ") {
            self.open = false;
            self.passed += count_before(counts, " passed");
            self.failed += count_before(counts, " failed");
            self.skipped += count_before(counts, " ignored");
        } else if let Some(name) =
            line.strip_prefix("test ").and_then(|rest| rest.strip_suffix("... FAILED"))
        {
            self.names.push(format!("{}: {}", self.program, name.trim_end()));
        }
    }

    fn parse_unittest(&mut self, line: &str) {
        if let Some(name) = line.strip_prefix("FAIL: ").or_else(|| line.strip_prefix("ERROR: ")) {
            self.names.push(name.to_owned());
        } else if let Some(ran) = line.strip_prefix("Ran ") {
            self.ran = count_before(ran, " test");
        } else if line == "OK" || line.starts_with("OK (") || line.starts_with("FAILED (") {
            let count = |what| count_after(line, what);
            self.failed = count("failures=") + count("errors=") + count("unexpected successes=");
            self.skipped = count("skipped=");
            // An error in a fixture counts as an error, although its tests did not run.
            self.passed = self.ran.saturating_sub(self.failed + self.skipped);
        }
    }

    fn parse_pytest(&mut self, line: &str) {
        if let Some(name) = line.strip_prefix("FAILED ").or_else(|| line.strip_prefix("ERROR ")) {
            self.names.push(name.split(" - ").next().unwrap_or(name).to_owned());
        } else if let Some((counts, _)) =
            line.rsplit_once(" in ").filter(|_| line.starts_with(|c: char| c.is_ascii_digit()))
        {
            // Its last line, such as `1 failed, 3 passed, 2 skipped in 0.50s`.
            self.passed = count_before(counts, " passed");
            self.failed = count_before(counts, " failed") + count_before(counts, " error");
            self.skipped = count_before(counts, " skipped");
        }
    }

    /// Counts a failure if a test program began but printed no result, since it was killed or
    /// aborted.
    fn close(&mut self) {
        if std::mem::take(&mut self.open) {
            let name = format!("{}: ended during its tests", self.program);
            self.fail(&name);
        }
    }

    fn fail(&mut self, name: &str) {
        self.failed += 1;
        self.names.push(name.to_owned());
    }
}

/// `rooms` of `target/release/deps/rooms-0123456789abcdef`.
fn program_name(path: &str) -> String {
    let file = Path::new(path).file_name().unwrap_or_default().to_string_lossy();
    file.rsplit_once('-').map_or(file.to_string(), |(name, _)| name.to_owned())
}

/// The number before `what`; 0 if there is none.
fn count_before(text: &str, what: &str) -> u64 {
    let before = text.find(what).map_or("", |at| &text[..at]);
    let digits = before.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    before[digits..].parse().unwrap_or(0)
}

/// The number after `what`; 0 if there is none.
fn count_after(text: &str, what: &str) -> u64 {
    let after = text.find(what).map_or("", |at| &text[at + what.len()..]);
    let digits = after.find(|c: char| !c.is_ascii_digit()).unwrap_or(after.len());
    after[..digits].parse().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(format: OutputFormat, success: bool, text: &str) -> TestCounts {
        let mut counts = TestCounts::new(format);
        text.lines().for_each(|line| counts.parse_line(line));
        counts.end(success, "ended with exit status: 1");
        counts
    }

    fn totals(counts: &TestCounts) -> [u64; 3] {
        [counts.passed, counts.failed, counts.skipped]
    }

    #[test]
    fn the_results_of_several_test_programs_are_added() {
        let text = "     Running unittests src/lib.rs (target/release/deps/gleaner_cli-0a1b)\n\nrunning 12 tests\n\
                    test a::b ... ok\ntest result: ok. 12 passed; 0 failed; 1 ignored; 0 measured; 0 filtered out\n\
                    \x20    Running tests/rooms.rs (target/release/deps/rooms-77)\n\nrunning 1 test\n\
                    test the_house   ... FAILED\n\
                    test result: FAILED. 3 passed; 1 failed; 2 ignored; 0 measured; 0 filtered out\n\
                    \x20  Doc-tests gleaner_sdk\n\nrunning 0 tests\n\n\
                    test result: ok. 0 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out\n";
        let counts = counted(OutputFormat::Libtest, false, text);
        assert_eq!(totals(&counts), [15, 1, 3]);
        assert_eq!(counts.names, ["rooms: the_house"]);
    }

    #[test]
    fn a_test_program_that_is_killed_counts_as_a_failure() {
        let text = "     Running tests/a.rs (target/release/deps/a-1)\nrunning 2 tests\ntest x ... ok\n\
                    \x20    Running tests/b.rs (target/release/deps/b-2)\nrunning 1 test\n\
                    test result: ok. 1 passed; 0 failed\n";
        let counts = counted(OutputFormat::Libtest, false, text);
        assert_eq!(totals(&counts), [1, 1, 0]);
        assert_eq!(counts.names, ["a: ended during its tests"]);
    }

    #[test]
    fn a_suite_that_does_not_compile_counts_as_a_failure() {
        let counts = counted(OutputFormat::Libtest, false, "error: could not compile `x`");
        assert_eq!(totals(&counts), [0, 1, 0]);
        assert_eq!(counts.names, ["ended with exit status: 1"]);
    }

    #[test]
    fn unittest_counts_its_skipped_and_failed_tests_among_those_it_ran() {
        let text = "FAIL: test_a (m.C)\nERROR: test_b (m.C)\nRan 9 tests in 0.1s\n\nFAILED (failures=1, errors=1, skipped=2)";
        let counts = counted(OutputFormat::Unittest, false, text);
        assert_eq!(totals(&counts), [5, 2, 2]);
        assert_eq!(counts.names, ["test_a (m.C)", "test_b (m.C)"]);
        assert_eq!(
            totals(&counted(OutputFormat::Unittest, true, "Ran 1 test in 0.1s\n\nOK")),
            [1, 0, 0]
        );
        assert_eq!(
            totals(&counted(OutputFormat::Unittest, true, "Ran 3 tests in 0.1s\n\nOK (skipped=1)")),
            [2, 0, 1]
        );
    }

    #[test]
    fn pytest_prints_its_counts_in_its_last_line() {
        let text = "..F.s  [100%]\nFAILED examples/a/tests/test_a.py::test_x[1] - assert 1 in [2]\nERROR b/test_b.py\n\
                    1 failed, 12 passed, 3 skipped, 2 errors in 4.52s";
        let counts = counted(OutputFormat::Pytest, false, text);
        assert_eq!(totals(&counts), [12, 3, 3]);
        assert_eq!(counts.names, ["examples/a/tests/test_a.py::test_x[1]", "b/test_b.py"]);
        assert_eq!(
            totals(&counted(OutputFormat::Pytest, true, "17 passed in 62.21s (0:01:02)")),
            [17, 0, 0]
        );
        assert_eq!(
            totals(&counted(OutputFormat::Pytest, false, "no tests ran in 0.01s")),
            [0, 1, 0]
        );
    }

    #[test]
    fn a_suite_without_any_test_is_a_failure() {
        // Up to Python 3.11, unittest reports success.
        assert_eq!(
            totals(&counted(OutputFormat::Unittest, true, "Ran 0 tests in 0.000s\n\nOK")),
            [0, 1, 0]
        );
        assert_eq!(
            totals(&counted(
                OutputFormat::Unittest,
                false,
                "Ran 0 tests in 0.000s\n\nNO TESTS RAN"
            )),
            [0, 1, 0]
        );
        assert_eq!(
            totals(&counted(
                OutputFormat::Libtest,
                true,
                "running 0 tests\n\ntest result: ok. 0 passed; 0 failed"
            )),
            [0, 1, 0]
        );
    }

    #[test]
    fn a_suite_without_counts_is_one_test() {
        assert_eq!(
            totals(&counted(
                OutputFormat::None,
                true,
                "Success: no issues found in 5 source files"
            )),
            [1, 0, 0]
        );
        assert_eq!(totals(&counted(OutputFormat::None, false, "Found 1 error")), [0, 1, 0]);
    }
}
