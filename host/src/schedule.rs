//! When a lambda runs, by `gleaner_rules::schedule` over the rings of its inputs.

use std::sync::Arc;

use gleaner_lambda::manifest::{Backlog as DeclaredBacklog, Manifest, Schedule as Declared};
use gleaner_rules::schedule::{self as rules, Backlog};

use crate::api::data::{Sample, Topic, Wake};

/// The schedule of one lambda.
pub struct Schedule(rules::Schedule<Input>);

/// The input whose samples wake the lambda.
struct Input(Arc<Topic>);

impl rules::Ring for Input {
    type Sample = Sample;

    fn head(&self) -> u64 {
        self.0.reader().head()
    }

    fn depth(&self) -> usize {
        self.0.depth()
    }

    fn get(&self, position: u64) -> Option<Sample> {
        self.0.reader().get(position).map(|lease| self.0.sample(lease))
    }

    fn newest(&self) -> Option<(u64, Sample)> {
        let lease = self.0.reader().newest()?;
        Some((lease.position()?, self.0.sample(lease)))
    }

    fn skip(&self, samples: u64) {
        self.0.add_skipped(samples);
    }
}

impl Schedule {
    /// The schedule that `manifest` declares, over its inputs in the manifest's order.
    pub fn new(manifest: &Manifest, inputs: &[Arc<Topic>]) -> Self {
        Self(match &manifest.schedule {
            Declared::Event { input, backlog } => {
                let topic = inputs.iter().find(|topic| topic.name() == input.as_str());
                let backlog = match backlog {
                    DeclaredBacklog::Each => Backlog::Each,
                    DeclaredBacklog::Latest => Backlog::Latest,
                };
                rules::Schedule::event(
                    Input(Arc::clone(topic.expect("the manifest was checked"))),
                    backlog,
                )
            }
            Declared::Periodic { period } => {
                rules::Schedule::periodic(i64::try_from(period.as_nanos()).unwrap_or(i64::MAX))
            }
        })
    }

    /// The same where time does not wait: it is `now_ns`, and the first tick comes a period later.
    pub fn live(manifest: &Manifest, inputs: &[Arc<Topic>], now_ns: i64) -> Self {
        let mut schedule = Self::new(manifest, inputs);
        schedule.0.begin_live(now_ns);
        schedule
    }

    /// Time begins, in a replay: the first tick comes a period later.
    pub fn begin(&mut self, at_ns: i64) {
        self.0.begin(at_ns);
    }

    /// When the next tick is due, if time causes any.
    pub fn next_due(&self) -> Option<i64> {
        self.0.next_due()
    }

    /// The next wake caused by samples that have arrived.
    pub fn next_event(&mut self) -> Option<Wake> {
        self.0.next_event().map(Wake::Event)
    }

    /// The next wake that is due before `now_ns`; call again until there is none.
    pub fn next_tick(&mut self, now_ns: i64) -> Option<Wake> {
        self.0.next_tick(now_ns).map(Wake::Tick)
    }

    /// At the end: what has arrived and woken nobody was skipped.
    pub fn finish(&mut self) {
        self.0.finish();
    }

    /// Ticks that were due and did not happen.
    pub fn missed(&self) -> u64 {
        self.0.missed()
    }
}
