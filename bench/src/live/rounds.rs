//! Measures the round trip from a sample to its answer: a bare reader and a lambda of each kind, in
//! turns.

use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::Duration;

use gleaner_dds::{Dds, DdsOptions};
use gleaner_protocol::LiveStatus;
use gleaner_tests::LambdaCopy;
use gleaner_tests::live::play;

use super::bare::BareReader;
use super::{lambda, play_and_stop, start};
use crate::answers::RttReceiver;
use crate::measure::{Twin, cores};
use gleaner_bench_results::{Figure, quantile};

/// Goals for the round trip of a lambda, relative to the bare reader: median and 99th percentile.
const RATIO: f64 = 1.5;
const TAIL_RATIO: f64 = 2.0;

/// Length of a turn, in s.
const TURN_S: u32 = 20;

/// Topic of the answers.
const ANSWERS: &str = "/rtt/lambda";

pub(super) fn figures(seconds: u32, figures: &mut Vec<Figure>) {
    let lambdas = [Twin::Rust, Twin::Python].map(|kind| lambda("imu", kind));
    let sides = Sides {
        name: "IMU round trip at 100 Hz, empty lambda".to_owned(),
        input: "/imu/synthetic",
        type_name: "sensor_msgs::msg::dds_::Imu_",
        lambdas: lambdas.each_ref().map(PathBuf::as_path),
        event: &["--imu", "100"],
        others: &[],
    };
    sides.compare(seconds, figures);
    // A core that sleeps takes some 50 us to run a woken thread. A lambda is one thread further
    // from the network than a bare reader.
    match BusyCores::start() {
        Ok(_busy) => {
            let name = format!("{}, cores awake", sides.name);
            Sides { name, ..sides }.compare(seconds, figures);
        }
        Err(error) => eprintln!("cannot keep the cores awake: {error}"),
    }
    for (size, name) in [("1280x720@10", "720p"), ("1920x1080@10", "1080p")] {
        brake_dark(size, name, seconds, figures);
    }
}

/// Measures `examples/brake-dark` on a camera of raw images, where each wake computes the luma.
fn brake_dark(size: &str, name: &str, seconds: u32, figures: &mut Vec<Figure>) {
    let lambdas = [Twin::Rust, Twin::Python].map(|kind| {
        let of_raw_images = |manifest: String| {
            manifest
                .replace("/camera/front/compressed", "/camera/synthetic/image_raw")
                .replace("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
                .replace("/imu/data", "/imu/synthetic")
                .replace("max_size = \"2 MiB\"", "max_size = \"8 MiB\"")
                // At rest, too, the image is looked at.
                .replace("default = -3.0", "default = 100.0")
        };
        LambdaCopy::of(&format!("examples/brake-dark/{}", kind.folder()), of_raw_images)
    });
    let sides = Sides {
        name: format!("{name} round trip at 10 Hz, Brake+Dark"),
        input: "/camera/synthetic/image_raw",
        type_name: "sensor_msgs::msg::dds_::Image_",
        lambdas: lambdas.each_ref().map(LambdaCopy::path),
        event: &["--synthetic", size],
        others: &["--imu", "100"],
    };
    sides.compare(seconds, figures);
}

/// A bare reader and two lambdas that take turns.
struct Sides<'a> {
    name: String,
    /// The topic whose samples are answered, and its DDS type.
    input: &'a str,
    type_name: &'a str,
    /// The lambda in Rust and in Python.
    lambdas: [&'a Path; 2],
    /// Arguments of the player for the topic, and for the other inputs of the lambdas.
    event: &'a [&'a str],
    others: &'a [&'a str],
}

