//! Makes the decision of a wake in which the process of a lambda ended.

use crate::{ExitRecord, Phase, WokenBy};
use gleaner_lambda::{Decision, Fault, FaultKind};

impl ExitRecord {
    /// Returns the decision of the wake in which the process of a lambda ended: a fault of kind
    /// `killed`. `None` if the lambda did not cause the end: it was requested, or Gleaner failed.
    pub fn interrupted_wake(&self, woken_by: WokenBy) -> Option<Decision> {
        if !self.is_caused_by_lambda() {
            return None;
        }
        let cause = self
            .sentence()
            .unwrap_or_else(|| "ended by itself without a request, with exit code 0".to_owned());
        let amounts = self.killed.map(|killed| killed.used_and_allowed());
        let wake = self.killed.filter(|killed| killed.phase == Phase::Wake);
        let fault = Fault {
            kind: FaultKind::Killed,
            message: format!("the lambda's process {cause}"),
            used: amounts.map(|(used, _)| used),
            allowed: amounts.map(|(_, allowed)| allowed),
        };
        // The wake is known only if the shim killed the process. The clocks agree unless the time
        // of day was set.
        let at_ns = wake.map_or(self.ended_ns, |killed| killed.at_ns);
        Some(woken_by.faulted(at_ns, wake.map_or(0, |killed| killed.ran_ns), fault))
    }
}

impl WokenBy {
    /// Returns the decision of a wake of which only the fault is known.
    pub fn faulted(self, at_ns: i64, run_ns: u64, fault: Fault) -> Decision {
        let Self { cause, input, topic } = self;
        let (writer, seq, triggers, fuel) = (None, None, Vec::new(), None);
        Decision {
            at_ns,
            cause,
            input,
            topic,
            writer,
            seq,
            triggers,
            fault: Some(fault),
            fuel,
            run_ns,
            model_ns: 0,
        }
    }
}
