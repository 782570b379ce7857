//! Commands that another program of ours does alone.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::process::Command;

use gleaner_protocol::{Exit, Failure, Parts, Report};

use crate::args::{NetworkArgs, TopicsArgs};
use crate::say::say;
use crate::show;

/// For `gleaner-shim`: that it ends its runtime when this process dies.
pub(crate) fn starter() -> OsString {
    format!("--starter={}", std::process::id()).into()
}

/// Becomes `gleaner-player`.
pub(crate) fn play(arguments: &[OsString]) -> Result<Exit, Failure> {
    let program = Parts::find()?.program("gleaner-player")?;
    let error = Command::new(&program).args(arguments).exec();
    Err(Failure::caused_by(Exit::Internal, format!("cannot start `{}`", program.display()), &error))
}

/// Asks `gleaner-runtime` for the topics.
pub(crate) fn topics(args: &TopicsArgs) -> Result<Exit, Failure> {
    let program = Parts::find()?.program("gleaner-runtime")?;
    let failed = |what: &str, error: &dyn std::error::Error| Failure::caused_by(Exit::Internal, what, error);
    let mut runtime = Command::new(&program);
    runtime.arg("topics").args(network(&args.network));
    if let Some(wait) = args.wait {
        runtime.arg(format!("--wait={wait}"));
    }
    // It says itself why it cannot.
    let output = runtime.stderr(std::process::Stdio::inherit()).output();
    let output = output.map_err(|error| failed(&format!("cannot start `{}`", program.display()), &error))?;
    match output.status.code().and_then(Exit::from_code) {
        Some(Exit::Ok) => {}
        Some(exit) => return Ok(exit),
        None => {
            return Err(Failure::new(Exit::Internal, format!("gleaner-runtime did not end well ({})", output.status)));
        }
    }
    let topics = match serde_json::from_slice(&output.stdout) {
        Ok(Report::Topics { topics }) => topics,
        Ok(_) => return Err(Failure::new(Exit::Internal, "gleaner-runtime reported something else than topics")),
        Err(error) => return Err(failed("cannot understand what gleaner-runtime reports", &error)),
    };
    let text = if args.json { show::json_line(&topics) } else { show::topics(&topics) };
    say(&text)?;
    Ok(Exit::Ok)
}

/// The network, as our programs take it.
pub(crate) fn network(args: &NetworkArgs) -> Vec<OsString> {
    let domain = args.domain.map(|domain| format!("--domain={domain}"));
    let interfaces = args.interface.iter().map(|address| format!("--interface={address}"));
    domain.into_iter().chain(interfaces).map(OsString::from).collect()
}
