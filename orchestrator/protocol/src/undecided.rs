use crate::{Decision, Doing, ExitRecord, Fault, FaultKind, WokenBy};

impl ExitRecord {
    /// The decision that the process of a lambda did not live to write: a fault of kind `killed`. None if it was asked to end, or if
    /// something around the lambda failed.
    pub fn undecided(&self, woken_by: WokenBy) -> Option<Decision> {
        if !self.is_the_lambdas() {
            return None;
        }
        let why = self.sentence().unwrap_or_else(|| "ended by itself, as if that had been asked for".to_owned());
        let amounts = self.killed.map(|killed| killed.used_and_allowed());
        let wake = self.killed.filter(|killed| killed.doing == Doing::Wake);
        let WokenBy { cause, input, topic } = woken_by;
        Some(Decision {
            // Of a process that ended by itself the wake is not known; the clocks agree but for what the time of day was set meanwhile.
            at_ns: wake.map_or(self.ended_ns, |killed| killed.at_ns),
            cause,
            input,
            topic,
            writer: None,
            seq: None,
            triggers: Vec::new(),
            fault: Some(Fault {
                kind: FaultKind::Killed,
                message: format!("the lambda's process {why}"),
                used: amounts.map(|(used, _)| used),
                allowed: amounts.map(|(_, allowed)| allowed),
            }),
            fuel: None,
            run_ns: wake.map_or(0, |killed| killed.ran_ns),
        })
    }
}
