//! `gleaner doctor`: checks whether lambdas can run well on this machine, and suggests fixes.
//!
//! It changes nothing, and sends no more than a request for the status of the vehicle.

mod isolation;
mod network;
mod vehicle;

use std::process::{Command, Output};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure};
use serde::Serialize;

use crate::args::DoctorArgs;
use crate::output::show;

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct Finding {
    subject: &'static str,
    state: Severity,
    detail: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    help: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Severity {
    Ok,
    /// Some features will not work, or not well.
    Warning,
    /// No lambda can run.
    Error,
}

impl Finding {
    fn ok(subject: &'static str, detail: impl Into<String>) -> Self {
        Self { subject, state: Severity::Ok, detail: detail.into(), help: None }
    }

    fn warning(subject: &'static str, detail: impl Into<String>, help: impl Into<String>) -> Self {
        Self { subject, state: Severity::Warning, detail: detail.into(), help: Some(help.into()) }
    }
}

/// Runs all checks and prints their results. Returns [`Exit::Internal`] if one is an error.
pub(crate) fn run(args: &DoctorArgs) -> Result<Exit, Failure> {
    let parts = InstalledPrograms::find()?;
    let mut findings = ["gleaner-runtime", "gleaner-ingress", "gleaner-recorder", "gleaner-shim"]
        .map(|name| program(&parts, name))
        .to_vec();
    findings.push(optional(&parts, "gleaner-player", "needed by `gleaner play`"));
    findings.push(python(&parts));
    findings.extend(isolation::findings(&parts));
    findings.extend(network::findings(&parts));
    findings.extend(vehicle::findings());
    for finding in &findings {
        show(args.json, finding, text)?;
    }
    let has_error = findings.iter().any(|finding| finding.state == Severity::Error);
    Ok(if has_error { Exit::Internal } else { Exit::Ok })
}

fn program(parts: &InstalledPrograms, name: &'static str) -> Finding {
    match parts.program(name) {
        Ok(path) => Finding::ok(name, path.display().to_string()),
        Err(error) => {
            let failure = Failure::from(error);
            let (detail, help) = (failure.message, failure.help);
            Finding { subject: name, state: Severity::Error, detail, help }
        }
    }
}

fn output_of(parts: &InstalledPrograms, name: &str, argument: &str) -> Result<Output, String> {
    let program = parts.program(name).map_err(|error| error.to_string())?;
    Command::new(program).arg(argument).output().map_err(|error| error.to_string())
}

fn optional(parts: &InstalledPrograms, name: &'static str, why: &str) -> Finding {
    let finding = program(parts, name);
    match finding.state {
        Severity::Error => {
            Finding { state: Severity::Warning, detail: format!("not found; {why}"), ..finding }
        }
        _ => finding,
    }
}

fn python(parts: &InstalledPrograms) -> Finding {
    match parts.python(None) {
        Ok(python) => Finding::ok("Python", python.display().to_string()),
        Err(error) => {
            let failure = Failure::from(error);
            let help = failure.help.unwrap_or_else(|| "install Python 3.9 or newer".to_owned());
            Finding::warning(
                "Python",
                format!("{}; needed by lambdas of kind python", failure.message),
                help,
            )
        }
    }
}

fn text(finding: &Finding) -> String {
    let state = match finding.state {
        Severity::Ok => "ok     ",
        Severity::Warning => "warning",
        Severity::Error => "error  ",
    };
    let mut text = format!("{state}  {}: {}\n", finding.subject, finding.detail);
    if let Some(help) = &finding.help {
        text += &format!("         help: {help}\n");
    }
    text
}
