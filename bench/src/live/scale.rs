//! Loads of one and several lambdas, and how their costs grow with a number.

use clap::Args;
use gleaner_bench::{BenchResults, Figure, Growth, GrowthCurve};

use super::load::{Load, LoadCosts, more_imu};
use super::packet_loss::PacketLoss;
use crate::measure::Twin;

/// Remap of the second camera of `bench/lambdas/rig`.
const REAR: &str = "/camera/synthetic/image_raw:=/camera/rear/image_raw";

/// Most that the CPU time of a wake grows with the number of topics or lambdas.
const FLAT: f64 = 1.2;

/// Name, lambdas, players and seconds of a load.
type LoadArgs<'a> = (&'a str, &'a [(&'a str, usize)], &'a [&'a [&'a str]], u32);

/// A choice of loads.
#[derive(Args, Clone)]
pub struct ScaleOptions {
    /// Only loads with this text in their names.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
}

impl ScaleOptions {
    fn is_wanted(&self, name: &str) -> bool {
        self.only.as_deref().is_none_or(|only| name.contains(only))
    }
}

/// Samples that one and several lambdas receive, and their costs.
pub fn loads(quick: bool, options: &ScaleOptions, results: &mut BenchResults) {
    measure_single(quick, options, &mut results.figures);
    let mut scales = scales(quick);
    if !quick {
        if let Err(why) = PacketLoss::of(1) {
            results.notes.push(format!("Loss of packets is skipped: {why}."));
        } else {
            scales.extend(loss_scales());
        }
    }
    let seconds = if quick { 2 } else { 16 };
    let wanted = scales.iter().filter(|scale| options.is_wanted(&scale.name));
    wanted.for_each(|scale| scale.measure(seconds, results));
    if results.figures.is_empty() {
        let only = options.only.as_deref().unwrap_or_default();
        results.notes.push(format!("All loads are skipped: none has \"{only}\" in its name."));
    }
}

/// Measures usual loads of cameras and IMUs.
fn measure_single(quick: bool, options: &ScaleOptions, figures: &mut Vec<Figure>) {
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
    let wanted = single.into_iter().filter(|load| options.is_wanted(load.0));
    for (name, lambdas, players, long) in wanted {
        let seconds = if quick { 2 } else { long };
        let name = name.to_owned();
        let (more_topics, kind, is_lossy) = (0, Twin::Rust, false);
        let load = Load { name, lambdas, more_topics, kind, players, seconds, is_lossy };
        load.measure(figures);
    }
}

/// Returns loads of growing numbers: of lambdas, topics, samples and rows of an image.
fn scales(quick: bool) -> Vec<Scale> {
    let cameras = |rate: u32| Scale {
        name: format!("1080p at {rate} Hz"),
        of: "lambdas",
        places: if quick { &[1, 4] } else { &[1, 4, 8, 16] },
        is_flat: true,
        load: Box::new(move |count| ScaleLoad::of("camera", count, vec![full_hd(rate)])),
    };
    let rates = if quick { &[30][..] } else { &[10, 30] };
    let mut scales: Vec<Scale> = rates.iter().map(|rate| cameras(*rate)).collect();
    scales.push(Scale {
        name: "IMU at 1 kHz".to_owned(),
        of: "lambdas",
        places: if quick { &[4] } else { &[1, 10, 25, 50] },
        is_flat: true,
        load: Box::new(|count| ScaleLoad::of("imu", count, vec![imu(1000)])),
    });
    scales.push(Scale {
        name: "one lambda on IMUs at 100 Hz, woken by the first".to_owned(),
        of: "topics",
        places: if quick { &[2] } else { &[1, 2, 4, 8, 16] },
        is_flat: true,
        load: Box::new(|topics| {
            let remap = |number| {
                vec!["--remap".to_owned(), format!("/imu/synthetic:={}", more_imu(number))]
            };
            let more = (1..topics).map(|number| [imu(100), remap(number)].concat());
            let players = std::iter::once(imu(100)).chain(more).collect();
            ScaleLoad { more_topics: topics - 1, ..ScaleLoad::of("imu", 1, players) }
        }),
    });
    if !quick {
        scales.push(Scale {
            name: "one lambda on an IMU".to_owned(),
            of: "samples per second",
            places: &[100, 500, 1000, 2000, 5000],
            is_flat: false,
            load: Box::new(|rate| ScaleLoad::of("imu", 1, vec![imu(rate)])),
        });
        scales.push(Scale {
            name: "one lambda on a camera at 10 Hz".to_owned(),
            of: "rows of an image of 16:9",
            places: &[720, 1080, 1440, 2160],
            is_flat: false,
            load: Box::new(|rows| {
                let player = raw_camera(&format!("{}x{rows}", rows * 16 / 9), 10);
                ScaleLoad::of("camera", 1, vec![player])
            }),
        });
    }
    scales
}

/// Returns loads of which a growing number of packets is lost.
fn loss_scales() -> [Scale; 2] {
    let of_loss = |name: &str, lambda: &'static str, player: Vec<String>| Scale {
        name: name.to_owned(),
        of: "dropped packets in 1,000",
        places: &[0, 1, 10, 50],
        is_flat: false,
        load: Box::new(move |dropped| ScaleLoad {
            dropped,
            ..ScaleLoad::of(lambda, 1, vec![player.clone()])
        }),
    };
    [
        of_loss("one lambda on an IMU at 1 kHz, with lost packets", "imu", imu(1000)),
        of_loss("one lambda on 1080p at 10 Hz, with lost packets", "camera", full_hd(10)),
    ]
}

