//! Counts tests in a JUnit file, as cargo-nextest and pytest write it.

use std::fs;
use std::path::Path;

use serde::Deserialize;

use super::counts::TestCounts;

#[derive(Deserialize)]
struct JunitReport {
    #[serde(rename = "testsuite", default)]
    programs: Vec<JunitSuite>,
}

#[derive(Deserialize)]
struct JunitSuite {
    #[serde(rename = "testcase", default)]
    tests: Vec<JunitTest>,
}

#[derive(Deserialize)]
struct JunitTest {
    #[serde(rename = "@name")]
    name: String,
    /// Its test program or module.
    #[serde(rename = "@classname", default)]
    program: String,
    /// Of pytest: its setup failed, or its file cannot be imported.
    error: Option<JunitCause>,
    failure: Option<JunitCause>,
    skipped: Option<JunitCause>,
    #[serde(rename = "system-out")]
    output: Option<JunitOutput>,
    #[serde(rename = "system-err")]
    errors: Option<JunitOutput>,
    /// It failed, and passed when it was repeated.
    #[serde(rename = "flakyFailure")]
    flaky: Option<JunitCause>,
}

#[derive(Deserialize)]
struct JunitCause {
    #[serde(rename = "@message", default)]
    message: String,
}

#[derive(Deserialize)]
struct JunitOutput {
    #[serde(rename = "$text", default)]
    text: String,
}

/// Adds the tests in `file` to `counts`. One that prints `skipped: REASON` counts as skipped, too.
pub(super) fn add(counts: &mut TestCounts, file: &Path) -> Result<(), String> {
    let text = fs::read_to_string(file).map_err(|error| error.to_string())?;
    add_text(counts, &text).map_err(|error| error.to_string())
}

fn add_text(counts: &mut TestCounts, text: &str) -> Result<(), quick_xml::DeError> {
    let report: JunitReport = quick_xml::de::from_str(text)?;
    for test in report.programs.into_iter().flat_map(|program| program.tests) {
        let name = format!("{} {}", test.program, test.name);
        let outputs = [&test.output, &test.errors].into_iter().flatten();
        let mut lines = outputs.flat_map(|output| output.text.lines());
        let printed = lines.find_map(|line| line.strip_prefix("skipped: "));
        if test.failure.is_some() || test.error.is_some() || test.flaky.is_some() {
            counts.fail(&name);
        } else if let Some(cause) = test.skipped {
            counts.skip(&name, &cause.message);
        } else if let Some(reason) = printed {
            counts.skip(&name, reason);
        } else {
            counts.passed += 1;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counted(text: &str) -> TestCounts {
        let mut counts = TestCounts::default();
        add_text(&mut counts, text).unwrap();
        counts
    }

    #[test]
    fn the_report_of_nextest_has_failures_and_what_tests_print() {
        // As version 0.9.143 writes it, with stack traces left out.
        let counts = counted(
            r#"<?xml version="1.0" encoding="UTF-8"?>
<testsuites name="nextest-run" tests="4" skipped="0" failures="2" errors="0" uuid="3" time="2.067">
    <testsuite name="nt" tests="2" skipped="0" errors="0" failures="1">
        <testcase name="abort" classname="nt" timestamp="2026-11-29T09:45:50.499+00:00" time="0.015">
            <failure message="process aborted with signal 6 (SIGABRT)" type="test abort">SIGABRT</failure>
            <system-out>
running 1 test
</system-out>
            <system-err></system-err>
        </testcase>
        <testcase name="ok" classname="nt" timestamp="2026-11-29T09:45:50.531+00:00" time="0.023">
            <system-out>
running 1 test
skipped: a &lt; b &amp; c
test ok ... ok

test result: ok. 1 passed; 0 failed; 0 ignored; 0 measured; 6 filtered out; finished in 0.00s

</system-out>
            <system-err></system-err>
        </testcase>
    </testsuite>
    <testsuite name="nt::slow" tests="2" skipped="0" errors="0" failures="1">
        <testcase name="waits" classname="nt::slow" time="2.012"><failure type="test timeout"/></testcase>
        <testcase name="fine" classname="nt::slow" time="0.1"/>
        <testcase name="again" classname="nt" time="0.1"><flakyFailure message="x" type="y"/></testcase>
        <testcase name="late" classname="nt" time="0.1"><system-err>skipped: no server
</system-err></testcase>
    </testsuite>
</testsuites>"#,
        );
        assert_eq!(counts.passed, 1);
        assert_eq!(counts.failed, ["nt abort", "nt::slow waits", "nt again"]);
        assert_eq!(counts.skipped, ["nt ok: a < b & c", "nt late: no server"]);
    }

    #[test]
    fn the_report_of_pytest_has_errors_and_reasons() {
        // As pytest 9 writes it.
        let counts = counted(
            r#"<?xml version="1.0" encoding="utf-8"?><testsuites name="pytest tests"><testsuite name="pytest" errors="1" failures="1" skipped="1" tests="4" time="0.102" timestamp="2026-11-29T09:50:00+00:00" hostname="h"><testcase classname="test_a" name="test_x[1]" time="0.001"><failure message="assert 1 == 2">def test_x(): ...</failure></testcase><testcase classname="test_a" name="test_y" time="0.000"><skipped type="pytest.skip" message="no &quot;drive&quot;">/a/test_a.py:4: no drive</skipped></testcase><testcase classname="test_a" name="test_z" time="0.001" /><testcase classname="" name="b.test_b" time="0.000"><error message="collection failure">ImportError</error></testcase></testsuite></testsuites>"#,
        );
        assert_eq!(counts.passed, 1);
        assert_eq!(counts.failed, ["test_a test_x[1]", " b.test_b"].map(str::to_owned));
        assert_eq!(counts.skipped, ["test_a test_y: no \"drive\""]);
    }
}
