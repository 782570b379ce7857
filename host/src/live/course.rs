//! The course of time: wait, wake the lambda, hand out what it decided, and look after everything
//! now and then.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use gleaner_base::{Exit, Failure, nanoseconds};
use gleaner_protocol::Report;
use gleaner_transport::{Clock, LiveSource};
use gleaner_vitals::Pulse;

use super::announce::Announcer;
use super::ledger::Ledger;
use super::recorder::ToRecorder;
use super::round_trip::RoundTrip;
use super::status::{Around, Times, Watch};
use crate::api::Session;
use crate::api::data::{Topic, Wake};
use crate::judge::Judge;
use crate::schedule::Schedule;

/// How long nobody looks at signals, the recorder and the time for a report. A wake does not wait
/// for it.
const ROUND: Duration = Duration::from_millis(50);
/// How long it may take until we are back here, all that stands still on the way included.
const ALIVE: Duration = Duration::from_secs(30);

/// A lambda and all that it takes to run it live.
pub(super) struct Course {
    pub(super) judge: Judge,
    pub(super) schedule: Schedule,
    pub(super) session: Session,
    pub(super) inputs: Vec<Arc<Topic>>,
    pub(super) ledger: Ledger,
    pub(super) recorder: Option<ToRecorder>,
    pub(super) round_trip: Option<RoundTrip>,
    pub(super) announcer: Option<Announcer>,
    pub(super) watch: Watch,
    pub(super) source: Box<dyn LiveSource>,
    pub(super) clock: Clock,
    pub(super) pulse: Pulse,
}

impl Course {
    /// Goes on until `stop`.
    pub(super) fn run(&mut self, stop: &AtomicBool) -> Result<(), Failure> {
        let mut looked = self.clock.now();
        loop {
            let now = self.clock.now();
            if now.saturating_sub(looked) >= nanoseconds(ROUND) {
                looked = now;
                if stop.load(Ordering::Relaxed) {
                    return Ok(());
                }
                self.pulse.alive(ALIVE);
                self.ledger.flush();
                self.look_after(now)?;
            }
            if let Some(wake) = self.schedule.next_tick(now).or_else(|| self.schedule.next_event())
            {
                self.wake(wake)?;
                continue;
            }
            let due = self
                .schedule
                .next_due()
                .unwrap_or(i64::MAX)
                .min(looked.saturating_add(nanoseconds(ROUND)));
            // A bell that was rung meanwhile ends this at once.
            thread::park_timeout(Duration::from_nanos(
                u64::try_from(due.saturating_sub(now)).unwrap_or(0),
            ));
        }
    }

    fn wake(&mut self, wake: Wake) -> Result<(), Failure> {
        let at_ns = wake.at_ns();
        if self.judge.is_backing_off(&wake) {
            return Ok(());
        }
        let sample = if let Wake::Event(sample) = &wake { Some(sample) } else { None };
        for topic in &self.inputs {
            let woken_by = sample
                .filter(|sample| Arc::ptr_eq(sample.topic(), topic))
                .and_then(|it| it.position());
            topic.see_until(at_ns, woken_by);
        }
        let cause = self.round_trip.is_some().then(|| RoundTrip::cause(&wake, self.clock));
        if let Some(recorder) = &mut self.recorder {
            recorder.begin(&wake);
        }
        let entered = self.clock.now();
        let decision = self.judge.judge(wake);
        let left = self.clock.now();
        if let (Some(round_trip), Some(cause)) = (&mut self.round_trip, cause) {
            round_trip.answer(cause, &decision);
        }
        let (log, said) = self.session.take_log();
        // Should the recorder be gone, the decision is written all the same.
        let told = match &mut self.recorder {
            Some(recorder) => recorder.end(&decision, said, self.clock.monotonic(left)),
            None => Ok(()),
        };
        let out = self.clock.now();
        if let Some(announcer) = &mut self.announcer {
            announcer.decision(&decision);
        }
        self.watch.woke(&decision, log.len(), Times { at: at_ns, entered, left, out });
        self.ledger.log(log);
        self.ledger.decision(decision);
        told
    }

    /// Messages that were not sent on topics that were asked for.
    pub(super) fn unsent(&self) -> u64 {
        let answers = self.round_trip.as_ref().map_or(0, RoundTrip::unsent);
        answers + self.announcer.as_ref().map_or(0, Announcer::unsent)
    }

    fn look_after(&mut self, now: i64) -> Result<(), Failure> {
        if let Some(recorder) = &mut self.recorder {
            recorder.poll()?;
        }
        if !self.watch.is_due(now) {
            return Ok(());
        }
        let health = self.source.health();
        if let Some(why) = &health.dead {
            let mut failure =
                Failure::new(Exit::Unreachable, "nothing of the network is handled any more");
            failure.causes = vec![why.clone()];
            return Err(failure
                .with_help("start again; where it happens often, report it with these words"));
        }
        let live = self.watch.report(&Around {
            source: &*self.source,
            health: &health,
            inputs: &self.inputs,
            schedule: &self.schedule,
            session: &self.session,
            unwritten: self.ledger.unwritten(),
            unsent: self.unsent(),
            recorder: self.recorder.as_ref().map(ToRecorder::dropped),
        });
        self.ledger.report(Report::Live(Box::new(live)));
        Ok(())
    }
}
