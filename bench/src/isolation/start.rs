//! Measures the start of a lambda without a network: the lifetime of a process that replays one
//! message. Its `init` returns before the end, so the true value is lower.

use std::process::{Command, Stdio};
use std::time::Instant;

use gleaner_tests::drive::{CdrBuilder, IMAGE, one_topic};
use gleaner_tests::{TempFolder, program, runtime};

use crate::live::lambda;
use crate::measure::Twin;
use gleaner_bench::{Figure, python};

/// Goals for the lifetime in ms: wasm, and Python without imports of the lambda.
const GOALS_MS: [(Twin, f64); 2] = [(Twin::Rust, 10.0), (Twin::Python, 150.0)];

/// Adds the figures.
pub(super) fn figures(rounds: usize, figures: &mut Vec<Figure>) {
    let folder = TempFolder::new();
    // Only the header of the type: the lambda reads nothing else.
    let (_, header) = IMAGE.split_once("====").expect("it has a header");
    let schema = format!("std_msgs/Header header\n===={header}");
    let message = (0, CdrBuilder::header().done());
    let drive = one_topic(&folder, "/imu/synthetic", "sensor_msgs/msg/Imu", &schema, &[message]);
    let mut lifetimes = GOALS_MS.map(|(kind, goal)| (kind, goal, [Vec::new(), Vec::new()]));
    // The first run of each compiles.
    for round in 0..=rounds {
        for (kind, _, [bare, below_shim]) in &mut lifetimes {
            for (with_shim, series) in [(false, bare), (true, below_shim)] {
                let out = TempFolder::new();
                let mut replay = if with_shim { under_shim(&runtime()) } else { runtime() };
                replay
                    .arg("replay")
                    .arg(lambda("imu", *kind))
                    .arg(&drive)
                    .arg("--no-record")
                    .arg("--out")
                    .arg(out.path());
                let ms = lifetime_ms(replay);
                if round > 0 {
                    series.push(ms);
                }
            }
        }
    }
    for (kind, goal, [bare, below_shim]) in &lifetimes {
        let name = format!("process start to end with one message, from cache, {kind}");
        figures.push(Figure::at_most(&name, "ms", *goal, bare));
        figures.push(Figure::without_goal(
            &format!("{name}, under gleaner-shim"),
            "ms",
            below_shim,
        ));
    }
    let empty = (0..rounds).map(|_| {
        let mut python = Command::new(python());
        python.args(["-I", "-c", "pass"]);
        lifetime_ms(python)
    });
    figures.push(Figure::without_goal(
        "the same for a bare Python interpreter",
        "ms",
        &empty.collect::<Vec<_>>(),
    ));
}

/// Wraps `runtime`, which has no arguments yet, in its shim.
fn under_shim(runtime: &Command) -> Command {
    let mut shim = Command::new(program("gleaner-shim"));
    shim.arg("--").arg(runtime.get_program());
    shim.envs(runtime.get_envs().filter_map(|(name, value)| Some((name, value?))));
    shim
}

/// Time from the start of a process to its end, in ms.
///
/// # Panics
///
/// If it fails.
fn lifetime_ms(mut command: Command) -> f64 {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    let started = Instant::now();
    let output = command.output().expect("the program starts");
    let ms = started.elapsed().as_secs_f64() * 1e3;
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    ms
}
