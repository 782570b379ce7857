//! Invokes a lambda for one wake, from cause to decision: the same steps for every kind of guest,
//! in replay and live.

use std::time::{Duration, Instant};

use gleaner_lambda::{Cause, Decision, Fault, FaultKind};
use gleaner_rules::faults::Faults;

use crate::api::Session;
use crate::api::data::Wake;
use crate::guest::{Guest, LambdaEngine, Totals};

/// Runs one lambda and returns its decisions.
pub struct Invoker {
    session: Session,
    guest: Box<dyn Guest>,
    run: Duration,
    faults: Faults,
    /// The fault of the next wake, for samples that were kept before it.
    held_too_many: Option<Fault>,
}

impl Invoker {
    /// An invoker of `guest`, whose `init` has succeeded, with the session that the guest uses.
    pub fn new(session: Session, guest: Box<dyn Guest>) -> Self {
        Self { session, guest, run: Duration::ZERO, faults: Faults::default(), held_too_many: None }
    }

    /// Returns whether to skip this wake: the lambda backs off after faults, which is counted here,
    /// or its worker had no slot for the sample, which the worker counts.
    pub fn is_backing_off(&mut self, wake: &Wake) -> bool {
        let is_backing_off = self.faults.is_backing_off(wake.at_ns());
        if is_backing_off {
            self.session.count_backed_off();
        }
        is_backing_off || !self.guest.expects(wake)
    }

    /// Runs the lambda once. A fault becomes part of the decision. Triggers from before the fault
    /// still count: a later mistake must not lose a moment that was worth keeping.
    pub fn invoke(&mut self, wake: Wake) -> Decision {
        let mut decision = cause(&wake);
        self.session.begin(decision.at_ns);
        if let Some(note) = self.faults.begin() {
            self.session.note(note);
        }
        let started = Instant::now();
        let mut outcome = self.guest.wake(wake);
        let run = outcome.run_ns.map_or_else(|| started.elapsed(), Duration::from_nanos);
        self.run += run;
        decision.run_ns = run.as_nanos() as u64;
        decision.model_ns = outcome.model_ns.unwrap_or_else(|| self.session.models().run_ns());
        if let Some(fault) = self.fault_of_holds().or(self.held_too_many.take())
            && outcome.result.is_ok()
        {
            outcome.result = Err(fault);
        }
        decision.fuel = outcome.fuel;
        decision.triggers = self.session.end();
        decision.fault = outcome.result.err();
        if let Some(note) = self.faults.end(decision.at_ns, decision.fault.is_some()) {
            self.session.note(note);
        }
        decision
    }

    /// Discards the instance of the lambda, as after a wake with a fault.
    pub fn discard(&mut self) {
        self.guest.discard();
    }

    /// Frees the samples of a lambda that keeps so many that it could not be woken. Its next wake
    /// ends in a fault that names the cause.
    pub fn free_holds(&mut self) {
        self.held_too_many = self.fault_of_holds().or(self.held_too_many.take());
    }

    /// Returns the fault of a lambda that keeps too many samples, and frees them.
    fn fault_of_holds(&mut self) -> Option<Fault> {
        let error = self.session.take_refused_holds()?;
        self.guest.discard();
        let kind = FaultKind::HostCall;
        Some(Fault { kind, message: error.to_string(), used: None, allowed: None })
    }

    /// Ends a lambda that runs in another process, after its last wake.
    pub fn finish(&mut self) -> Result<Option<Totals>, Fault> {
        self.guest.finish()
    }

    /// The engine of the lambda, with what ran its models so far.
    pub fn engine(&self) -> LambdaEngine {
        self.guest.engine()
    }

    /// Peak resident memory of the lambda's process, in bytes.
    pub fn peak_resident_bytes(&self) -> u64 {
        self.guest.peak_resident_bytes()
    }

    /// Total time spent in the lambda so far.
    pub fn run(&self) -> Duration {
        self.run
    }
}

fn cause(wake: &Wake) -> Decision {
    let mut decision = Decision { at_ns: wake.at_ns(), cause: Cause::Tick, ..Decision::default() };
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

#[cfg(test)]
mod tests {
    use gleaner_lambda::manifest::Limits;
    use gleaner_rules::faults::{BACKING_OFF, REINITIALISED};

    use super::*;
    use crate::api::data::Tick;
    use crate::guest::WakeOutcome;

    /// A guest that faults in every wake before a time.
    struct Faulty {
        until_ns: i64,
    }

    impl Guest for Faulty {
        fn init(&mut self) -> Result<(), Fault> {
            Ok(())
        }

        fn wake(&mut self, wake: Wake) -> WakeOutcome {
            let fault =
                Fault { kind: FaultKind::Trap, message: String::new(), used: None, allowed: None };
            let result = if wake.at_ns() < self.until_ns { Err(fault) } else { Ok(()) };
            WakeOutcome { result, fuel: None, run_ns: None, model_ns: None }
        }

        fn engine(&self) -> LambdaEngine {
            LambdaEngine::default()
        }
    }

    const MS: i64 = 1_000_000;

    /// An invoker of a lambda that faults until then, and its session.
    fn faulty_until(until_ns: i64) -> (Invoker, Session) {
        let session = Session::new(Vec::new(), Vec::new(), &Limits::default());
        (Invoker::new(session.clone(), Box::new(Faulty { until_ns })), session)
    }

    fn tick(at_ns: i64) -> Wake {
        Wake::Tick(Tick { at_ns, missed: 0 })
    }

    /// Times in ms at which a lambda runs that is due every 10 ms.
    fn runs(invoker: &mut Invoker, from_ms: i64, to_ms: i64) -> Vec<i64> {
        let due = (from_ms..to_ms).step_by(10);
        due.filter(|ms| {
            let at_ns = ms * MS;
            let runs = !invoker.is_backing_off(&tick(at_ns));
            if runs {
                invoker.invoke(tick(at_ns));
            }
            runs
        })
        .collect()
    }

    #[test]
    fn after_eight_consecutive_faults_the_back_off_doubles_with_each_further_one() {
        let (mut invoker, session) = faulty_until(i64::MAX);
        let first = runs(&mut invoker, 0, 2000);
        assert_eq!(first, [0, 10, 20, 30, 40, 50, 60, 70, 170, 370, 770, 1570]);
        assert_eq!(session.backed_off(), 200 - 12);
        // The longest back-off is 10 s.
        assert_eq!(
            runs(&mut invoker, 2000, 60_000),
            [3170, 6370, 12_770, 22_770, 32_770, 42_770, 52_770]
        );
    }

    #[test]
    fn a_restart_after_a_fault_and_back_off_are_logged_by_the_host_not_the_lambda() {
        let (mut invoker, session) = faulty_until(i64::MAX);
        runs(&mut invoker, 0, 1000);
        let (lines, digest) = session.take_log();
        assert_eq!(
            lines.iter().map(|line| line.message.as_str()).collect::<Vec<_>>(),
            [REINITIALISED, BACKING_OFF]
        );
        assert_eq!((lines[0].at_ns, lines[1].at_ns, digest.lines), (10 * MS, 70 * MS, 0));
        // Again in the next second: state was lost again.
        runs(&mut invoker, 1000, 2000);
        assert_eq!(session.take_log().0.len(), 1);
    }
}
