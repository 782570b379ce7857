//! `gleaner:lambda/trigger` over [`api::trigger`](crate::api::trigger).

use super::Hosted;
use super::bindings::gleaner::lambda::trigger::{Attribute, AttributeValue, Host, TriggerError};
use crate::api::trigger;

type Answer = wasmtime::Result<Result<(), TriggerError>>;

impl Host for Hosted {
    fn event(&mut self, label: String, score: f64, attributes: Vec<Attribute>) -> Answer {
        self.meter.charge(label.len() + bytes(&attributes))?;
        Ok(self.session.event(&label, score, attributes.into_iter().map(attribute).collect()).map_err(refused))
    }

    fn start(&mut self, label: String, attributes: Vec<Attribute>) -> Answer {
        self.meter.charge(label.len() + bytes(&attributes))?;
        Ok(self.session.start(&label, attributes.into_iter().map(attribute).collect()).map_err(refused))
    }

    fn stop(&mut self, label: String) -> Answer {
        self.meter.charge(label.len())?;
        Ok(self.session.stop(&label).map_err(refused))
    }
}

/// What an attribute costs besides its texts: it was lifted out of the guest before it could be refused.
const ATTRIBUTE_BYTES: usize = 64;

fn bytes(attributes: &[Attribute]) -> usize {
    let text = |value: &AttributeValue| match value {
        AttributeValue::Text(text) => text.len(),
        AttributeValue::Boolean(_) | AttributeValue::Signed(_) | AttributeValue::Real(_) => 8,
    };
    attributes.iter().map(|attribute| ATTRIBUTE_BYTES + attribute.key.len() + text(&attribute.value)).sum()
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

fn refused(error: trigger::TriggerError) -> TriggerError {
    match error {
        trigger::TriggerError::TooMany | trigger::TriggerError::TooOften { .. } => {
            TriggerError::TooMany(error.to_string())
        }
        error => TriggerError::Invalid(error.to_string()),
    }
}
