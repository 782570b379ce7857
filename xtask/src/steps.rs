//! A step: said before it begins, with the tool's own progress below, and a way out if it fails.

use std::io::{self, Write};
use std::process::{Command, Output, Stdio};

use gleaner_base::{Exit, Failure};

/// Counts the steps of a command, so that a person sees how many are left.
pub(crate) struct Steps {
    begun: usize,
    total: usize,
}

impl Steps {
    pub(crate) fn of(total: usize) -> Steps {
        Steps { begun: 0, total }
    }

    /// Says what comes next.
    pub(crate) fn begin(&mut self, what: &str) {
        self.begun += 1;
        println!("[{}/{}] {what}", self.begun, self.total);
        // What the tool itself says, on either stream, has to come after it.
        let _ = io::stdout().flush();
    }
}

/// Runs `command` to its end, with its output shown. `help` is what to do if it fails.
pub(crate) fn run(command: &mut Command, help: &str) -> Result<(), Failure> {
    let status = command
        .stdin(Stdio::null())
        .status()
        .map_err(|error| cannot_start(command, &error, help))?;
    if status.success() { Ok(()) } else { Err(ended(command, &status.to_string(), help)) }
}

/// Runs `command` to its end and keeps what it writes to standard output; the rest is shown.
pub(crate) fn output(command: &mut Command, help: &str) -> Result<String, Failure> {
    let command = command.stdin(Stdio::null()).stderr(Stdio::inherit());
    let Output { status, stdout, .. } =
        command.output().map_err(|error| cannot_start(command, &error, help))?;
    if status.success() {
        Ok(String::from_utf8_lossy(&stdout).into_owned())
    } else {
        Err(ended(command, &status.to_string(), help))
    }
}

/// Runs `command` silently. Whether it succeeded is the answer; a program that is not there did
/// not.
pub(crate) fn succeeds(command: &mut Command) -> bool {
    let command = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

fn cannot_start(command: &Command, error: &io::Error, help: &str) -> Failure {
    let program = command.get_program().display();
    Failure::caused_by(Exit::Internal, format!("cannot start `{program}`"), error).with_help(help)
}

fn ended(command: &Command, status: &str, help: &str) -> Failure {
    let mut line = command.get_program().display().to_string();
    for argument in command.get_args() {
        line.push(' ');
        line.push_str(&argument.to_string_lossy());
    }
    let mut failure =
        Failure::new(Exit::Internal, "a step failed; its messages are above").with_help(help);
    failure.causes = vec![format!("`{line}` ended with {status}")];
    failure
}
