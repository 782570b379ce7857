//! What became of the process before this one, if it did not end well: a wake that it did not live to decide is a fault, too.

use std::path::Path;

use crate::stage::SUMMARY;
use gleaner_protocol::manifest::{Manifest, Schedule};
use gleaner_protocol::{Cause, Decision, Doing, ExitRecord, Fault, FaultKind};

/// The decision that the process before could not write, by the record of its end in `out`. None if nobody wrote down how, or if it
/// ended in order, or because something around the lambda failed. To be asked before results are begun.
pub(super) fn undecided(manifest: &Manifest, out: &Path) -> Option<Decision> {
    if out.join(SUMMARY).exists() {
        return None;
    }
    let record = ExitRecord::read(&out.join(format!("{}{}", ExitRecord::FILE, ExitRecord::EARLIER)))
        .ok()
        .filter(ExitRecord::is_the_lambdas)?;
    // Had it ended as it should, there would have been no need for this process.
    let why = record.sentence().unwrap_or_else(|| "ended by itself, as if it had been told to".to_owned());
    let wake = record.killed.filter(|killed| killed.doing == Doing::Wake);
    let (cause, input) = match &manifest.schedule {
        Schedule::Event { input, .. } => (Cause::Event, Some(input)),
        Schedule::Periodic { .. } => (Cause::Tick, None),
    };
    let topic = input.and_then(|name| manifest.inputs.iter().find(|input| input.name == *name));
    Some(Decision {
        // Of what ended by itself nobody knows the wake; the clocks agree to what the time of day was set meanwhile.
        at_ns: wake.map_or(record.ended_ns, |killed| killed.at_ns),
        cause,
        input: input.map(ToString::to_string),
        topic: topic.map(|input| input.topic.to_string()),
        writer: None,
        seq: None,
        triggers: Vec::new(),
        fault: Some(Fault {
            kind: FaultKind::Killed,
            message: format!("the lambda's process {why}"),
            used: record.killed.map(|killed| killed.ran_ns),
            allowed: record.killed.map(|killed| killed.allowed_ns),
        }),
        fuel: None,
        run_ns: wake.map_or(0, |killed| killed.ran_ns),
    })
}
