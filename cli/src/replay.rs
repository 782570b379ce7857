//! `gleaner replay DIR DRIVE...`: starts `gleaner-runtime`, shows how far it is, and at the end what came out.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, IsTerminal, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use gleaner_protocol::{Exit, Explain, Failure, Parts, Report, Summary, visible};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::args::ReplayArgs;
use crate::listen::Listener;
use crate::results::Decisions;
use crate::say::say;
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
    #[error("the lambda's process ended without a result ({status})")]
    NoResult { status: ExitStatus },
    #[error("the lambda's process did not end well after its result ({status})")]
    Code { status: ExitStatus },
}

impl Explain for ReplayError {
    fn help(&self) -> Option<String> {
        match self {
            ReplayError::Report { .. } => Some("install gleaner and gleaner-runtime of one version".to_owned()),
            ReplayError::NoResult { status } | ReplayError::Code { status } if signal_of(*status) == Some(9) => {
                Some("the system kills the largest process when memory runs out; see `dmesg`".to_owned())
            }
            ReplayError::NoResult { .. } | ReplayError::Code { .. } => Some(
                "the lambda or a library that it uses may have ended the process, as `os._exit` does, or crashed it"
                    .to_owned(),
            ),
            ReplayError::Start { .. } | ReplayError::Read { .. } => None,
        }
    }
}

/// Replays, and ends as the runtime ends.
pub(crate) fn run(args: &ReplayArgs) -> Result<Exit, Failure> {
    let program = Parts::find()?.program("gleaner-runtime")?;
    let bar = progress_bar();
    let mut child = start(&program, args)?;
    // Both streams are heard on threads of their own: a lambda may leave processes behind that hold them open for ever.
    let explained = Arc::new(AtomicBool::new(false));
    let says = child.stderr.take().map(|says| {
        let (bar, explained) = (bar.clone(), explained.clone());
        // While a bar is drawn, what the runtime says has to be put above it. Nobody is left to tell if standard error
        // is gone.
        let show = move |piece: &[u8]| drop(bar.suspend(|| io::stderr().write_all(piece)));
        Listener::start(move || pass_on(says, &explained, show))
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
    let exit = status.code().and_then(Exit::from_code);
    match (summary, exit) {
        (Some(summary), Some(exit)) => {
            print(&summary, args.json)?;
            Ok(exit)
        }
        (Some(_), None) => Err(ReplayError::Code { status }.into()),
        // An exit code alone is not trusted: a lambda can end the process with any.
        (None, Some(exit)) if exit != Exit::Ok && explained.load(Ordering::Relaxed) => Ok(exit),
        (None, _) => Err(ReplayError::NoResult { status }.into()),
    }
}

/// The one place where `gleaner` starts the runtime.
fn start(program: &Path, args: &ReplayArgs) -> Result<Child, ReplayError> {
    Command::new(program)
        .args(arguments(args))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
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

/// Gives lines to `show`, and notes in `explained` that one of them says why the runtime failed. A line is cut into
/// pieces rather than held whole, however long it is.
fn pass_on(says: impl Read, explained: &AtomicBool, mut show: impl FnMut(&[u8])) {
    const PIECE: u64 = 8192;
    let mut says = BufReader::new(says);
    let mut line = Vec::new();
    let mut at_start = true;
    while matches!((&mut says).take(PIECE).read_until(b'\n', &mut line), Ok(1..)) {
        // As a `Failure` begins; a lambda and its libraries write here too.
        if at_start && line.starts_with(b"error: ") {
            explained.store(true, Ordering::Relaxed);
        }
        show(&line);
        at_start = line.ends_with(b"\n");
        line.clear();
    }
}

fn progress_bar() -> ProgressBar {
    // Hidden by itself where standard error is no terminal.
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    let style = "{bar:30} {percent:>3} %  {human_pos} of {human_len} messages, {eta} left";
    bar.with_style(ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()))
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
    say(&text)
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
        let text = format!("one\n{long}\nno line end");
        pass_on(text.as_bytes(), &AtomicBool::new(false), |piece| shown.push(piece.to_vec()));
        assert_eq!(shown[0], b"one\n");
        assert_eq!(shown.concat(), text.as_bytes());
        assert!(shown.iter().all(|piece| piece.len() <= 8192));
    }

    #[test]
    fn only_a_line_that_begins_as_a_failure_explains_an_exit_code() {
        let inside = format!("{}error: x", "y".repeat(8192));
        for (text, expected) in
            [("error: x", true), ("a\nerror: x\n", true), ("an error: x\n", false), (&inside, false), ("", false)]
        {
            let explained = AtomicBool::new(false);
            pass_on(text.as_bytes(), &explained, |_| {});
            assert_eq!(explained.into_inner(), expected);
        }
    }
}
