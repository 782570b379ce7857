//! Schedules a lambda: `gleaner_rules::schedule` over the rings of its inputs.

use std::sync::Arc;

use gleaner_lambda::manifest::{Backlog as BacklogSpec, Manifest, ScheduleSpec};
use gleaner_rules::schedule::{self as rules, Backlog};

use crate::api::data::{Sample, Topic, Wake};

pub struct WakeSchedule(rules::Schedule<EventInput>);

/// The input whose samples wake the lambda.
struct EventInput(Arc<Topic>);

impl rules::RingView for EventInput {
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

impl WakeSchedule {
    /// The schedule that `manifest` declares, over its inputs in the manifest's order.
    pub fn new(manifest: &Manifest, inputs: &[Arc<Topic>]) -> Self {
        Self(match &manifest.schedule {
            ScheduleSpec::Event { input, backlog } => {
                let topic = inputs.iter().find(|topic| topic.name() == input.as_str());
                let backlog = match backlog {
                    BacklogSpec::Each => Backlog::Each,
                    BacklogSpec::Latest => Backlog::Latest,
                };
                rules::Schedule::event(
                    EventInput(Arc::clone(topic.expect("the manifest was checked"))),
                    backlog,
                )
            }
            ScheduleSpec::Periodic { period } => {
                rules::Schedule::periodic(i64::try_from(period.as_nanos()).unwrap_or(i64::MAX))
            }
        })
    }

    /// The same for a live run that starts at `now_ns`: the first tick is due a period later.
    pub fn live(manifest: &Manifest, inputs: &[Arc<Topic>], now_ns: i64) -> Self {
        let mut schedule = Self::new(manifest, inputs);
        schedule.0.begin_live(now_ns);
        schedule
    }

    /// Sets the start time of a replay: the first tick is due a period later.
    pub fn begin(&mut self, at_ns: i64) {
        self.0.begin(at_ns);
    }

    /// Due time of the next tick; `None` for a schedule by events.
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

    /// Ends the schedule: samples that have arrived and caused no wake count as skipped.
    pub fn finish(&mut self) {
        self.0.finish();
    }

    /// Number of ticks that were due and did not happen.
    pub fn missed(&self) -> u64 {
        self.0.missed()
    }
}
