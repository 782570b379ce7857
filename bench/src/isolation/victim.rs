//! The victim: an empty lambda that answers each sample and reports the delay.

use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_dds::Dds;
use gleaner_messages::transport::Clock;
use gleaner_tests::TempFolder;
use gleaner_tests::live::{PATIENCE, RunningProgram, run};

use super::RATE_HZ;
use super::attacker::Attack;
use super::blocks::{BlockSchedule, compare};
use crate::answers::RttReceiver;
use crate::live::lambda;
use crate::measure::Twin;
use gleaner_bench::{Figure, quantile};

/// Period that a status covers, with the maximum delay until it arrives.
const STATUS_NS: i64 = 1_050_000_000;

pub(super) struct Victim {
    kind: Twin,
    topic: String,
    answers: Option<Arc<RttReceiver>>,
    started: RunningProgram,
    out: TempFolder,
    /// Arrival time of each status, and its p99 of the wake latency in us.
    latencies: Vec<(i64, f64)>,
}

impl Victim {
    pub(super) fn start(kind: Twin) -> Self {
        let (topic, out) = (format!("/rtt/{kind}"), TempFolder::new());
        let started = run(&lambda("imu", kind), out.path(), &["--no-record", "--rtt", &topic]);
        started.until_ready();
        Self { kind, topic, answers: None, started, out, latencies: Vec::new() }
    }

    /// Subscribes to its answers with `dds`, and waits for the first one.
    pub(super) fn subscribe(&mut self, dds: &mut Dds) {
        let answers = self.answers.insert(RttReceiver::on(dds, &self.topic));
        let deadline = Instant::now() + PATIENCE;
        while answers.take().is_empty() {
            assert!(Instant::now() < deadline, "{}: no answer arrives", self.kind);
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    pub(super) fn until_fed(&self) {
        self.started.until_live("the first samples", |live| live.wakes > 0);
    }

    /// Collects its statuses until the end of `schedule`.
    pub(super) fn collect(&mut self, schedule: &BlockSchedule, clock: Clock) {
        while clock.now() < schedule.end_ns() {
            let live = self.started.until_live("a status", |_| true);
            let p99 = live.wake_latency.map_or(f64::NAN, |spread| spread.p99_ns as f64 / 1e3);
            self.latencies.push((clock.now(), p99));
        }
    }

    /// Adds the figures of one attack. Call it once for each attack.
    pub(super) fn figures(
        &mut self,
        attack: &Attack,
        schedule: &BlockSchedule,
        clock: Clock,
        figures: &mut Vec<Figure>,
    ) {
        let answers = self.answers.take().map(|answers| answers.take()).unwrap_or_default();
        // A late answer counts for the block of its sample.
        let in_us = answers.iter().map(|answer| {
            let sample_ns = answer.at_ns - answer.ns as i64 + clock.offset_ns();
            (schedule.block(sample_ns, sample_ns), answer.ns / 1e3)
        });
        let blocks = schedule.grouped(in_us);
        let answered: usize = blocks.iter().map(Vec::len).sum();
        let p99 = blocks.iter().map(|block| quantile(block, 0.99)).collect::<Vec<_>>();
        let of = format!("{attack}, on {}", self.kind);
        figures.push(Figure::at_least(
            &format!("{of}: samples answered"),
            "%",
            99.0,
            &[100.0 * answered as f64 / (RATE_HZ * schedule.measured_s())],
        ));
        compare(&format!("{of}: round trip, p99"), attack.is_by_lambda(), &p99, figures);
        let latencies = self
            .latencies
            .drain(..)
            .map(|(at_ns, us)| (schedule.block(at_ns - STATUS_NS, at_ns), us));
        let latencies = schedule.grouped(latencies);
        let latencies = latencies.iter().map(|block| quantile(block, 0.5)).collect::<Vec<_>>();
        compare(&format!("{of}: wake latency, p99"), attack.is_by_lambda(), &latencies, figures);
    }

    /// Stops it and reports its losses in all attacks.
    pub(super) fn end(self, figures: &mut Vec<Figure>) {
        let live = self.started.interrupt().ended();
        let lost = live
            .topics
            .iter()
            .map(|topic| topic.lost.unwrap_or(u64::MAX).saturating_add(topic.skipped));
        let name = format!("empty lambda, {}: samples lost or skipped in all attacks", self.kind);
        figures.push(Figure::at_most(&name, "samples", 0.0, &[lost.sum::<u64>() as f64]));
        drop(self.out);
    }
}
