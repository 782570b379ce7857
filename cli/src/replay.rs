//! `gleaner replay DIR DRIVE...`: starts `gleaner-runtime`, shows how far it is, and at the end what came out.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, IsTerminal, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

use gleaner_protocol::{Exit, Explain, Failure, Parts, Report, Summary, visible};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::args::ReplayArgs;
use crate::listen::Listener;
use crate::results::Decisions;
use crate::show::{self, Digest, Paint};

/// Why the runtime did not do what it was asked for, where it could not say so itself.
#[derive(Debug, thiserror::Error)]
enum ReplayError {
    #[error("cannot start `{}`", program.display())]
    Start { program: PathBuf, source: io::Error },
    #[error("cannot read the reports of gleaner-runtime")]
    Read { source: io::Error },
    #[error("gleaner-runtime reports what this gleaner does not understand: {line}")]
    Report { line: String, source: serde_json::Error },
    #[error("gleaner-runtime was killed by signal {signal}")]
    Killed { signal: i32 },
    #[error("gleaner-runtime ended with {status}, which is no exit code of Gleaner")]
    Code { status: ExitStatus },
    #[error("gleaner-runtime ended without a summary")]
    NoSummary,
}

impl Explain for ReplayError {
    fn help(&self) -> Option<String> {
        match self {
            ReplayError::Report { .. } => Some("install gleaner and gleaner-runtime of one version".to_owned()),
            ReplayError::Killed { signal: 9 } => {
                Some("the system kills the largest process when memory runs out; see `dmesg`".to_owned())
            }
            _ => None,
        }
    }
}

/// Replays, and ends as the runtime ends.
pub(crate) fn run(args: &ReplayArgs) -> Result<Exit, Failure> {
    let program = Parts::find()?.program("gleaner-runtime")?;
    let bar = progress_bar();
    let mut child = start(&program, args, &bar)?;
    // Both streams are heard on threads of their own: a lambda may leave processes behind that hold them open for ever.
    let says = child.stderr.take().map(|says| {
        let bar = bar.clone();
        // Nobody is left to tell if standard error is gone.
        Listener::start(move || pass_on(says, |piece| drop(bar.suspend(|| io::stderr().write_all(piece)))))
    });
    let reports = child.stdout.take().map(|reports| {
        let bar = bar.clone();
        Listener::start(move || follow(reports, &bar))
    });
    let heard = reports.and_then(|reports| reports.until_the_end_of(&mut child));
    bar.finish_and_clear();
    let summary = heard.unwrap_or(Ok(None));
    if summary.is_err() {
        // Nobody listens to it any more. It may have ended meanwhile, which is as good.
        let _ = child.kill();
    }
    let status = child.wait().map_err(|source| ReplayError::Read { source })?;
    // The last it says is why it failed.
    says.and_then(Listener::rest);
    let summary = summary?;
    let exit = exit_of(status)?;
    match (&summary, exit) {
        (Some(summary), _) => print(summary, args.json)?,
        (None, Exit::Ok) => return Err(ReplayError::NoSummary.into()),
        // It has said on standard error why.
        (None, _) => {}
    }
    Ok(exit)
}

/// The one place where `gleaner` starts the runtime.
fn start(program: &Path, args: &ReplayArgs, bar: &ProgressBar) -> Result<Child, ReplayError> {
    // While a bar is drawn, what the runtime says has to be put above it.
    let says = if bar.is_hidden() { Stdio::inherit() } else { Stdio::piped() };
    Command::new(program)
        .args(arguments(args))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(says)
        .spawn()
        .map_err(|source| ReplayError::Start { program: program.to_owned(), source })
}

/// The runtime's arguments: ours, less what only concerns showing.
fn arguments(args: &ReplayArgs) -> Vec<OsString> {
    let mut line: Vec<OsString> = vec!["replay".into()];
    for set in &args.set {
        line.extend(["--set".into(), set.into()]);
    }
    for remap in &args.remap {
        line.extend(["--remap".into(), remap.into()]);
    }
    if let Some(out) = &args.out {
        line.extend(["--out".into(), out.into()]);
    }
    if args.all {
        line.push("--all".into());
    }
    line.push("--".into());
    line.push(args.lambda.clone().into());
    line.extend(args.drives.iter().map(|drive| drive.clone().into()));
    line
}

