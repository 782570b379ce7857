//! `gleaner doctor`: what would keep lambdas from running well on this machine, and what to do
//! about it.
//!
//! It only looks: nothing is changed, started or sent.

mod isolation;
mod network;

use gleaner_base::{Exit, Failure};
use gleaner_parts::Parts;
use serde::Serialize;

use crate::args::DoctorArgs;
use crate::say::say;
use crate::show::json_line;

/// What was found of one thing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
struct Finding {
    /// What was looked at.
    about: &'static str,
    /// How bad it is.
    state: State,
    /// What was found.
    found: String,
    /// What to do about it.
    #[serde(skip_serializing_if = "Option::is_none")]
    help: Option<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum State {
    Fine,
    /// Some things will not work, or not well.
    Warning,
    /// Nothing will work.
    Broken,
}

impl Finding {
    fn fine(about: &'static str, found: impl Into<String>) -> Self {
        Self { about, state: State::Fine, found: found.into(), help: None }
    }

    fn warning(about: &'static str, found: impl Into<String>, help: impl Into<String>) -> Self {
        Self { about, state: State::Warning, found: found.into(), help: Some(help.into()) }
    }
}

/// Looks, and shows what was found. The exit is [`Exit::Internal`] if something is broken.
pub(crate) fn run(args: &DoctorArgs) -> Result<Exit, Failure> {
    let parts = Parts::find()?;
    let mut findings =
        vec![program(&parts, "gleaner-runtime"), program(&parts, "gleaner-recorder")];
    findings.push(program(&parts, "gleaner-shim"));
    findings.push(optional(&parts, "gleaner-player", "`gleaner play` needs it"));
    findings.push(python(&parts));
    findings.extend(isolation::findings(&parts));
    findings.extend(network::findings());
    let text = findings.iter().map(if args.json { json_line::<Finding> } else { text });
    say(&text.collect::<String>())?;
    let broken = findings.iter().any(|finding| finding.state == State::Broken);
    Ok(if broken { Exit::Internal } else { Exit::Ok })
}

fn program(parts: &Parts, name: &'static str) -> Finding {
    match parts.program(name) {
        Ok(path) => Finding::fine(name, path.display().to_string()),
        Err(error) => {
            let failure = Failure::from(error);
            let (found, help) = (failure.message, failure.help);
            Finding { about: name, state: State::Broken, found, help }
        }
    }
}

fn optional(parts: &Parts, name: &'static str, why: &str) -> Finding {
    let finding = program(parts, name);
    match finding.state {
        State::Broken => {
            Finding { state: State::Warning, found: format!("not there; {why}"), ..finding }
        }
        _ => finding,
    }
}

fn python(parts: &Parts) -> Finding {
    match parts.python(None) {
        Ok(python) => Finding::fine("Python", python.display().to_string()),
        Err(error) => {
            let failure = Failure::from(error);
            let help = failure.help.unwrap_or_else(|| "install Python 3.9 or newer".to_owned());
            Finding::warning(
                "Python",
                format!("{}; lambdas of kind python need it", failure.message),
                help,
            )
        }
    }
}

fn text(finding: &Finding) -> String {
    let state = match finding.state {
        State::Fine => "fine   ",
        State::Warning => "warning",
        State::Broken => "broken ",
    };
    let mut text = format!("{state}  {}: {}\n", finding.about, finding.found);
    if let Some(help) = &finding.help {
        text += &format!("         help: {help}\n");
    }
    text
}
