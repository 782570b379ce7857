//! The live event loop: waits, runs the lambda, publishes its decisions, and does regular
//! housekeeping.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use gleaner_base::{Exit, Failure, nanoseconds};
use gleaner_messages::transport::Clock;
use gleaner_protocol::Report;
use gleaner_protocol::process_stats::Heartbeat;
use gleaner_samples::{FeedError, FeedEvent, ReconnectingReader, Waker};

use super::announce::Announcer;
use super::recorder::RecorderSender;
use super::results_writer::ResultsWriter;
use super::round_trip::RoundTrip;
use super::status::{StatusContext, StatusReporter, Times};
use crate::api::Session;
use crate::api::data::{Topic, Wake};
use crate::input::continue_fed_input;
use crate::invoker::Invoker;
use crate::schedule::WakeSchedule;

/// Interval at which signals, the recorder and the time of the next report are checked.
const ROUND: Duration = Duration::from_millis(50);
/// Watchdog interval of the event loop, including stalls.
const ALIVE: Duration = Duration::from_secs(30);

/// A lambda and the parts of its live run.
pub(super) struct LiveEventLoop {
    pub(super) invoker: Invoker,
    pub(super) schedule: WakeSchedule,
    pub(super) session: Session,
    pub(super) inputs: Vec<Arc<Topic>>,
    pub(super) results: ResultsWriter,
    pub(super) recorder: Option<RecorderSender>,
    pub(super) round_trip: Option<RoundTrip>,
    pub(super) announcer: Option<Announcer>,
    pub(super) watch: StatusReporter,
    pub(super) feed: ReconnectingReader,
    pub(super) bell: Waker,
    /// Number of ingresses before it.
    pub(super) connections: u32,
    pub(super) clock: Clock,
    pub(super) heartbeat: Heartbeat,
}

impl LiveEventLoop {
    /// Runs until `stop` is set.
    pub(super) fn run(&mut self, stop: &AtomicBool) -> Result<(), Failure> {
        let mut last_round = self.clock.now();
        loop {
            // Before the look at the schedule: a later sample ends the wait.
            let seen = self.bell.value();
            let now = self.clock.now();
            self.feed.look_for_losses();
            // A wake does not wait for the round, nor a round for many wakes.
            let wake = self.schedule.next_tick(now).or_else(|| self.schedule.next_event());
            let is_woken = wake.is_some();
            wake.map_or(Ok(()), |wake| self.wake(wake))?;
            if now.saturating_sub(last_round) >= nanoseconds(ROUND) {
                last_round = now;
                if stop.load(Ordering::Relaxed) {
                    return Ok(());
                }
                self.heartbeat.alive(ALIVE);
                self.results.flush();
                self.housekeeping(now)?;
                // There may be another bell.
                continue;
            }
            if is_woken {
                continue;
            }
            let due = self
                .schedule
                .next_due()
                .unwrap_or(i64::MAX)
                .min(last_round.saturating_add(nanoseconds(ROUND)));
            // A lambda that keeps too many samples may have missed one just now.
            self.invoker.free_holds();
            let left = u64::try_from(due.saturating_sub(now)).unwrap_or(0);
            self.bell.wait(seen, Duration::from_nanos(left));
        }
    }

    fn wake(&mut self, wake: Wake) -> Result<(), Failure> {
        let at_ns = wake.at_ns();
        if self.invoker.is_backing_off(&wake) {
            return Ok(());
        }
        let sample = if let Wake::Event(sample) = &wake { Some(sample) } else { None };
        for topic in &self.inputs {
            let woken_by = sample
                .filter(|sample| Arc::ptr_eq(sample.topic(), topic))
                .and_then(|it| it.position());
            topic.see_until(at_ns, woken_by);
        }
        let woken_by = sample.and_then(|it| Some((it.topic().clone(), it.position()?)));
        if !self.confirm_layouts(woken_by.as_ref().map(|(topic, at)| (topic, *at)))? {
            return Ok(());
        }
        let cause = self.round_trip.is_some().then(|| RoundTrip::cause(&wake, self.clock));
        if let Some(recorder) = &mut self.recorder {
            recorder.begin(&wake);
        }
        let entered = self.clock.now();
        let decision = self.invoker.invoke(wake);
        let left = self.clock.now();
        if let (Some(round_trip), Some(cause)) = (&mut self.round_trip, cause) {
            round_trip.answer(cause, &decision);
        }
        let (log, digest) = self.session.take_log();
        // The decision is written even if the recorder has ended.
        let recorded = match &mut self.recorder {
            Some(recorder) => recorder.end(&decision, digest, self.clock.monotonic(left)),
            None => Ok(()),
        };
        let out = self.clock.now();
        if let Some(announcer) = &mut self.announcer {
            announcer.decision(&decision);
        }
        self.watch.woke(&decision, log.len(), Times { at: at_ns, entered, left, out });
        self.results.log(log);
        self.results.decision(decision);
        recorded
    }