/// Arguments of a player of IMU samples.
fn imu(rate: u32) -> Vec<String> {
    vec!["--imu".to_owned(), rate.to_string()]
}

fn full_hd(rate: u32) -> Vec<String> {
    raw_camera("1920x1080", rate)
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
    /// True if the CPU time of a wake should not depend on the number.
    is_flat: bool,
    load: Box<dyn Fn(u32) -> ScaleLoad>,
}

/// The load at one number.
struct ScaleLoad {
    /// A lambda of `bench/lambdas`, and how many of it run.
    lambda: &'static str,
    count: u32,
    more_topics: u32,
    /// Arguments of each player.
    players: Vec<Vec<String>>,
    /// Packets of 1,000 that are dropped.
    dropped: u32,
}

impl ScaleLoad {
    fn of(lambda: &'static str, count: u32, players: Vec<Vec<String>>) -> Self {
        Self { lambda, count, more_topics: 0, players, dropped: 0 }
    }

    fn measure(
        &self,
        name: &str,
        kind: Twin,
        seconds: u32,
        figures: &mut Vec<Figure>,
    ) -> LoadCosts {
        let _loss = PacketLoss::of(self.dropped).expect("packets could be dropped before");
        let players: Vec<Vec<&str>> =
            self.players.iter().map(|player| player.iter().map(String::as_str).collect()).collect();
        let players: Vec<&[&str]> = players.iter().map(Vec::as_slice).collect();
        let load = Load {
            name: name.to_owned(),
            lambdas: &[(self.lambda, self.count as usize)],
            more_topics: self.more_topics,
            kind,
            players: &players,
            seconds,
            is_lossy: self.dropped > 0,
        };
        load.measure(figures)
    }
}

/// A quantity that a scale measures: name, unit and value.
type Measured = (&'static str, &'static str, fn(&LoadCosts) -> f64);

const MEASURED: [Measured; 5] = [
    ("CPU time of all", "% of a core", |costs| costs.all_percent),
    ("CPU time of the ingress", "% of a core", |costs| costs.ingress_percent),
    ("CPU time of a lambda's process for a wake", "us", |costs| costs.wake_cpu_us),
    ("wake latency, p50", "us", |costs| costs.wake_us),
    ("samples not received", "%", |costs| costs.missing_percent),
];

impl Scale {
    /// Measures each place with lambdas of both kinds.
    fn measure(&self, seconds: u32, results: &mut BenchResults) {
        let mut curves: [Vec<GrowthCurve>; MEASURED.len()] = Default::default();
        for kind in [Twin::Rust, Twin::Python] {
            let measured: Vec<(u32, LoadCosts)> = self
                .places
                .iter()
                .map(|place| {
                    let name = format!("{}, {place} {} in {kind}", self.name, self.of);
                    let load = (self.load)(*place);
                    let costs = load.measure(&name, kind, seconds, &mut results.figures);
                    (*place, costs)
                })
                .collect();
            let (first, others) = measured.split_first().expect("a scale has places");
            for (place, costs) in others.iter().filter(|_| self.is_flat && first.0 == 1) {
                let name = format!("{}, {place} {} in {kind}", self.name, self.of);
                let mut against = |what: &str, most: f64, of: fn(&LoadCosts) -> f64| {
                    let name = format!("{name}: {what}, against that of one");
                    let ratio = of(costs) / of(&first.1);
                    results.figures.push(Figure::at_most(&name, "times", most, &[ratio]));
                };
                against("CPU time of a wake", FLAT, |costs| costs.wake_cpu_us);
                // One reception serves all lambdas.
                if self.of == "lambdas" {
                    against("ingress", 1.1, |costs| costs.ingress_percent);
                }
            }
            for (curves, (.., of)) in curves.iter_mut().zip(MEASURED) {
                let points =
                    measured.iter().map(|(place, costs)| [f64::from(*place), of(costs)]).collect();
                curves.push(GrowthCurve { name: kind.to_string(), points });
            }
        }
        for ((what, unit, _), curves) in MEASURED.into_iter().zip(curves) {
            results.growths.push(Growth {
                name: format!("{}: {what}", self.name),
                of: self.of.to_owned(),
                unit: unit.to_owned(),
                curves,
            });
        }
    }
}
