//! Starting `gleaner-runtime`, showing how far it is and what it says, and hearing its result.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use gleaner_base::{Exit, Explain, Failure, each_piece, visible};
use gleaner_lambda::BuildDir;
use gleaner_lambda::manifest::{Kind, Manifest};
use gleaner_parts::Parts;
use gleaner_protocol::{Checked, Report, Summary, Verified};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::listen::Listener;
use crate::sibling::starter;

/// Longest report, as of one trigger with all its attributes or a clip with all that it lists, with
/// much room.
const REPORT_BYTES: u64 = 16 << 20;

/// Why the runtime did not do what it was asked for, where it could not say so itself.
#[derive(Debug, thiserror::Error)]
enum RuntimeError {
    #[error("cannot start `{}`", program.display())]
    Start { program: PathBuf, source: io::Error },
    #[error("cannot read the reports of gleaner-runtime")]
    Read { source: io::Error },
    #[error("gleaner-runtime reports what this gleaner does not understand: {line}")]
    Report { line: String, source: serde_json::Error },
    #[error("gleaner-runtime ended without a result ({status})")]
    NoResult { status: ExitStatus },
    #[error("gleaner-runtime did not end well after its result ({status})")]
    Code { status: ExitStatus },
}

impl Explain for RuntimeError {
    fn help(&self) -> Option<String> {
        match self {
            RuntimeError::Report { .. } => Some("install gleaner and gleaner-runtime of one version".to_owned()),
            RuntimeError::NoResult { status } | RuntimeError::Code { status } if signal_of(*status) == Some(9) => {
                Some("the system kills the largest process when memory runs out; see `dmesg`".to_owned())
            }
            RuntimeError::NoResult { .. } | RuntimeError::Code { .. } => Some(
                "no code of a lambda ends this process: run again with GLEANER_LOG=debug, and report what it prints"
                    .to_owned(),
            ),
            RuntimeError::Start { .. } | RuntimeError::Read { .. } => None,
        }
    }
}

/// What the runtime reports last.
#[derive(Debug)]
pub(crate) enum Heard {
    Summary(Box<Summary>),
    Verified(Verified),
    Checked(Box<Checked>),
}

/// Runs the runtime on `lambda` with these arguments to its end. Returns its result and how it
/// ended; no result if it has printed why there is none.
pub(crate) fn run(
    lambda: &Path,
    arguments: Vec<OsString>,
) -> Result<(Option<Heard>, Exit), Failure> {
    let parts = Parts::find()?;
    let runtime = parts.program("gleaner-runtime")?;
    let shim = if has_worker(lambda) { None } else { Some(parts.program("gleaner-shim")?) };
    let bar = progress_bar();
    let mut child = start(shim, runtime, arguments)?;
    // Both streams are heard on threads of their own: a lambda may leave processes behind that hold
    // them open for ever.
    let explained = Arc::new(AtomicBool::new(false));
    let says = child.stderr.take().map(|says| {
        let (bar, explained) = (bar.clone(), explained.clone());
        // While a bar is drawn, what the runtime says has to be put above it. Nobody is left to
        // tell if standard error is gone.
        let show = move |piece: &[u8]| drop(bar.suspend(|| io::stderr().write_all(piece)));
        Listener::start(move || pass_on(says, &explained, show))
    });
    let reports = child.stdout.take().map(|reports| {
        let bar = bar.clone();
        Listener::start(move || follow(reports, &bar))
    });
    let heard = reports.and_then(|reports| reports.until_the_end_of(&mut child));
    bar.finish_and_clear();
    let result = heard.unwrap_or(Ok(None));
    if result.is_err() {
        // Nobody listens to it any more. It may have ended meanwhile, which is as good.
        let _ = child.kill();
    }
    let status = child.wait().map_err(|source| RuntimeError::Read { source })?;
    // The last it says is why it failed.
    says.and_then(Listener::rest);
    let result = result?;
    match (result, status.code().and_then(Exit::from_code)) {
        (Some(result), Some(exit)) => Ok((Some(result), exit)),
        (Some(_), None) => Err(RuntimeError::Code { status }.into()),
        // An exit code alone is not trusted: a lambda can end the process with any.
        (None, Some(exit)) if exit != Exit::Ok && explained.load(Ordering::Relaxed) => {
            Ok((None, exit))
        }
        (None, _) => Err(RuntimeError::NoResult { status }.into()),
    }
}

/// Whether nothing of the lambda runs in the process of `gleaner-runtime`, which starts a worker
/// for it, below a shim: so it is for Python. Of a lambda that cannot be read, the runtime reports
/// why.
fn has_worker(lambda: &Path) -> bool {
    Manifest::load(BuildDir::of(lambda).path())
        .is_ok_and(|manifest| manifest.lambda.kind == Kind::Python)
}

/// Starts the runtime, below `shim` if the lambda runs in its process.
fn start(
    shim: Option<PathBuf>,
    runtime: PathBuf,
    arguments: Vec<OsString>,
) -> Result<Child, RuntimeError> {
    let mut command = Command::new(shim.as_ref().unwrap_or(&runtime));
    if shim.is_some() {
        command.args([starter(), "--".into()]).arg(&runtime);
    }
    let program = shim.unwrap_or(runtime);
    command
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|source| RuntimeError::Start { program, source })
}