impl Sides<'_> {
    /// Lets the sides take turns of `seconds` in all.
    fn compare(&self, seconds: u32, figures: &mut Vec<Figure>) {
        let mut dds = Dds::open(DdsOptions::new("/gleaner_bench/answers"))
            .expect("a private network can be joined");
        let answers = RttReceiver::on(&mut dds, ANSWERS);
        let rounds = seconds.div_ceil(TURN_S);
        let duration = (seconds / rounds).to_string();
        let player = ["--stamp", "monotonic", "--wait", "1", "--duration", &duration];
        let kinds = [Twin::Rust, Twin::Python];
        let (mut base, mut times) = (Vec::new(), [Vec::new(), Vec::new()]);
        let mut last = [None, None];
        for _ in 0..rounds {
            let bare = BareReader::start(self.input, self.type_name, "/rtt/bare");
            let played = play(&[self.event, &player].concat()).finish();
            assert!(played.status.success(), "{}", played.stderr);
            base.extend(bare.stop());
            for (index, lambda) in self.lambdas.iter().enumerate() {
                let started = start(lambda, &["--no-record", "--rtt", ANSWERS]);
                let played = [self.event, self.others, &player].concat();
                last[index] = Some(play_and_stop(started, &played));
                // The last answers may still be in transit.
                std::thread::sleep(Duration::from_millis(200));
                times[index].extend(answers.take().iter().map(|answer| answer.ns));
            }
        }
        self.round_trip("bare reader", &base, figures);
        for (kind, ns) in kinds.iter().zip(&times) {
            self.round_trip(&kind.to_string(), ns, figures);
            for (what, share, most) in [("p50", 0.5, RATIO), ("p99", 0.99, TAIL_RATIO)] {
                figures.push(Figure::at_most(
                    &format!("{}, {kind}, against the bare reader: {what}", self.name),
                    "times",
                    most,
                    &[quantile(ns, share) / quantile(&base, share)],
                ));
            }
        }
        for (kind, live) in kinds.into_iter().zip(last) {
            self.stages(kind, &live.expect("it has a last status"), figures);
        }
    }

    /// Adds the times of the stages after the reception of a sample.
    fn stages(&self, kind: Twin, live: &LiveStatus, figures: &mut Vec<Figure>) {
        let goals = match kind {
            Twin::Rust => [20.0, 100.0],
            Twin::Python => [30.0, 150.0],
        };
        for (what, stats, has_goal) in [
            ("wake latency", live.wake_latency, true),
            ("run time", live.run_time, false),
            ("decision latency", live.decision_latency, true),
        ] {
            let Some(stats) = stats else { continue };
            for (share, ns, goal) in
                [("p50", stats.p50_ns, goals[0]), ("p99", stats.p99_ns, goals[1])]
            {
                let name = format!("{}, {kind}: {what}, {share}", self.name);
                let us = [ns as f64 / 1e3];
                figures.push(if has_goal {
                    Figure::at_most(&name, "us", goal, &us)
                } else {
                    Figure::without_goal(&name, "us", &us)
                });
            }
        }
    }

    fn round_trip(&self, of: &str, ns: &[f64], figures: &mut Vec<Figure>) {
        for (what, share) in [("p50", 0.5), ("p99", 0.99)] {
            let name = format!("{}, {of}: {what} of {} answers", self.name, ns.len());
            figures.push(Figure::without_goal(&name, "us", &[quantile(ns, share) / 1e3]));
        }
    }
}

/// Processes of the lowest class, one for each core, which keep the cores from sleeping; ended on
/// drop.
struct BusyCores(Vec<Child>);

impl BusyCores {
    fn start() -> io::Result<Self> {
        let start = |_| {
            let mut busy = Command::new("chrt");
            busy.args(["--idle", "0", "sh", "-c", "while :; do :; done"]).spawn()
        };
        cores()?.into_iter().map(start).collect::<io::Result<Vec<Child>>>().map(Self)
    }
}

impl Drop for BusyCores {
    fn drop(&mut self) {
        for busy in &mut self.0 {
            // It has not ended, as nothing else ends it.
            let _ = busy.kill();
            let _ = busy.wait();
        }
    }
}
