//! `gleaner:lambda/trigger` over `gleaner_host::api::trigger`.

use gleaner_host::api::trigger::{Attribute, AttributeValue, TriggerError};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyString};

use crate::sdk::SdkClass;

static TRIGGER_ERROR: SdkClass = SdkClass::new("gleaner.trigger", "TriggerError");

pub(crate) fn refused(py: Python<'_>, error: &TriggerError) -> PyErr {
    TRIGGER_ERROR.error(py, error.to_string(), error.kind().name())
}

/// Converts keyword arguments into attributes of `label`, in the order of the call.
pub(crate) fn attributes(
    label: &str,
    named: Option<&Bound<'_, PyDict>>,
) -> PyResult<Vec<Attribute>> {
    let Some(named) = named else { return Ok(Vec::new()) };
    let attribute = |(key, value): (Bound<'_, PyAny>, Bound<'_, PyAny>)| {
        let key = key.extract::<String>()?;
        let value = attribute_value(label, &key, &value)?;
        Ok(Attribute { key, value })
    };
    named.iter().map(attribute).collect()
}

fn attribute_value(label: &str, key: &str, value: &Bound<'_, PyAny>) -> PyResult<AttributeValue> {
    if let Some(plain) = plain(value)? {
        return Ok(plain);
    }
    // A numpy scalar converts itself with `item`.
    if let Ok(item) = value.call_method0("item")
        && let Some(plain) = plain(&item)?
    {
        return Ok(plain);
    }
    let given = value.get_type().name()?;
    let message = format!(
        "attribute `{key}` of `{label}` is of type `{given}`; give bool, int, float or str"
    );
    Err(PyTypeError::new_err(message))
}

fn plain(value: &Bound<'_, PyAny>) -> PyResult<Option<AttributeValue>> {
    // A bool is an int too, so it is checked first.
    Ok(Some(if let Ok(value) = value.cast::<PyBool>() {
        AttributeValue::Boolean(value.is_true())
    } else if value.is_instance_of::<PyInt>() {
        AttributeValue::Signed(value.extract()?)
    } else if value.is_instance_of::<PyFloat>() {
        AttributeValue::Real(value.extract()?)
    } else if value.is_instance_of::<PyString>() {
        AttributeValue::Text(value.extract()?)
    } else {
        return Ok(None);
    }))
}
