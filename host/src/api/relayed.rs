//! Relays triggers, log and counts of a lambda from another process, which reads them from its
//! session; this process checks them like calls.

use gleaner_journal::LogDigest;
use gleaner_lambda::{Trigger, TriggerKind};
use gleaner_rules::triggers::TriggerError as Refusal;
use serde_json::Value;

use super::Session;
use super::data::Topic;
use super::log::LogLine;
use super::trigger::{Attribute, AttributeValue, TriggerError};

impl Session {
    /// Triggers of this wake so far.
    pub fn triggers(&self) -> Vec<Trigger> {
        self.lock().triggers.list().to_vec()
    }

    /// Number of log lines that wait to be taken.
    pub fn lines(&self) -> usize {
        self.lock().log.behind(0).0.len()
    }

    /// Returns the lines after the first `n`, without removing them, and the digest of all lines.
    pub fn lines_behind(&self, n: usize) -> (Vec<LogLine>, LogDigest) {
        let state = self.lock();
        let (lines, digest) = state.log.behind(n);
        (lines.to_vec(), digest)
    }

    /// Takes a trigger over from another process.
    ///
    /// # Errors
    ///
    /// [`TriggerError`] if no call could have caused it.
    pub fn relay_trigger(&self, trigger: Trigger) -> Result<(), TriggerError> {
        let Trigger { kind, label, score, attributes } = trigger;
        let wrong =
            |key: &str, why| Refusal::Attribute { label: label.clone(), key: key.to_owned(), why };
        if score.is_some() != (kind == TriggerKind::Event) {
            return Err(wrong("score", "an event has a score, and nothing else has one").into());
        }
        let attributes = attributes.into_iter().map(|(key, value)| match attribute(value) {
            Some(value) => Ok(Attribute { key, value }),
            None => Err(wrong(&key, "the value must be a truth value, a number or a text")),
        });
        let attributes = attributes.collect::<Result<_, Refusal>>()?;
        match (kind, score) {
            (TriggerKind::Event, score) => {
                self.event(&label, score.unwrap_or_default(), attributes)
            }
            (TriggerKind::Start, _) => self.start(&label, attributes),
            (TriggerKind::Stop, _) => self.stop(&label),
        }
    }

    /// Takes over the counts of a call from another process: the digest of all lines that the
    /// lambda logged, and the numbers of dropped lines and refused triggers. `Session::write` takes
    /// over the lines that passed the rate limit.
    pub fn relay_counts(&self, digest: LogDigest, log_dropped: u64, triggers_refused: u64) {
        let mut state = self.lock();
        state.log.relay(digest, log_dropped);
        state.triggers.add_refused(triggers_refused);
    }
}

fn attribute(value: Value) -> Option<AttributeValue> {
    Some(match value {
        Value::Bool(value) => AttributeValue::Boolean(value),
        Value::Number(number) => match number.as_i64() {
            Some(value) => AttributeValue::Signed(value),
            None => AttributeValue::Real(number.as_f64()?),
        },
        Value::String(text) => AttributeValue::Text(text),
        Value::Null | Value::Array(_) | Value::Object(_) => return None,
    })
}

impl Topic {
    pub fn reset_look_back(&self) {
        self.look_back.reset();
    }

    /// Number of samples, back from the newest, at which the lambda has looked in this wake; `None`
    /// if it looked at none.
    pub fn look_back(&self) -> Option<u64> {
        self.look_back.oldest().map(|oldest| self.reader().head().saturating_sub(oldest))
    }

    /// Notes that the lambda, in another process, has looked `back` samples back from the newest.
    pub fn relay_look_back(&self, back: u64) {
        self.look_back.at_position(self.reader().head().saturating_sub(back));
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::api::trigger::tests::session;

    fn trigger(text: Value) -> Trigger {
        serde_json::from_value(text).unwrap()
    }

    #[test]
    fn a_relayed_trigger_is_unchanged() {
        let attributes = json!({"n": 1, "x": 1.0, "far": -2.5e300, "is": true, "text": "ä\u{1b}"});
        let there = [
            trigger(json!({"kind": "event", "label": "a", "score": 1.0, "attributes": attributes})),
            trigger(json!({"kind": "start", "label": "b", "score": null, "attributes": {}})),
            trigger(json!({"kind": "stop", "label": "b", "score": null, "attributes": {}})),
        ];
        let here = session();
        there.iter().for_each(|trigger| here.relay_trigger(trigger.clone()).unwrap());
        assert_eq!(here.triggers(), there);
        assert_eq!(here.end(), there);
    }

    #[test]
    fn a_trigger_that_no_call_could_have_caused_is_refused() {
        for (kind, label, score, attributes) in [
            ("event", "", json!(1.0), json!({})),
            ("event", "a", json!(null), json!({})),
            ("start", "a", json!(1.0), json!({})),
            ("event", "a", json!(1.0), json!({"list": [1]})),
            ("event", "a", json!(1.0), json!({"": 1})),
            ("event", "a", json!(1.0), json!({"text": "x".repeat(2000)})),
        ] {
            let text =
                json!({"kind": kind, "label": label, "score": score, "attributes": attributes});
            assert!(session().relay_trigger(trigger(text.clone())).is_err(), "{text}");
        }
        let here = session();
        let one =
            || trigger(json!({"kind": "event", "label": "a", "score": 1.0, "attributes": {}}));
        assert_eq!((0..20).filter(|_| here.relay_trigger(one()).is_ok()).count(), 16);
    }
}
