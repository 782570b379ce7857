//! An empty lambda that answers each sample, and says how late that was.

use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_dds::Dds;
use gleaner_tests::Folder;
use gleaner_tests::live::{PATIENCE, Started, run};
use gleaner_transport::Clock;

use super::RATE_HZ;
use super::attacker::Attack;
use super::blocks::{Course, compare};
use crate::answers::Answers;
use crate::live::lambda;
use crate::measure::{Figure, Kind, quantile};

/// A status tells of about so much time before it, and comes no later than that after its end.
const STATUS_NS: i64 = 1_050_000_000;

pub(super) struct Victim {
    kind: Kind,
    topic: String,
    /// Of this attack.
    answers: Option<Arc<Answers>>,
    started: Started,
    out: Folder,
    /// When each status came, and the 99 % of what it took from a sample received to the lambda
    /// entered, in us.
    entered: Vec<(i64, f64)>,
}

impl Victim {
    pub(super) fn start(kind: Kind) -> Self {
        let (topic, out) = (format!("/rtt/{kind}"), Folder::new());
        let started = run(&lambda("imu", kind), out.path(), &["--no-record", "--rtt", &topic]);
        started.until_ready();
        Self { kind, topic, answers: None, started, out, entered: Vec::new() }
    }

    /// From now on its answers are heard by `dds`.
    pub(super) fn hear(&mut self, dds: &mut Dds) {
        let answers = self.answers.insert(Answers::on(dds, &self.topic));
        let deadline = Instant::now() + PATIENCE;
        while answers.take().is_empty() {
            assert!(Instant::now() < deadline, "{}: no answer is heard", self.kind);
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    pub(super) fn until_fed(&self) {
        self.started.until_live("the first samples", |live| live.wakes > 0);
    }

    /// Hears its statuses until the end of `course`.
    pub(super) fn listen(&mut self, course: &Course, clock: Clock) {
        while clock.now() < course.end_ns() {
            let live = self.started.until_live("a status", |_| true);
            let entered = live.wake_latency.map_or(f64::NAN, |spread| spread.p99_ns as f64 / 1e3);
            self.entered.push((clock.now(), entered));
        }
    }

    /// What the attack did to it. To be asked once for each attack.
    pub(super) fn figures(
        &mut self,
        attack: &Attack,
        course: &Course,
        clock: Clock,
        figures: &mut Vec<Figure>,
    ) {
        let answers = self.answers.take().map(|answers| answers.take()).unwrap_or_default();
        // A late answer counts where its sample came.
        let in_us = answers.iter().map(|answer| {
            let sample_ns = answer.at_ns - answer.ns as i64 + clock.offset_ns();
            (course.block(sample_ns, sample_ns), answer.ns / 1e3)
        });
        let blocks = course.sorted_in(in_us);
        let answered: usize = blocks.iter().map(Vec::len).sum();
        let p99 = blocks.iter().map(|block| quantile(block, 0.99)).collect::<Vec<_>>();
        let of = format!("{attack}, on {}", self.kind);
        figures.push(Figure::at_least(
            &format!("{of}: samples answered, of those that were due"),
            "%",
            99.0,
            &[100.0 * answered as f64 / (RATE_HZ * course.measured_s())],
        ));
        compare(&format!("{of}: round trip, 99 %"), attack.is_by_a_lambda(), &p99, figures);
        let entered =
            self.entered.drain(..).map(|(at_ns, us)| (course.block(at_ns - STATUS_NS, at_ns), us));
        let entered = course.sorted_in(entered);
        let entered = entered.iter().map(|block| quantile(block, 0.5)).collect::<Vec<_>>();
        compare(
            &format!("{of}: received to entered, 99 %"),
            attack.is_by_a_lambda(),
            &entered,
            figures,
        );
    }

    /// Ends it, and tells what it lost all the while.
    pub(super) fn end(self, figures: &mut Vec<Figure>) {
        self.started.signal("INT");
        let live = self.started.finish().ended();
        let lost = live
            .topics
            .iter()
            .map(|topic| topic.lost.unwrap_or(u64::MAX).saturating_add(topic.skipped));
        let name =
            format!("empty lambda, {}: samples lost or passed over in all that time", self.kind);
        figures.push(Figure::at_most(&name, "samples", 0.0, &[lost.sum::<u64>() as f64]));
        drop(self.out);
    }
}
