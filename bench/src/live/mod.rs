//! Measures live topics: losses and costs, in a private network with `gleaner-player`
//! (Cyclone DDS) as publisher.

mod busy_cores;
mod load;

use std::io;
use std::path::PathBuf;
use std::process::{Command, ExitStatus};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use gleaner_tests::live::{no_player, signal};
use gleaner_tests::{namespace, root};
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::measure::Twin;
pub use busy_cores::BusyCores;
use gleaner_bench_results::Figure;
use load::Load;

/// Environment variable of the process in the private network: the process that started it.
const ALONE: &str = "GLEANER_BENCH_ALONE";

/// The system's limit of socket buffers. It applies to all network namespaces, and can be changed
/// in the first one only.
pub(crate) const BUFFER_LIMIT: &str = "/proc/sys/net/core/rmem_max";
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

/// Returns the id of the process that started this one in its private network.
pub(crate) fn starter() -> Option<String> {
    std::env::var(ALONE).ok()
}

fn start_in_private_network() -> Result<bool, String> {
    if let Some(why) = namespace::unavailable().or(no_player()) {
        return Err(why.to_owned());
    }
    let before = std::fs::read_to_string(BUFFER_LIMIT).unwrap_or_default();
    let is_small = before.trim().parse::<u64>().is_ok_and(|bytes| bytes < BUFFER_BYTES);
    let raised = is_small && std::fs::write(BUFFER_LIMIT, BUFFER_BYTES.to_string()).is_ok();
    let status = until_end(
        namespace::rerun(ALONE, &std::process::id().to_string()).args(std::env::args_os().skip(1)),
    );
    // Restored for the other users of this machine, whatever the benchmark has set.
    if raised || std::fs::read_to_string(BUFFER_LIMIT).is_ok_and(|after| after != before) {
        let _ = std::fs::write(BUFFER_LIMIT, before.trim());
    }
    status.map(|status| status.success()).map_err(|error| error.to_string())
}

/// Runs a command to its end. A signal that asks this program to end is passed on, so that the end
/// is waited for, and the limit restored.
fn until_end(command: &mut Command) -> io::Result<ExitStatus> {
    let is_asked = Arc::<AtomicBool>::default();
    for asks in [SIGINT, SIGTERM] {
        signal_hook::flag::register(asks, Arc::clone(&is_asked))?;
    }
    let mut child = command.spawn()?;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        if is_asked.swap(false, Ordering::Relaxed) {
            signal(child.id(), "TERM");
        }
        thread::sleep(Duration::from_millis(100));
    }
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

pub(crate) fn lambda(name: &str, kind: Twin) -> PathBuf {
    root().join("bench/lambdas").join(name).join(kind.folder())
}
