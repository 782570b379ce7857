//! The way from a sample to its answer: an empty lambda of each kind, and a reader that does
//! nothing but that, in one run.

use std::time::Duration;

use gleaner_dds::{Dds, Options};

use super::bare::Bare;
use super::{lambda, start, to_the_end};
use crate::answers::Answers;
use crate::measure::{Figure, Kind, quantile};

/// Goal: how many times as long as the bare reader a lambda may take.
const RATIO: f64 = 1.5;

pub(super) fn figures(seconds: u32, figures: &mut Vec<Figure>) {
    let mut dds =
        Dds::open(Options::new("/gleaner_bench/answers")).expect("a private network can be joined");
    let kinds = [Kind::Rust, Kind::Python]
        .map(|kind| (kind, Answers::on(&mut dds, &format!("/rtt/{kind}"))));
    let bare = Bare::start("/imu/synthetic", "/rtt/bare");
    let started = kinds.iter().map(|(kind, _)| {
        start(&lambda("imu", *kind), &["--no-record", "--rtt", &format!("/rtt/{kind}")])
    });
    let started = started.collect();
    let duration = seconds.to_string();
    let player =
        vec!["--imu", "100", "--stamp", "monotonic", "--wait", "3", "--duration", &duration];
    let ended = to_the_end(started, &[player], &mut Vec::new());
    // The last answers may be on their way.
    std::thread::sleep(Duration::from_millis(200));
    let base = bare.stop();
    told("bare reader", &base, figures);
    let base = quantile(&base, 0.5);
    for (((kind, answers), live), goals) in
        kinds.iter().zip(&ended).zip([[20.0, 100.0], [30.0, 150.0]])
    {
        let ns = answers.take().iter().map(|answer| answer.ns).collect::<Vec<_>>();
        told(&format!("empty lambda, {kind}"), &ns, figures);
        figures.push(Figure::at_most(
            &format!("IMU round trip at 100 Hz, empty lambda, {kind}, against the bare reader"),
            "times",
            RATIO,
            &[quantile(&ns, 0.5) / base],
        ));
        let spreads = [
            ("sample received to lambda entered", live.wake_latency),
            ("lambda left to decision out", live.decision_latency),
        ];
        for (what, spread) in spreads.iter().filter_map(|(what, spread)| Some((what, (*spread)?))) {
            let us = |ns: u64| ns as f64 / 1e3;
            figures.push(Figure::at_most(
                &format!("{what}, {kind}, median"),
                "us",
                goals[0],
                &[us(spread.p50_ns)],
            ));
            figures.push(Figure::at_most(
                &format!("{what}, {kind}, 99 %"),
                "us",
                goals[1],
                &[us(spread.p99_ns)],
            ));
        }
    }
}

fn told(who: &str, ns: &[f64], figures: &mut Vec<Figure>) {
    for (what, share) in [("median", 0.5), ("99 %", 0.99)] {
        let name = format!("IMU round trip at 100 Hz, {who}: {what}");
        figures.push(Figure::told(&name, "us", &[quantile(ns, share) / 1e3]));
    }
}