/// Reads the next report into `line`; `false` if there is none. What is longer than a report can be
/// comes in pieces, which are none: a lambda's process writes here, too.
pub(crate) fn next_report(reports: &mut impl BufRead, line: &mut Vec<u8>) -> io::Result<bool> {
    line.clear();
    Ok(reports.take(REPORT_BYTES).read_until(b'\n', line)? > 0)
}

/// Reads reports up to the result, which is the last; `None` if they end before.
fn follow(reports: impl Read, bar: &ProgressBar) -> Result<Option<Heard>, RuntimeError> {
    let mut reports = BufReader::new(reports);
    let mut line = Vec::new();
    while next_report(&mut reports, &mut line).map_err(|source| RuntimeError::Read { source })? {
        match serde_json::from_slice(&line) {
            Ok(Report::Progress { done, total, .. }) => {
                if let Some(total) = total {
                    bar.set_length(total);
                }
                bar.set_position(done);
            }
            Ok(Report::Summary(summary)) => return Ok(Some(Heard::Summary(summary))),
            Ok(Report::Checked(checked)) => return Ok(Some(Heard::Checked(checked))),
            Ok(Report::Verified(verified)) => return Ok(Some(Heard::Verified(verified))),
            // Of a replay that makes several passes; and what is only reported live.
            Ok(_) => {}
            Err(source) => {
                let start = line.trim_ascii_end();
                let start = String::from_utf8_lossy(&start[..start.len().min(800)]);
                let line = visible(&start.chars().take(200).collect::<String>());
                return Err(RuntimeError::Report { line, source });
            }
        }
    }
    Ok(None)
}

/// Gives lines to `show`, and notes in `explained` that one of them says why the runtime failed.
pub(crate) fn pass_on(says: impl Read, explained: &AtomicBool, mut show: impl FnMut(&[u8])) {
    each_piece(says, |piece| {
        if piece.is_failure() {
            explained.store(true, Ordering::Relaxed);
        }
        show(fit_to_print(piece.bytes).as_bytes());
    });
}

/// With what a terminal would act on written out.
fn fit_to_print(piece: &[u8]) -> String {
    let text = String::from_utf8_lossy(piece);
    let (words, end) = text.strip_suffix('\n').map_or((&*text, ""), |words| (words, "\n"));
    words.split('\t').map(visible).collect::<Vec<_>>().join("\t") + end
}

fn progress_bar() -> ProgressBar {
    // Hidden by itself where standard error is no terminal.
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    let style = "{bar:30} {percent:>3} %  {human_pos} of {human_len} messages, {eta} left";
    bar.with_style(
        ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()),
    )
}

#[cfg(unix)]
fn signal_of(status: ExitStatus) -> Option<i32> {
    std::os::unix::process::ExitStatusExt::signal(&status)
}

#[cfg(not(unix))]
fn signal_of(_: ExitStatus) -> Option<i32> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

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

    /// Reports that begin with `text` and go on for ever; counts what was read of them.
    struct Endless<'a> {
        text: &'a [u8],
        read: u64,
    }

    impl Read for Endless<'_> {
        fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
            assert!(self.read < 4 * REPORT_BYTES, "what has no end is held");
            let n = match self.text.read(into)? {
                0 => io::repeat(b'x').read(into)?,
                n => n,
            };
            self.read += n as u64;
            Ok(n)
        }
    }

    #[test]
    fn a_report_without_an_end_is_refused_and_not_held() {
        let bar = ProgressBar::hidden();
        let progress = "{\"report\":\"progress\",\"done\":1,\"total\":2,\"at_ns\":0}\n";
        for text in ["", "\"", progress] {
            let endless = Endless { text: text.as_bytes(), read: 0 };
            let error = follow(endless, &bar).unwrap_err();
            assert!(error.to_string().contains("xxxx"), "{error}");
        }
        assert!(follow(&b""[..], &bar).unwrap().is_none());
    }

    #[test]
    fn nothing_that_is_passed_on_acts_on_a_terminal() {
        for (said, shown) in [
            ("plain\ttext, ä\n", "plain\ttext, ä\n"),
            ("\u{1b}]0;owned\u{7}\n", "\\u{1b}]0;owned\\u{7}\n"),
            ("back\rover", "back\\rover"),
            ("\u{202e}turned", "\\u{202e}turned"),
        ] {
            assert_eq!(fit_to_print(said.as_bytes()), shown);
        }
        assert_eq!(fit_to_print(b"\xffbroken\n"), "\u{fffd}broken\n");
    }

    #[test]
    fn only_a_line_that_begins_as_a_failure_explains_an_exit_code() {
        let inside = format!("{}error: x", "y".repeat(8192));
        for (text, expected) in [
            ("error: x", true),
            ("a\nerror: x\n", true),
            ("an error: x\n", false),
            (&inside, false),
            ("", false),
        ] {
            let explained = AtomicBool::new(false);
            pass_on(text.as_bytes(), &explained, |_| {});
            assert_eq!(explained.into_inner(), expected);
        }
    }
}
