//! One wake from cause to decision: the same steps for every kind of guest, in replay and live.

use std::time::{Duration, Instant};

use gleaner_protocol::{Cause, Decision};

use crate::api::Session;
use crate::api::data::Wake;
use crate::guest::Guest;

/// Runs one lambda and writes down what it decides.
pub struct Judge {
    session: Session,
    guest: Box<dyn Guest>,
    run: Duration,
}

impl Judge {
    /// A judge over a guest whose `init` has succeeded, and the session that the guest was given.
    pub fn new(session: Session, guest: Box<dyn Guest>) -> Self {
        Self { session, guest, run: Duration::ZERO }
    }

    /// Runs the lambda once. A fault becomes part of the decision; what the lambda triggered before it still counts, since a
    /// moment that it found worth keeping must not be lost to a mistake made afterwards.
    pub fn judge(&mut self, wake: Wake) -> Decision {
        let mut decision = cause(&wake);
        self.session.begin(decision.at_ns);
        let started = Instant::now();
        let outcome = self.guest.wake(wake);
        let run = started.elapsed();
        self.run += run;
        decision.run_ns = run.as_nanos() as u64;
        decision.fuel = outcome.fuel;
        decision.triggers = self.session.end();
        decision.fault = outcome.result.err();
        decision
    }

    /// Time spent in the lambda so far.
    pub fn run(&self) -> Duration {
        self.run
    }
}

fn cause(wake: &Wake) -> Decision {
    let mut decision = Decision {
        at_ns: wake.at_ns(),
        cause: Cause::Tick,
        input: None,
        topic: None,
        writer: None,
        seq: None,
        triggers: Vec::new(),
        fault: None,
        fuel: None,
        run_ns: 0,
    };
    if let Wake::Event(sample) = wake {
        let meta = sample.meta();
        decision.cause = Cause::Event;
        decision.input = Some(sample.topic().name().to_owned());
        decision.topic = Some(sample.topic().ros_topic().to_owned());
        decision.writer = Some(meta.writer.to_string());
        decision.seq = Some(meta.seq);
    }
    decision
}