    /// Hides samples of an announced layout, until it is known to be that of the definitions: these
    /// were chosen before any writer had announced one. Returns false if the sample that causes the
    /// wake is one of them; it is skipped. Fails if the layout is another one.
    fn confirm_layouts(&mut self, woken_by: Option<(&Arc<Topic>, u64)>) -> Result<bool, Failure> {
        let mut is_shown = true;
        for (topic, id) in self.inputs.iter().zip(0..) {
            let Some(first) = topic.first_unconfirmed() else { continue };
            if let Some(announced) = self.feed.layout(id) {
                topic.live_layout.confirm(&announced).map_err(|why| {
                    let message = format!("input `{}` can no longer be read", topic.name());
                    let mut failure = Failure::new(Exit::Usage, message);
                    failure.causes.push(format!("topic `{}`: {why}", topic.ros_topic()));
                    failure.with_help("start it again: it then uses the definition of the writers")
                })?;
                continue;
            }
            topic.hide_from(first);
            if woken_by.is_some_and(|(woken, at)| Arc::ptr_eq(woken, topic) && first <= at) {
                topic.add_skipped(1);
                is_shown = false;
            }
        }
        Ok(is_shown)
    }

    /// Number of messages that were not sent on requested topics.
    pub(super) fn unsent(&self) -> u64 {
        let answers = self.round_trip.as_ref().map_or(0, |it| it.publisher.unsent());
        let decisions = self.announcer.as_ref().map_or(0, |it| it.publisher.unsent());
        answers.saturating_add(decisions).saturating_add(self.feed.unsent())
    }

    /// Passes the engine to the recorder: models may have been opened since.
    pub(super) fn note_engine(&mut self) {
        if let Some(recorder) = &mut self.recorder {
            recorder.engine(self.invoker.engine().to_string());
        }
    }

    fn housekeeping(&mut self, now: i64) -> Result<(), Failure> {
        self.note_engine();
        self.receive()?;
        if let Some(recorder) = &mut self.recorder {
            if let Some(socket) = self.feed.take_recorder() {
                recorder.rejoin(socket)?;
            }
            recorder.poll()?;
        }
        if !self.watch.is_due(now) {
            return Ok(());
        }
        let live = self.watch.report(&StatusContext {
            feed: &self.feed,
            inputs: &self.inputs,
            schedule: &self.schedule,
            session: &self.session,
            unwritten: self.results.unwritten(),
            unsent: self.unsent(),
            recorder_link: self.recorder.as_ref().map(RecorderSender::dropped),
        });
        self.results.report(Report::Live(Box::new(live)));
        Ok(())
    }

    /// Handles messages of the ingress. After its restart, inputs continue in its memory.
    fn receive(&mut self) -> Result<(), Failure> {
        let events = self.feed.poll().map_err(|error| match error {
            FeedError::Gone => Failure::new(Exit::Unreachable, "the ingress has ended")
                .with_help("`gleaner run` starts both again"),
            error => Failure::because("cannot receive samples", &error),
        })?;
        if self.feed.connections() != self.connections {
            self.connections = self.feed.connections();
            self.bell = self.feed.bell();
            // In the order of the grants.
            let mut index = 0;
            if let Some(round_trip) = &mut self.round_trip {
                round_trip.publisher.replace(self.feed.publisher(index));
                index += 1;
            }
            if let Some(announcer) = &mut self.announcer {
                announcer.publisher.replace(self.feed.publisher(index));
            }
        }
        for event in events {
            match event {
                FeedEvent::Attached(fed) => {
                    let index = usize::try_from(fed.info.id).unwrap_or(usize::MAX);
                    if let Some(topic) = self.inputs.get(index) {
                        continue_fed_input(topic, fed).map_err(|refused| {
                            Failure::because("cannot receive an input again", &refused)
                        })?;
                    }
                }
                FeedEvent::Refused { id, reason } => {
                    let refused = FeedError::refused(id, reason);
                    return Err(Failure::because("cannot receive an input again", &refused));
                }
                FeedEvent::Definitions { .. } | FeedEvent::Layout { .. } => {}
            }
        }
        self.inputs.iter().for_each(|topic| topic.reader().drop_left());
        Ok(())
    }
}
