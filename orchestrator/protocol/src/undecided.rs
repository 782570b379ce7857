use crate::manifest::{Manifest, Schedule};
use crate::{Cause, Decision, Doing, ExitRecord, Fault, FaultKind};

impl ExitRecord {
    /// The decision that the process of the lambda with this manifest did not live to write: a fault of kind `killed`. None if it was
    /// asked to end, or if something around the lambda failed.
    pub fn undecided(&self, manifest: &Manifest) -> Option<Decision> {
        if !self.is_the_lambdas() {
            return None;
        }
        let why = self.sentence().unwrap_or_else(|| "ended by itself, as if it had been told to".to_owned());
        let amounts = self.killed.map(|killed| killed.used_and_allowed());
        let wake = self.killed.filter(|killed| killed.doing == Doing::Wake);
        let (cause, input) = match &manifest.schedule {
            Schedule::Event { input, .. } => (Cause::Event, Some(input)),
            Schedule::Periodic { .. } => (Cause::Tick, None),
        };
        let topic = input.and_then(|name| manifest.inputs.iter().find(|input| input.name == *name));
        Some(Decision {
            // Of what ended by itself nobody knows the wake; the clocks agree to what the time of day was set meanwhile.
            at_ns: wake.map_or(self.ended_ns, |killed| killed.at_ns),
            cause,
            input: input.map(ToString::to_string),
            topic: topic.map(|input| input.topic.to_string()),
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
