//! A decision for tests.

use gleaner_lambda::{Cause, Decision, Trigger, TriggerKind};

/// Returns the decision of a tick with one trigger.
pub(crate) fn triggered(at_ns: i64) -> Decision {
    let attributes = serde_json::Map::new();
    let trigger =
        Trigger { kind: TriggerKind::Event, label: "x".to_owned(), score: None, attributes };
    Decision { at_ns, cause: Cause::Tick, triggers: vec![trigger], ..Decision::default() }
}
