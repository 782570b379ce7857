//! Measures live topics: losses, latencies and costs, in a private network with `gleaner-player`
//! (Cyclone DDS) as publisher.

mod bare;
mod load;
mod rounds;

use std::path::{Path, PathBuf};

use gleaner_protocol::LiveStatus;
use gleaner_tests::live::{RunningProgram, no_player, play, run};
use gleaner_tests::{TempFolder, namespace, root};

use crate::measure::Twin;
use gleaner_bench_results::Figure;
use load::Load;

/// Environment variable of the process in the private network.
const ALONE: &str = "GLEANER_BENCH_ALONE";

/// The system's limit of socket buffers. It applies to all network namespaces, and can be changed
/// in the first one only.
const BUFFER_LIMIT: &str = "/proc/sys/net/core/rmem_max";
const BUFFER_BYTES: u64 = 64 << 20;

/// Remap of the second camera of `bench/lambdas/rig`.
const REAR: &str = "/camera/synthetic/image_raw:=/camera/rear/image_raw";

/// Runs this program again in a private network; `None` in that process.
///
/// Meanwhile the limit of socket buffers is raised, if that is permitted.
pub fn in_private_network() -> Option<Result<bool, String>> {
    if std::env::var_os(ALONE).is_some() {
        return None;
    }
    Some(start_in_private_network())
}

fn start_in_private_network() -> Result<bool, String> {
    if let Some(why) = namespace::unavailable().or(no_player()) {
        return Err(why.to_owned());
    }
    let before = std::fs::read_to_string(BUFFER_LIMIT).unwrap_or_default();
    let is_small = before.trim().parse::<u64>().is_ok_and(|bytes| bytes < BUFFER_BYTES);
    let raised = is_small && std::fs::write(BUFFER_LIMIT, BUFFER_BYTES.to_string()).is_ok();
    let status = namespace::rerun(ALONE, "1").args(std::env::args_os().skip(1)).status();
    if raised {
        // Restored for the other users of this machine.
        let _ = std::fs::write(BUFFER_LIMIT, before.trim());
    }
    status.map(|status| status.success()).map_err(|error| error.to_string())
}

/// Name, lambdas, players and seconds of a load.
type LoadArgs<'a> = (&'a str, &'a [(&'a str, usize)], &'a [&'a [&'a str]], u32);

/// Samples that one and several lambdas receive, and their costs.
pub fn loads(quick: bool) -> Vec<Figure> {
    let seconds = |long: u32| if quick { 2 } else { long };
    let mut figures = Vec::new();
    const FULL_HD: &str = "1920x1080@30";
    let rig: [&[&str]; 2] =
        [&["--synthetic", FULL_HD, "--imu", "1000"], &["--synthetic", FULL_HD, "--remap", REAR]];
    let single: [LoadArgs<'_>; 5] = [
        ("1080p at 30 Hz for a minute", &[("camera", 1)], &[&["--synthetic", FULL_HD]], 60),
        ("3848x2168 at 10 Hz", &[("camera", 1)], &[&["--synthetic", "3848x2168@10"]], 30),
        ("IMU at 1 kHz", &[("imu", 1)], &[&["--imu", "1000"]], 60),
        (
            "1080p at 30 Hz and an IMU at 1 kHz",
            &[("camera", 1), ("imu", 1)],
            &[&["--synthetic", FULL_HD, "--imu", "1000"]],
            60,
        ),
        // One lambda with three inputs. A player has one camera, so the second one needs another
        // player.
        ("two cameras of 1080p at 30 Hz and an IMU at 1 kHz at once", &[("rig", 1)], &rig, 60),
    ];
    for (name, lambdas, players, long) in single {
        let seconds = seconds(long);
        let name = name.to_owned();
        Load { name, lambdas, kind: Twin::Rust, players, seconds }.measure(&mut figures);
    }
    let counts = if quick { &[1, 4][..] } else { &[1, 4, 8, 16] };
    for kind in [Twin::Rust, Twin::Python] {
        for rate in if quick { &[30][..] } else { &[10, 30] } {
            let camera = format!("1920x1080@{rate}");
            let mut one = None;
            for count in counts {
                let name = format!("1080p at {rate} Hz, {count} in {kind}");
                let (lambdas, seconds) = (&[("camera", *count)][..], seconds(16));
                let player = ["--synthetic", &camera];
                let players = &[&player[..]];
                let load = Load { name: name.clone(), lambdas, kind, players, seconds };
                let ingress = load.measure(&mut figures);
                let ratio = ingress / *one.get_or_insert(ingress);
                let name = format!("{name}: ingress, against that of one");
                figures.push(Figure::at_most(&name, "times", 1.1, &[ratio]));
            }
        }
        let (count, seconds) = (if quick { 4 } else { 50 }, seconds(16));
        let name = format!("IMU at 1 kHz, {count} in {kind}");
        let (lambdas, players) = (&[("imu", count)][..], &[&["--imu", "1000"][..]][..]);
        Load { name, lambdas, kind, players, seconds }.measure(&mut figures);
    }
    figures
}

/// The times from a sample to its answer.
pub fn round_trips(quick: bool) -> Vec<Figure> {
    let mut figures = Vec::new();
    rounds::figures(if quick { 3 } else { 60 }, &mut figures);
    figures
}

pub(crate) fn lambda(name: &str, kind: Twin) -> PathBuf {
    root().join("bench/lambdas").join(name).join(kind.folder())
}

fn start(lambda: &Path, args: &[&str]) -> (RunningProgram, TempFolder) {
    let out = TempFolder::new();
    let started = run(lambda, out.path(), args);
    started.until_ready();
    (started, out)
}

/// Plays to the end, then stops the lambda and returns its final status.
fn play_and_stop((started, _out): (RunningProgram, TempFolder), player: &[&str]) -> LiveStatus {
    let playing = play(player);
    let mut has_begun = false;
    started.until_live("the end of the samples", |live| {
        // Begun if something was received, as everything may be lost, or if all writers are there.
        has_begun |= live.topics.iter().all(|topic| topic.writers > Some(0) || topic.received > 0);
        has_begun && live.topics.iter().all(|topic| topic.writers == Some(0))
    });
    let played = playing.finish();
    assert!(played.status.success(), "{}", played.stderr);
    started.signal("INT");
    started.finish().ended()
}
