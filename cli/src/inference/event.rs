//! Events of the process, as text.

use std::time::Duration;

use gleaner_base::visible;
use gleaner_protocol::inference::InferenceReport;

use crate::render::{self, Paint};

/// An event of the process, for the user.
pub(crate) enum InferenceEvent {
    /// One of its reports.
    Report(InferenceReport),
    /// A piece of its standard error.
    Stderr(Vec<u8>),
    /// It has ended without a request, for this reason, and is started again after the delay.
    Ended(String, Duration),
    /// Something else went wrong.
    Warning(String),
}

impl InferenceEvent {
    /// Returns the text for the user; empty if there is none.
    pub(crate) fn text(&self, paint: Paint) -> Vec<u8> {
        let warning = |text: &str| format!("warning: {}\n", visible(text)).into_bytes();
        match self {
            InferenceEvent::Report(report) => render::inference(report, paint).into_bytes(),
            InferenceEvent::Stderr(text) => text.clone(),
            InferenceEvent::Ended(reason, delay) => {
                warning(&format!("{reason}; restarting in {} s", delay.as_secs_f64()))
            }
            InferenceEvent::Warning(text) => warning(text),
        }
    }
}
