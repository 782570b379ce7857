//! How long it takes until a lambda is there, without a network: the whole life of a process that
//! replays one message, from its start to its end. Its `init` has returned before that.

use std::process::{Command, Stdio};
use std::time::Instant;

use gleaner_tests::drive::{Cdr, IMAGE, one_topic};
use gleaner_tests::{Folder, program, root, runtime};

use crate::live::lambda;
use crate::measure::{Figure, Kind};

/// Goals of the whole, in ms: wasm, and Python before what the lambda itself imports.
const GOALS_MS: [(Kind, f64); 2] = [(Kind::Rust, 10.0), (Kind::Python, 150.0)];

pub(super) fn figures(rounds: usize, figures: &mut Vec<Figure>) {
    let folder = Folder::new();
    // Of its type, only the header: nobody reads more of it.
    let (_, header) = IMAGE.split_once("====").expect("it has a header");
    let schema = format!("std_msgs/Header header\n===={header}");
    let message = (0, Cdr::header().done());
    let drive = one_topic(&folder, "/imu/synthetic", "sensor_msgs/msg/Imu", &schema, &[message]);
    let mut lives = GOALS_MS.map(|(kind, goal)| (kind, goal, [Vec::new(), Vec::new()]));
    // The first one of each compiles.
    for round in 0..=rounds {
        for (kind, _, [bare, below_shim]) in &mut lives {
            for (with_shim, series) in [(false, bare), (true, below_shim)] {
                let out = Folder::new();
                let mut replay = if with_shim { below(&runtime()) } else { runtime() };
                replay
                    .arg("replay")
                    .arg(lambda("imu", *kind))
                    .arg(&drive)
                    .arg("--no-record")
                    .arg("--out")
                    .arg(out.path());
                let ms = life_ms(replay);
                if round > 0 {
                    series.push(ms);
                }
            }
        }
    }
    for (kind, goal, [bare, below_shim]) in &lives {
        let name = format!("process start to end with one message, from cache, {kind}");
        figures.push(Figure::at_most(&name, "ms", *goal, bare));
        figures.push(Figure::told(&format!("{name}, below gleaner-shim"), "ms", below_shim));
    }
    let python = std::env::var_os("GLEANER_PYTHON")
        .unwrap_or_else(|| root().join(".venv/bin/python3").into());
    let empty = (0..rounds).map(|_| {
        let mut python = Command::new(&python);
        python.args(["-I", "-c", "pass"]);
        life_ms(python)
    });
    figures.push(Figure::told(
        "the same of an interpreter alone that does nothing",
        "ms",
        &empty.collect::<Vec<_>>(),
    ));
}

/// `runtime`, which has no arguments yet, below its parent.
fn below(runtime: &Command) -> Command {
    let mut shim = Command::new(program("gleaner-shim"));
    shim.arg("--").arg(runtime.get_program());
    shim.envs(runtime.get_envs().filter_map(|(name, value)| Some((name, value?))));
    shim
}

/// From its start to its end, in ms.
///
/// # Panics
///
/// If it does not end well.
fn life_ms(mut command: Command) -> f64 {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    let started = Instant::now();
    let output = command.output().expect("a program of ours starts");
    let ms = started.elapsed().as_secs_f64() * 1e3;
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    ms
}
