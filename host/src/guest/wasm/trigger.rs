//! `gleaner:lambda/trigger` over [`api::trigger`](crate::api::trigger).

use super::Hosted;
use super::bindings::gleaner::lambda::trigger::{Attribute, AttributeValue, Host, TriggerError};
use crate::api::trigger::{self, TriggerErrorKind};

type TriggerResult = wasmtime::Result<Result<(), TriggerError>>;

impl Host for Hosted {
    fn event(&mut self, label: String, score: f64, attributes: Vec<Attribute>) -> TriggerResult {
        wit_result(self.session.event(
            &label,
            score,
            attributes.into_iter().map(attribute).collect(),
        ))
    }

    fn start(&mut self, label: String, attributes: Vec<Attribute>) -> TriggerResult {
        wit_result(self.session.start(&label, attributes.into_iter().map(attribute).collect()))
    }

    fn stop(&mut self, label: String) -> TriggerResult {
        wit_result(self.session.stop(&label))
    }
}

fn attribute(Attribute { key, value }: Attribute) -> trigger::Attribute {
    let value = match value {
        AttributeValue::Boolean(value) => trigger::AttributeValue::Boolean(value),
        AttributeValue::Signed(value) => trigger::AttributeValue::Signed(value),
        AttributeValue::Real(value) => trigger::AttributeValue::Real(value),
        AttributeValue::Text(value) => trigger::AttributeValue::Text(value),
    };
    trigger::Attribute { key, value }
}

fn wit_result(result: Result<(), trigger::TriggerError>) -> TriggerResult {
    let Err(error) = result else { return Ok(Ok(())) };
    if let trigger::TriggerError::OutOfFuel(error) = error {
        return Err(error.into());
    }
    let message = error.to_string();
    Ok(Err(match error.kind() {
        TriggerErrorKind::Invalid => TriggerError::Invalid(message),
        TriggerErrorKind::TooMany => TriggerError::TooMany(message),
    }))
}
