//! Counts tests in the output of Rust's test programs.

use std::path::Path;

#[derive(Debug, Default)]
pub(super) struct TestCounts {
    pub(super) passed: u64,
    pub(super) failed: Vec<String>,
    /// Names of the skipped tests, with their reasons.
    pub(super) skipped: Vec<String>,
}

impl TestCounts {
    pub(super) fn fail(&mut self, name: &str) {
        self.failed.push(name.to_owned());
    }

    pub(super) fn skip(&mut self, name: &str, reason: &str) {
        self.skipped.push(format!("{name}: {reason}"));
    }

    /// Ends the suite, of which `status` is what its program ended with. If it did not succeed, it
    /// has at least one failed test. A suite without tests is a failure, too.
    pub(super) fn end(&mut self, is_success: bool, status: &str) {
        if !is_success && self.failed.is_empty() {
            self.fail(status);
        } else if self.passed == 0 && self.failed.is_empty() && self.skipped.is_empty() {
            self.fail("there are no tests");
        }
    }

    pub(super) fn add(&mut self, counts: TestCounts, suite: &str) {
        let of_suite = |name: String| format!("{suite}: {name}");
        self.passed += counts.passed;
        self.failed.extend(counts.failed.into_iter().map(of_suite));
        self.skipped.extend(counts.skipped.into_iter().map(of_suite));
    }
}

/// Parses the output of Rust test programs that cargo starts one after the other.
#[derive(Debug, Default)]
pub(super) struct LibtestParser {
    pub(super) counts: TestCounts,
    /// The test program that cargo started last.
    program: String,
    /// Number of the tests of that program, until it has printed its result.
    running: Option<u64>,
    /// The test whose output follows.
    test: String,
    /// Number of tests of that program that printed that they were skipped.
    printed: u64,
}

impl LibtestParser {
    pub(super) fn parse_line(&mut self, line: &str) {
        // Of a test that passed, `--show-output` prints what it printed.
        if let Some(reason) = line.strip_prefix("skipped: ") {
            self.printed += 1;
            self.counts.skip(&format!("{}: {}", self.program, self.test), reason);
            return;
        }
        let line = line.trim_start();
        let running = line.strip_prefix("Running ").and_then(|rest| rest.rsplit_once(" ("));
        if let Some((_, program)) = running {
            self.begin(program_name(program.trim_end_matches(')')));
        } else if let Some(package) = line.strip_prefix("Doc-tests ") {
            self.begin(format!("docs of {package}"));
        } else if let Some(number) = running_tests(line) {
            // Within a program, a test shows the output of another one.
            self.running.get_or_insert(number);
        } else if let Some(counts) = line.strip_prefix("test result: ") {
            let of = |kind: &str| count_before(counts, kind);
            let passed = of(" passed");
            let all = passed + of(" failed") + of(" ignored") + of(" measured");
            if self.running == Some(all) {
                self.running = None;
                self.counts.passed += passed.saturating_sub(std::mem::take(&mut self.printed));
            }
        } else if let Some(name) = line.strip_prefix("---- ") {
            self.test = name.split(" stdout").next().unwrap_or(name).to_owned();
        } else if let Some(test) = line.strip_prefix("test ") {
            self.end_test(test);
        }
    }

    /// Counts a test by its line, without `test ` in front.
    fn end_test(&mut self, test: &str) {
        let Some((name, result)) = test.rsplit_once(" ... ") else { return };
        let name = format!("{}: {}", self.program, name.trim_end());
        if result == "FAILED" {
            self.counts.fail(&name);
        } else if let Some(reason) = result.strip_prefix("ignored") {
            let reason = reason.trim_start_matches(", ");
            self.counts.skip(&name, if reason.is_empty() { "ignored" } else { reason });
        }
    }

    fn begin(&mut self, program: String) {
        self.close();
        self.program = program;
    }

    /// Counts a failure if a test program began but printed no result, since it was killed or
    /// aborted.
    pub(super) fn close(&mut self) {
        if self.running.take().is_some() {
            self.counts.fail(&format!("{}: ended during its tests", self.program));
        }
    }
}

/// Returns the number in `running 2 tests`.
fn running_tests(line: &str) -> Option<u64> {
    let (number, word) = line.strip_prefix("running ")?.split_once(' ')?;
    number.parse().ok().filter(|_| ["test", "tests"].contains(&word))
}

/// Returns the number before `kind` in the result of a program; 0 without one.
fn count_before(counts: &str, kind: &str) -> u64 {
    let before = counts.split_once(kind).map_or("", |(before, _)| before);
    let digits = before.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    before[digits..].parse().unwrap_or(0)
}

/// `rooms` of `target/release/deps/rooms-0123456789abcdef`.
fn program_name(path: &str) -> String {
    let file = Path::new(path).file_name().unwrap_or_default().to_string_lossy();
    file.rsplit_once('-').map_or(file.to_string(), |(name, _)| name.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(is_success: bool, text: &str) -> TestCounts {
        let mut parser = LibtestParser::default();
        text.lines().for_each(|line| parser.parse_line(line));
        parser.close();
        parser.counts.end(is_success, "ended with exit status: 1");
        parser.counts
    }

    #[test]
    fn the_results_of_several_test_programs_are_added() {
        let text = "     Running unittests src/lib.rs (target/release/deps/gleaner_cli-0a1b)\n\nrunning 13 tests\n\
                    test a::b ... ok\ntest c ... ignored, needs a GPU\n\nsuccesses:\n\n---- a::b stdout ----\n\
                    skipped: no drive\n\n\
                    test result: ok. 12 passed; 0 failed; 1 ignored; 0 measured; 0 filtered out\n\
                    \x20    Running tests/rooms.rs (target/release/deps/rooms-77)\n\nrunning 4 tests\n\
                    test the_house   ... FAILED\n---- shown stdout ----\nrunning 1 test\n\
                    test result: ok. 1 passed; 0 failed; 0 ignored; 0 measured; 3 filtered out\n\
                    test result: FAILED. 3 passed; 1 failed; 0 ignored; 0 measured; 0 filtered out\n\
                    \x20  Doc-tests gleaner_sdk\n\nrunning 0 tests\n\n\
                    test result: ok. 0 passed; 0 failed; 0 ignored; 0 measured; 0 filtered out\n";
        let counts = counted(false, text);
        assert_eq!(counts.passed, 14);
        assert_eq!(counts.failed, ["rooms: the_house"]);
        assert_eq!(counts.skipped, ["gleaner_cli: c: needs a GPU", "gleaner_cli: a::b: no drive"]);
    }

    #[test]
    fn a_test_program_that_is_killed_counts_as_a_failure() {
        let text = "     Running tests/a.rs (target/release/deps/a-1)\nrunning 2 tests\ntest x ... ok\n\
                    \x20    Running tests/b.rs (target/release/deps/b-2)\nrunning 1 test\n\
                    test result: ok. 1 passed; 0 failed\n";
        let counts = counted(false, text);
        assert_eq!((counts.passed, counts.skipped.len()), (1, 0));
        assert_eq!(counts.failed, ["a: ended during its tests"]);
    }

    #[test]
    fn a_suite_that_does_not_compile_counts_as_a_failure() {
        let counts = counted(false, "error: could not compile `x`");
        assert_eq!(counts.failed, ["ended with exit status: 1"]);
    }

    #[test]
    fn a_suite_without_any_test_is_a_failure() {
        let counts = counted(true, "running 0 tests\n\ntest result: ok. 0 passed; 0 failed");
        assert_eq!(counts.failed, ["there are no tests"]);
    }
}
