//! Loads of one and several lambdas, and how their costs grow with a number.

use gleaner_bench_results::{BenchResults, Figure, Growth, GrowthCurve};

use super::load::Load;
use crate::measure::Twin;

/// Remap of the second camera of `bench/lambdas/rig`.
const REAR: &str = "/camera/synthetic/image_raw:=/camera/rear/image_raw";

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
        load: Box::new(move |count| ScaleLoad {
            lambda: "camera",
            count: count as usize,
            player: raw_camera("1920x1080", rate),
        }),
        seconds,
    };
    let rates = if quick { &[30][..] } else { &[10, 30] };
    let mut scales: Vec<Scale> = rates.iter().map(|rate| cameras(*rate)).collect();
    let imu = |rate: u32| vec!["--imu".to_owned(), rate.to_string()];
    scales.push(Scale {
        name: "IMU at 1 kHz".to_owned(),
        of: "lambdas",
        places: if quick { &[4] } else { &[1, 10, 25, 50] },
        load: Box::new(move |count| ScaleLoad {
            lambda: "imu",
            count: count as usize,
            player: imu(1000),
        }),
        seconds,
    });
    if !quick {
        scales.push(Scale {
            name: "one lambda on an IMU".to_owned(),
            of: "samples per second",
            places: &[100, 500, 1000, 2000, 5000],
            load: Box::new(move |rate| ScaleLoad { lambda: "imu", count: 1, player: imu(rate) }),
            seconds,
        });
        scales.push(Scale {
            name: "one lambda on a camera at 10 Hz".to_owned(),
            of: "rows of an image of 16:9",
            places: &[720, 1080, 1440, 2160],
            load: Box::new(|rows| ScaleLoad {
                lambda: "camera",
                count: 1,
                player: raw_camera(&format!("{}x{rows}", rows * 16 / 9), 10),
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
    load: Box<dyn Fn(u32) -> ScaleLoad>,
    seconds: u32,
}

/// The load at one number.
struct ScaleLoad {
    /// A lambda of `bench/lambdas`, and how many of it run.
    lambda: &'static str,
    count: usize,
    /// Arguments of the player.
    player: Vec<String>,
}

impl Scale {
    /// Measures each place with lambdas of both kinds.
    fn measure(&self, results: &mut BenchResults) {
        let (mut cpu, mut wakes) = (Vec::new(), Vec::new());
        for kind in [Twin::Rust, Twin::Python] {
            let (mut all, mut ingress, mut wake) = (Vec::new(), Vec::new(), Vec::new());
            for place in self.places {
                let ScaleLoad { lambda, count, player } = (self.load)(*place);
                let player: Vec<&str> = player.iter().map(String::as_str).collect();
                let name = format!("{}, {place} {} in {kind}", self.name, self.of);
                let (lambdas, players) = (&[(lambda, count)][..], &[&player[..]][..]);
                let load =
                    Load { name: name.clone(), lambdas, kind, players, seconds: self.seconds };
                let costs = load.measure(&mut results.figures);
                let at = f64::from(*place);
                all.push([at, costs.all_percent]);
                wake.push([at, costs.wake_us]);
                ingress.push([at, costs.ingress_percent]);
                // One reception serves all lambdas.
                if count > 1 && ingress[0][0] == 1.0 {
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
