//! Formats reports of the process that runs models.

use std::fmt::{self, Write};

use gleaner_base::visible;
use gleaner_protocol::inference::{InferenceReport, InferenceStatus, LoadedModel, ModelState};
use gleaner_report::format::{counted, grouped};

use super::{Paint, mib};

/// Formats a report: a model that was loaded or could not be, and the final status; all others are
/// empty.
pub(crate) fn inference(report: &InferenceReport, paint: Paint) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = match report {
        InferenceReport::Model(model) => write_model(&mut text, model, paint),
        InferenceReport::Ended(status) => write_status(&mut text, status, paint),
        InferenceReport::Ready | InferenceReport::Status(_) => Ok(()),
    };
    text
}

fn write_model(text: &mut String, model: &LoadedModel, paint: Paint) -> fmt::Result {
    let lambdas = visible(&model.lambdas.join(", "));
    let (reason, load_ms) = (visible(&model.reason), model.load_ns as f64 / 1e6);
    match model.state {
        ModelState::Warming => Ok(()),
        ModelState::Ready => {
            let how = format!("{}, loaded in {load_ms:.0} ms", visible(&model.runtime));
            writeln!(text, "model of {lambdas}: {how} {}", paint.dim(&format!("({reason})")))
        }
        ModelState::Failed => {
            writeln!(text, "{}", paint.red(&format!("model of {lambdas}: {reason}")))
        }
    }
}

fn write_status(text: &mut String, status: &InferenceStatus, paint: Paint) -> fmt::Result {
    for model in status.models.iter().filter(|model| model.runs + model.failed > 0) {
        let mean_ms = model.run_ns as f64 / 1e6 / model.runs.max(1) as f64;
        let runs = counted(model.runs, "run");
        let mut line = format!(
            "model of {}: {runs}, {mean_ms:.1} ms each; {} answered with an equal run's result",
            visible(&model.lambdas.join(", ")),
            grouped(model.shared),
        );
        if model.failed > 0 {
            line += &format!("; {} failed", grouped(model.failed));
        }
        writeln!(text, "{}", paint.dim(&line))?;
    }
    let line = format!("gleaner-inference: {:.1} MiB resident", mib(status.resident_bytes));
    writeln!(text, "{}", paint.dim(&line))
}