/// Reads reports up to the summary, which is the last. The result is `None` if they end before.
fn follow(reports: impl Read, bar: &ProgressBar) -> Result<Option<Summary>, ReplayError> {
    for line in BufReader::new(reports).lines() {
        let line = line.map_err(|source| ReplayError::Read { source })?;
        match serde_json::from_str(&line) {
            Ok(Report::Progress { done, total, .. }) => {
                if let Some(total) = total {
                    bar.set_length(total);
                }
                bar.set_position(done);
            }
            Ok(Report::Round(_)) => {}
            Ok(Report::Summary(summary)) => return Ok(Some(*summary)),
            Err(source) => {
                let line = visible(&line.chars().take(200).collect::<String>());
                return Err(ReplayError::Report { line, source });
            }
        }
    }
    Ok(None)
}

/// Gives lines to `show`. A line is cut into pieces rather than held whole, however long it is.
fn pass_on(says: impl Read, mut show: impl FnMut(&[u8])) {
    const PIECE: u64 = 8192;
    let mut says = BufReader::new(says);
    let mut line = Vec::new();
    while matches!((&mut says).take(PIECE).read_until(b'\n', &mut line), Ok(1..)) {
        show(&line);
        line.clear();
    }
}

fn progress_bar() -> ProgressBar {
    // Hidden by itself where standard error is no terminal.
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    let style = "{bar:30} {percent:>3} %  {human_pos} of {human_len} messages, {eta} left";
    bar.with_style(ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()))
}

fn exit_of(status: ExitStatus) -> Result<Exit, ReplayError> {
    if let Some(signal) = signal_of(status) {
        return Err(ReplayError::Killed { signal });
    }
    status.code().and_then(Exit::from_code).ok_or(ReplayError::Code { status })
}

#[cfg(unix)]
fn signal_of(status: ExitStatus) -> Option<i32> {
    std::os::unix::process::ExitStatusExt::signal(&status)
}

#[cfg(not(unix))]
fn signal_of(_: ExitStatus) -> Option<i32> {
    None
}

fn print(summary: &Summary, json: bool) -> Result<(), Failure> {
    let text = if json {
        serde_json::to_string(summary).expect("a summary has only text keys and finite numbers") + "\n"
    } else {
        let digest = Digest::of(Decisions::open(&summary.out)?, summary.start_ns)?;
        show::summary(summary, &digest, Paint::new(io::stdout().is_terminal()))
    };
    // Whoever reads this may have gone; the results are in files.
    let _ = io::stdout().write_all(text.as_bytes());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_runtime_gets_our_arguments_with_the_files_last() {
        let args = ReplayArgs {
            lambda: "-dir".into(),
            drives: vec!["a.mcap".into(), "b".into()],
            set: vec!["x=-1".to_owned()],
            remap: vec!["/a:=/b".to_owned()],
            out: Some("out".into()),
            all: true,
            json: true,
        };
        let line =
            ["replay", "--set", "x=-1", "--remap", "/a:=/b", "--out", "out", "--all", "--", "-dir", "a.mcap", "b"];
        assert_eq!(arguments(&args), line);
    }

    #[test]
    fn what_the_runtime_says_is_passed_on_line_by_line_and_to_the_end() {
        let long = "x".repeat(10_000);
        let mut shown = Vec::new();
        pass_on(format!("one\n{long}\nno line end").as_bytes(), |piece| shown.push(piece.to_vec()));
        assert_eq!(shown[0], b"one\n");
        assert_eq!(shown.concat(), format!("one\n{long}\nno line end").as_bytes());
        assert!(shown.iter().all(|piece| piece.len() <= 8192));
    }

    #[cfg(unix)]
    #[test]
    fn a_runtime_that_was_killed_is_an_internal_failure_that_names_the_signal() {
        use std::os::unix::process::ExitStatusExt;
        let failure = Failure::from(exit_of(ExitStatus::from_raw(9)).unwrap_err());
        assert_eq!(failure.exit, Exit::Internal);
        assert_eq!(failure.message, "gleaner-runtime was killed by signal 9");
        assert!(failure.help.is_some());
        assert_eq!(exit_of(ExitStatus::from_raw(7 << 8)).unwrap(), Exit::DriveDamaged);
        assert!(matches!(exit_of(ExitStatus::from_raw(101 << 8)), Err(ReplayError::Code { .. })));
    }
}
