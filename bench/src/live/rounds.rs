//! Measures the round trip from a sample to its answer: an empty lambda of each kind and a bare
//! reader, in one run.

use std::time::Duration;

use gleaner_dds::{Dds, DdsOptions};

use super::bare::BareReader;
use super::{lambda, play_and_stop, start};
use crate::answers::RttReceiver;
use crate::measure::{Figure, Twin, quantile};

/// Goal for the round trip of a lambda, relative to the bare reader.
const RATIO: f64 = 1.5;

pub(super) fn figures(seconds: u32, figures: &mut Vec<Figure>) {
    let mut dds = Dds::open(DdsOptions::new("/gleaner_bench/answers"))
        .expect("a private network can be joined");
    let kinds = [Twin::Rust, Twin::Python]
        .map(|kind| (kind, RttReceiver::on(&mut dds, &format!("/rtt/{kind}"))));
    let bare = BareReader::start("/imu/synthetic", "/rtt/bare");
    let started = kinds.iter().map(|(kind, _)| {
        start(&lambda("imu", *kind), &["--no-record", "--rtt", &format!("/rtt/{kind}")])
    });
    let started = started.collect();
    let duration = seconds.to_string();
    let player =
        vec!["--imu", "100", "--stamp", "monotonic", "--wait", "3", "--duration", &duration];
    let ended = play_and_stop(started, &[player], &mut Vec::new());
    // The last answers may still be in transit.
    std::thread::sleep(Duration::from_millis(200));
    let base = bare.stop();
    round_trip("bare reader", &base, figures);
    let base = quantile(&base, 0.5);
    for (((kind, answers), live), goals) in
        kinds.iter().zip(&ended).zip([[20.0, 100.0], [30.0, 150.0]])
    {
        let ns = answers.take().iter().map(|answer| answer.ns).collect::<Vec<_>>();
        round_trip(&format!("empty lambda, {kind}"), &ns, figures);
        figures.push(Figure::at_most(
            &format!("IMU round trip at 100 Hz, empty lambda, {kind}, against the bare reader"),
            "times",
            RATIO,
            &[quantile(&ns, 0.5) / base],
        ));
        let spreads =
            [("wake latency", live.wake_latency), ("decision latency", live.decision_latency)];
        for (what, spread) in spreads.iter().filter_map(|(what, spread)| Some((what, (*spread)?))) {
            let us = |ns: u64| ns as f64 / 1e3;
            figures.push(Figure::at_most(
                &format!("{what}, {kind}, p50"),
                "us",
                goals[0],
                &[us(spread.p50_ns)],
            ));
            figures.push(Figure::at_most(
                &format!("{what}, {kind}, p99"),
                "us",
                goals[1],
                &[us(spread.p99_ns)],
            ));
        }
    }
}

fn round_trip(name: &str, ns: &[f64], figures: &mut Vec<Figure>) {
    for (what, share) in [("p50", 0.5), ("p99", 0.99)] {
        let name = format!("IMU round trip at 100 Hz, {name}: {what}");
        figures.push(Figure::without_goal(&name, "us", &[quantile(ns, share) / 1e3]));
    }
}
