//! Formats reports of the process that runs models.

use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_protocol::inference::{InferenceReport, InferenceStatus, LoadedModel, ModelState};
use gleaner_report::format::{counted, grouped};
use gleaner_supervisor::InferenceEvent;

use super::{Paint, mib, written};

/// Formats an event of the process; empty if it has no text for the user.
pub(crate) fn inference_event(event: &InferenceEvent, paint: Paint) -> String {
    let warning = |text: &str| format!("warning: {}\n", visible(text));
    match event {
        InferenceEvent::Report(report) => inference(report, paint),
        InferenceEvent::Stderr(text) => String::from_utf8_lossy(text).into_owned(),
        InferenceEvent::Ended(reason, delay, _) => {
            warning(&format!("{reason}; restarting in {} s", delay.as_secs_f64()))
        }
        InferenceEvent::Refused(text) | InferenceEvent::Warning(text) => warning(text),
    }
}

/// Formats a report: a model that was loaded or could not be, and the final status; all others are
/// empty.
pub(crate) fn inference(report: &InferenceReport, paint: Paint) -> String {
    written(|text| match report {
        InferenceReport::Model(model) => write_model(text, model, paint),
        InferenceReport::Ended(status) => write_status(text, status, paint),
        InferenceReport::Starting
        | InferenceReport::Ready
        | InferenceReport::Try(_)
        | InferenceReport::Status(_) => Ok(()),
    })
}

fn write_model(text: &mut String, model: &LoadedModel, paint: Paint) -> fmt::Result {
    let (name, reason) = (name(model), visible(&model.reason));
    let load_ms = model.load_ns as f64 / 1e6;
    match model.state {
        ModelState::Warming => Ok(()),
        ModelState::Ready => {
            let how = format!("{}, loaded in {load_ms:.0} ms", visible(&model.runtime));
            writeln!(text, "{name}: {how} {}", paint.dim(&format!("({reason})")))
        }
        ModelState::Failed => writeln!(text, "{}", paint.red(&format!("{name}: {reason}"))),
    }
}

fn write_status(text: &mut String, status: &InferenceStatus, paint: Paint) -> fmt::Result {
    for model in status.models.iter().filter(|model| model.runs + model.failed > 0) {
        let mean_ms = model.run_ns as f64 / 1e6 / model.runs.max(1) as f64;
        let mut line =
            format!("{}: {}, {mean_ms:.1} ms each", name(model), counted(model.runs, "run"));
        if model.shared > 0 {
            line += &format!("; {} answered with an equal run's result", grouped(model.shared));
        }
        if model.failed > 0 {
            line += &format!("; {} failed", grouped(model.failed));
        }
        writeln!(text, "{}", paint.dim(&line))?;
    }
    let line = format!("gleaner-inference: {:.1} MiB resident", mib(status.resident_bytes));
    writeln!(text, "{}", paint.dim(&line))
}

fn name(model: &LoadedModel) -> String {
    let mut name = format!("model `{}`", visible(&model.path));
    if !model.lambdas.is_empty() {
        name += &format!(" of {}", visible(&model.lambdas.join(", ")));
    }
    name
}
