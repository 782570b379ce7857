//! Implements `gleaner:lambda/trigger`: events, and the start and stop of recordings, checked and
//! counted by `gleaner_rules::triggers`.

pub use gleaner_rules::triggers::{Attribute, AttributeValue};
use gleaner_rules::triggers::{TriggerError as Refused, TriggerKind};

use super::decision::Trigger;
use super::session::current;
pub use crate::bindings::gleaner::lambda::trigger::TriggerError;

type CallResult = Result<(), TriggerError>;

pub(crate) fn event(label: &str, score: f64, attributes: &[Attribute]) -> CallResult {
    cause(TriggerKind::Event, label, Some(score), attributes)
}

pub(crate) fn start(label: &str, attributes: &[Attribute]) -> CallResult {
    cause(TriggerKind::Start, label, None, attributes)
}

pub(crate) fn stop(label: &str) -> CallResult {
    cause(TriggerKind::Stop, label, None, &[])
}

fn cause(
    kind: TriggerKind,
    label: &str,
    score: Option<f64>,
    attributes: &[Attribute],
) -> CallResult {
    let session = current();
    let text = |value: &AttributeValue| {
        if let AttributeValue::Text(text) = value { text.len() } else { 0 }
    };
    let texts = attributes
        .iter()
        .map(|attribute| attribute.key.len() + text(&attribute.value))
        .sum::<usize>();
    session.check_bytes(label.len() + texts);
    let state = &mut *session.lock();
    let at_ns = state.now_ns;
    let caused =
        state.triggers.cause(at_ns, kind, (label, score), attributes.to_vec(), |attributes| {
            let attributes =
                attributes.into_iter().map(|Attribute { key, value }| (key, value)).collect();
            Trigger { at_ns, kind, label: label.to_owned(), score, attributes }
        });
    caused.map_err(|refused: Refused| match refused.is_too_many() {
        true => TriggerError::TooMany(refused.to_string()),
        false => TriggerError::Invalid(refused.to_string()),
    })
}
