//! Runs the steps of a command: prints each one before it begins, and the seconds that it took,
//! shows the output of its tool, and gives help if it fails.

use std::ffi::OsString;
use std::fs;
use std::io::{self, Write};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Instant;

use gleaner_base::{Exit, Failure};
use serde::de::DeserializeOwned;

use crate::checkout::Checkout;

pub(crate) struct Steps {
    started: usize,
    total: usize,
    began: Instant,
}

impl Steps {
    pub(crate) fn of(total: usize) -> Steps {
        Steps { started: 0, total, began: Instant::now() }
    }

    /// Ends the step before, and prints the next one.
    pub(crate) fn begin(&mut self, what: &str) {
        self.end();
        self.started += 1;
        self.began = Instant::now();
        println!("[{}/{}] {what}", self.started, self.total);
        // Flushed, so that output of the tool comes after it.
        let _ = io::stdout().flush();
    }

    /// Prints the seconds of the current step, if one has begun.
    pub(crate) fn end(&self) {
        if self.started > 0 {
            let seconds = self.began.elapsed().as_secs_f64();
            println!("[{}/{}] took {seconds:.1} s", self.started, self.total);
        }
    }
}

/// Returns the failure of an access to a file, or of its content.
pub(crate) fn cannot(action: &str, path: &Path, error: &impl std::error::Error) -> Failure {
    Failure::caused_by(Exit::Internal, format!("cannot {action} `{}`", path.display()), error)
}

/// Runs `command` with its output shown. `help` is for the error message if it fails.
pub(crate) fn run(command: &mut Command, help: &str) -> Result<(), Failure> {
    let status = command
        .stdin(Stdio::null())
        .status()
        .map_err(|error| cannot_start(command, &error, help))?;
    if status.success() { Ok(()) } else { Err(ended(command, &status.to_string(), help)) }
}

/// Runs a script that prints its own errors, and returns its exit code.
pub(crate) fn run_script(command: &mut Command) -> Result<Exit, Failure> {
    let status = command.stdin(Stdio::null()).status();
    let status = status.map_err(|error| cannot_start(command, &error, "install bash"))?;
    Ok(status.code().and_then(Exit::from_code).unwrap_or(Exit::Internal))
}

/// Runs a command that downloads something: if it fails, [`Exit::Unreachable`] marks
/// that what needs it can be skipped.
pub(crate) fn download(command: &mut Command, help: &str) -> Result<(), Failure> {
    run(command, help).map_err(|failure| Failure { exit: Exit::Unreachable, ..failure })
}

/// Writes a file, and creates the folders above it.
pub(crate) fn write_file(file: &Path, text: &str) -> Result<(), Failure> {
    make_folder(file.parent().unwrap_or(file))?;
    fs::write(file, text).map_err(|error| cannot("write", file, &error))
}

pub(crate) fn make_folder(folder: &Path) -> Result<(), Failure> {
    fs::create_dir_all(folder).map_err(|error| cannot("create", folder, &error))
}

pub(crate) fn remove_folder(folder: &Path) -> Result<(), Failure> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(cannot("remove", folder, &error))
        }
        _ => Ok(()),
    }
}

pub(crate) fn copy_files(from: &Path, to: &Path) -> io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            copy_files(&entry.path(), &target)?;
        } else {
            fs::copy(entry.path(), target)?;
        }
    }
    Ok(())
}

/// Returns whether the arguments of `command` are `flag`; all others are refused.
pub(crate) fn has_flag(command: &str, flag: &str, arguments: &[OsString]) -> Result<bool, Failure> {
    match arguments {
        [] => Ok(false),
        [one] if one == flag => Ok(true),
        _ => {
            let message = format!("`cargo xtask {command}` takes `{flag}` or nothing");
            Err(Failure::new(Exit::Usage, message))
        }
    }
}

/// Checks that tools run; each is named with its package.
pub(crate) fn require(checkout: &Checkout, tools: &[(&str, &str)]) -> Result<(), Failure> {
    for (tool, package) in tools {
        if !succeeds(checkout.command(tool).arg("--version")) {
            return Err(Failure::new(Exit::Unreachable, format!("`{tool}` is missing"))
                .with_help(format!("on Debian and Ubuntu, as root: apt-get install {package}")));
        }
    }
    Ok(())
}

/// Installs packages of Debian or Ubuntu, as root.
pub(crate) fn install(checkout: &Checkout, packages: &[&str]) -> Result<(), Failure> {
    let mut install = checkout.command("apt-get");
    install.args(["install", "-y", "--no-install-recommends"]).args(packages);
    let help = "install packages as root after `apt-get update`; on other systems than Debian and \
                Ubuntu, install their equivalents";
    download(install.env("DEBIAN_FRONTEND", "noninteractive"), help)
}

/// Checks that `missing` returns no packages; with `is_installing`, they are installed first. The
/// command of xtask with this `name` needs them.
pub(crate) fn require_packages(
    checkout: &Checkout,
    name: &str,
    is_installing: bool,
    missing: impl Fn() -> Vec<&'static str>,
) -> Result<(), Failure> {
    let packages = missing();
    if is_installing && !packages.is_empty() {
        install(checkout, &packages)?;
    }
    let packages = missing().join(" ");
    if packages.is_empty() {
        return Ok(());
    }
    let help = format!("as root: cargo xtask {name} --install, or: apt-get install {packages}");
    let message = format!("packages for `cargo xtask {name}` are missing");
    Err(Failure::new(Exit::Unreachable, message).with_help(help))
}

/// Runs `command` and returns its standard output; standard error is shown.
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

pub(crate) fn parsed<T: DeserializeOwned>(json: &str, source: &str) -> Result<T, Failure> {
    serde_json::from_str(json).map_err(|error| {
        Failure::caused_by(Exit::Internal, format!("`{source}` gave no result"), &error)
    })
}

/// Runs `command` silently; returns whether it succeeded. False if the program is missing.
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
