//! The counts of a live recorder are in the summary of the run, and the vehicle's limits apply to
//! the recorder and to the lambda alike.

use std::fs;
use std::path::Path;
use std::process::Command;

use gleaner_protocol::LiveStatus;
use gleaner_protocol::link::{RecorderReport, RecorderStatus};
use gleaner_tests::live::{JsonReport, run};
use gleaner_tests::{LambdaCopy, TempFolder, program};
use libtest_mimic::Failed;

use crate::{DdsCase, case};

pub const CASES: &[DdsCase] = &[
    case(
        "triggers_suppressed_by_a_full_disk_are_in_the_summary_and_in_the_report",
        &[],
        disk_suppressed,
    ),
    case("a_recorder_accepts_a_lambda_with_the_lower_limits_of_its_vehicle", &[], on_a_vehicle),
];

fn disk_suppressed() -> Result<(), Failed> {
    let out = TempFolder::new();
    let floor = u64::MAX.to_string();
    let (last, summary) = recorded(out.path(), "", &["--disk-floor", &floor], |status| {
        status.recording.disk_suppressed > 2
    })?;
    // The lambda continued until it was stopped.
    if summary.recording.disk_suppressed < last.recording.disk_suppressed {
        return Err(format!("{:?}, and before {:?}", summary.recording, last.recording).into());
    }
    let reported = Command::new(program("gleaner")).arg("report").arg(out.path()).output()?;
    let page = fs::read_to_string(out.path().join("report.html"))?;
    let row = format!(
        r#"["triggers without a window: the disk was too full",{}]"#,
        summary.recording.disk_suppressed
    );
    if page.contains(&row) {
        Ok(())
    } else {
        Err(format!("no `{row}` on the page: {reported:?}").into())
    }
}

fn on_a_vehicle() -> Result<(), Failed> {
    let out = TempFolder::new();
    let vehicle = out.write("vehicle.toml", "[limits]\nlog_lines = 7\n");
    let vehicle = vehicle.to_str().ok_or("a plain path")?;
    let results = out.path().join("live");
    let cooldown = "cooldown = \"1h\"\n";
    let (_, summary) = recorded(&results, cooldown, &["--vehicle", vehicle], |status| {
        status.recording.in_cooldown > 2
    })?;
    let counts = summary.recording;
    match (counts.windows, counts.lambdas_refused, counts.in_cooldown) {
        (1, 0, 3..) => Ok(()),
        _ => Err(format!("{counts:?}").into()),
    }
}

/// Runs a lambda that triggers ten times a second until `wanted` holds for a status of its
/// recorder. Returns that status, and the recorder's counts in the summary.
fn recorded(
    out: &Path,
    record: &str,
    args: &[&str],
    wanted: fn(&RecorderStatus) -> bool,
) -> Result<(RecorderStatus, RecorderStatus), Failed> {
    let record = format!("\n[record]\ntopics = [\"/imu/data\"]\n{record}");
    let lambda = LambdaCopy::of("tests/lambdas/ticker/rust", |manifest| manifest + &record);
    let started = run(lambda.path(), out, args);
    let last = started.until("counts of the recorder", |line| match line {
        JsonReport::Recorder(RecorderReport::Status(status)) if wanted(&status) => Some(*status),
        _ => None,
    });
    let finished = started.interrupt();
    let summary: LiveStatus = serde_json::from_slice(&fs::read(out.join("summary.json"))?)?;
    let of_recorder = summary
        .recording
        .ok_or_else(|| format!("no counts of the recorder: {}", finished.stderr))?;
    Ok((last, *of_recorder))
}
