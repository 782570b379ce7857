//! Commands that another Gleaner program runs.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::process::Command;

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure};
use gleaner_protocol::Report;
use gleaner_protocol::ingress::IngressReport;
use serde::de::DeserializeOwned;

use crate::args::{InspectArgs, TopicsArgs};
use crate::output::show;
use crate::render;
use crate::separate;

/// Replaces this process by the program `name`, such as `gleaner-player`.
pub(crate) fn replace(name: &str, arguments: &[OsString]) -> Result<Exit, Failure> {
    let program = InstalledPrograms::find()?.program(name).map_err(|error| {
        let mut failure = Failure::from(error);
        let package = if name == "gleaner-cloud" { name } else { "gleaner" };
        let others = failure.help.iter().map(|help| format!("; {help}")).collect::<String>();
        failure.help = Some(format!("install the package `{package}`, which has it{others}"));
        failure
    })?;
    let error = Command::new(&program).args(arguments).exec();
    Err(Failure::caused_by(Exit::Internal, format!("cannot start `{}`", program.display()), &error))
}

/// Prints the live topics, which `gleaner-ingress` lists.
pub(crate) fn topics(args: &TopicsArgs) -> Result<Exit, Failure> {
    let mut line: Vec<OsString> = vec!["topics".into()];
    line.extend(args.network.to_args());
    line.extend(args.wait.map(|wait| format!("--wait={wait}").into()));
    match report("gleaner-ingress", &line)? {
        Err(exit) => Ok(exit),
        Ok(IngressReport::Topics { topics }) => {
            show(args.json, &topics, |topics| render::topics(topics))
        }
        Ok(_) => Err(Failure::new(Exit::Internal, "gleaner-ingress did not report topics")),
    }
}

/// Prints the contents of a drive, which `gleaner-runtime` reads.
pub(crate) fn inspect(args: &InspectArgs) -> Result<Exit, Failure> {
    let mut line: Vec<OsString> = vec!["inspect".into()];
    line.extend(args.all.then(|| "--all".into()));
    line.extend(args.merge.then(|| "--merge".into()));
    line.push("--".into());
    line.extend(args.drives.iter().map(OsString::from));
    let drive = match report("gleaner-runtime", &line)? {
        Err(exit) => return Ok(exit),
        Ok(Report::Drive(drive)) => drive,
        Ok(Report::Separate { drives }) => {
            return separate::each(&drives, args.json, |drives, _| {
                inspect(&InspectArgs { drives, ..*args })
            });
        }
        Ok(_) => {
            return Err(Failure::new(Exit::Internal, "gleaner-runtime did not report a drive"));
        }
    };
    show(args.json, &drive, render::drive)?;
    Ok(if drive.damaged.is_some() { Exit::DriveDamaged } else { Exit::Ok })
}

/// Runs a program with these arguments; returns its report, or its exit code if it failed.
fn report<T: DeserializeOwned>(name: &str, line: &[OsString]) -> Result<Result<T, Exit>, Failure> {
    let program = InstalledPrograms::find()?.program(name)?;
    let failed =
        |what: &str, error: &dyn std::error::Error| Failure::caused_by(Exit::Internal, what, error);
    let mut command = Command::new(&program);
    command.args(line);
    // It prints its errors itself.
    let output = command.stderr(std::process::Stdio::inherit()).output();
    let output =
        output.map_err(|error| failed(&format!("cannot start `{}`", program.display()), &error))?;
    match output.status.code().and_then(Exit::from_code) {
        Some(Exit::Ok) => {}
        Some(exit) => return Ok(Err(exit)),
        None => {
            return Err(Failure::new(Exit::Internal, format!("{name} failed ({})", output.status)));
        }
    }
    let report = serde_json::from_slice(&output.stdout);
    report.map(Ok).map_err(|error| failed(&format!("cannot parse the report of {name}"), &error))
}
