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

use gleaner_bench_results::{BenchResults, Figure, Growth, GrowthCurve};
use gleaner_tests::live::{no_player, signal};
use gleaner_tests::{namespace, root};
use signal_hook::consts::{SIGINT, SIGTERM};

use crate::measure::Twin;
pub use busy_cores::BusyCores;
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
pub fn loads(quick: bool, results: &mut BenchResults) {
    let seconds = |long: u32| if quick { 2 } else { long };
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
        Load { name, lambdas, kind: Twin::Rust, players, seconds }.measure(&mut results.figures);
    }
    let seconds = seconds(16);
    let cameras = |rate: u32| Scale {
        name: format!("1080p at {rate} Hz"),
        of: "lambdas",
        places: if quick { &[1, 4] } else { &[1, 4, 8, 16] },
        load: Box::new(move |count| (("camera", count as usize), raw_camera("1920x1080", rate))),
        seconds,
    };
    let rates = if quick { &[30][..] } else { &[10, 30] };
    let mut scales: Vec<Scale> = rates.iter().map(|rate| cameras(*rate)).collect();
    let imu = |rate: u32| vec!["--imu".to_owned(), rate.to_string()];
    scales.push(Scale {
        name: "IMU at 1 kHz".to_owned(),
        of: "lambdas",
        places: if quick { &[4] } else { &[1, 10, 25, 50] },
        load: Box::new(move |count| (("imu", count as usize), imu(1000))),
        seconds,
    });
    if !quick {
        scales.push(Scale {
            name: "one lambda on an IMU".to_owned(),
            of: "samples per second",
            places: &[100, 500, 1000, 2000, 5000],
            load: Box::new(move |rate| (("imu", 1), imu(rate))),
            seconds,
        });
        scales.push(Scale {
            name: "one lambda on a camera at 10 Hz".to_owned(),
            of: "rows of an image of 16:9",
            places: &[720, 1080, 1440, 2160],
            load: Box::new(|rows| {
                (("camera", 1), raw_camera(&format!("{}x{rows}", rows * 16 / 9), 10))
            }),
            seconds,
        });
    }
    scales.iter().for_each(|scale| scale.measure(results));
}

/// Arguments of a player of raw images.
fn raw_camera(size: &str, rate: u32) -> Vec<String> {
    vec!["--synthetic".to_owned(), format!("{size}@{rate}")]
}

/// Loads that differ in one number.
struct Scale {
    name: String,
    /// The number, in plural.
    of: &'static str,
    places: &'static [u32],
    /// Returns the lambda and its count, and the arguments of the player.
    load: Box<dyn Fn(u32) -> ((&'static str, usize), Vec<String>)>,
    seconds: u32,
}

impl Scale {
    /// Measures each place with lambdas of both kinds.
    fn measure(&self, results: &mut BenchResults) {
        let (mut cpu, mut wakes) = (Vec::new(), Vec::new());
        for kind in [Twin::Rust, Twin::Python] {
            let (mut all, mut ingress, mut wake) = (Vec::new(), Vec::new(), Vec::new());
            for place in self.places {
                let (lambda, player) = (self.load)(*place);
                let player: Vec<&str> = player.iter().map(String::as_str).collect();
                let name = format!("{}, {place} {} in {kind}", self.name, self.of);
                let (lambdas, players) = (&[lambda][..], &[&player[..]][..]);
                let load =
                    Load { name: name.clone(), lambdas, kind, players, seconds: self.seconds };
                let costs = load.measure(&mut results.figures);
                let at = f64::from(*place);
                all.push([at, costs.all_percent]);
                wake.push([at, costs.wake_us]);
                ingress.push([at, costs.ingress_percent]);
                // One reception serves all lambdas.
                if lambda.1 > 1 && ingress[0][0] == 1.0 {
                    let ratio = costs.ingress_percent / ingress[0][1];
                    let name = format!("{name}: ingress, against that of one");
                    results.figures.push(Figure::at_most(&name, "times", 1.1, &[ratio]));
                }
            }
            let curve = |name: String, points| GrowthCurve { name, points };
            cpu.push(curve(format!("all, {kind}"), all));
            cpu.push(curve(format!("ingress, {kind}"), ingress));
            wakes.push(curve(kind.to_string(), wake));
        }
        let growth = |what: &str, unit: &str, curves| Growth {
            name: format!("{}: {what}", self.name),
            of: self.of.to_owned(),
            unit: unit.to_owned(),
            curves,
        };
        results.growths.push(growth("CPU time", "% of a core", cpu));
        results.growths.push(growth("wake latency, p50", "us", wakes));
    }
}

pub(crate) fn lambda(name: &str, kind: Twin) -> PathBuf {
    root().join("bench/lambdas").join(name).join(kind.folder())
}
