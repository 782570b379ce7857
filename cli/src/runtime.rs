//! Runs `gleaner-runtime`: shows its progress and messages, and reads its result.

use std::ffi::OsString;
use std::io::{self, BufReader, Read};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Explain, Failure, visible};
use gleaner_lambda::manifest::{LambdaKind, Manifest};
use gleaner_lambda::{BuildDir, InferenceLimits, Vehicle};
use gleaner_protocol::{CheckReport, Handover, PASSES_INFERENCE, ReplaySummary, Report, Verified};
use gleaner_supervisor::lines::{next_report, pass_on};
use gleaner_supervisor::{InferenceEvent, InferenceService, InferenceUse, starter};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::output::print_error;
use crate::pipe_reader::PipeReader;
use crate::render::{self, Paint};

/// Failures of the runtime that it cannot report itself.
#[derive(Debug, thiserror::Error)]
enum RuntimeError {
    #[error("cannot start `{}`", program.display())]
    Start { program: PathBuf, source: io::Error },
    #[error("cannot read the reports of gleaner-runtime")]
    Read { source: io::Error },
    #[error("cannot parse a report of gleaner-runtime: {line}")]
    Report { line: String, source: serde_json::Error },
    #[error("gleaner-runtime ended without a result ({status})")]
    NoResult { status: ExitStatus },
    #[error("gleaner-runtime failed after its result ({status})")]
    Code { status: ExitStatus },
}

impl Explain for RuntimeError {
    fn help(&self) -> Option<String> {
        let help = match self {
            RuntimeError::Report { .. } => {
                "install the same version of gleaner and gleaner-runtime"
            }
            RuntimeError::NoResult { status } | RuntimeError::Code { status }
                if status.signal() == Some(9) =>
            {
                "the system kills the largest process when memory runs out; see `dmesg`"
            }
            RuntimeError::NoResult { .. } | RuntimeError::Code { .. } => {
                "code of a lambda cannot end this process: run again with GLEANER_LOG=debug, and \
                 report the output"
            }
            RuntimeError::Start { .. } | RuntimeError::Read { .. } => return None,
        };
        Some(help.to_owned())
    }
}

/// The last report of the runtime.
#[derive(Debug)]
pub(crate) enum RuntimeResult {
    Summary(Box<ReplaySummary>),
    Verified(Verified),
    Checked(Box<CheckReport>),
    /// The files of each of several drives, of which none was replayed.
    Separate(Vec<Vec<PathBuf>>),
}

/// Runs the runtime on `lambda` with these arguments, and its models within the limits of the
/// configuration file `vehicle`. Returns its result and exit code; no result
/// if it has printed an error instead.
pub(crate) fn run(
    lambda: &Path,
    vehicle: Option<&Path>,
    arguments: Vec<OsString>,
) -> Result<(Option<RuntimeResult>, Exit), Failure> {
    let parts = InstalledPrograms::find()?;
    let runtime = parts.program("gleaner-runtime")?;
    // The runtime reports that it cannot be read.
    let build = BuildDir::of(lambda);
    let manifest = Manifest::load(build.path()).ok();
    let has_worker = manifest.as_ref().is_some_and(|it| it.lambda.kind == LambdaKind::Python);
    let shim = if has_worker { None } else { Some(parts.program("gleaner-shim")?) };
    let bar = progress_bar();
    let models = manifest.as_ref().filter(|manifest| !manifest.models.is_empty());
    // The runtime reports an error in that file.
    let limits = vehicle.and_then(|file| Vehicle::load(file).ok());
    let limits = limits.map_or_else(InferenceLimits::default, |vehicle| vehicle.inference);
    let models = models.map(|manifest| ModelsOfRun::start(&parts, &build, manifest, &limits, &bar));
    let models = models.transpose()?;
    let mut child = start(shim, runtime, arguments, models.as_ref())?;
    // Both pipes are read by threads, since a lambda may leave processes running that hold them
    // open forever.
    let explained = Arc::new(AtomicBool::new(false));
    let errors = child.stderr.take().map(|stderr| {
        let (bar, explained) = (bar.clone(), explained.clone());
        // Messages are printed above the bar.
        let show = move |piece: &[u8]| bar.suspend(|| print_error(&String::from_utf8_lossy(piece)));
        PipeReader::start(move || pass_on(stderr, &explained, show))
    });
    let reports = child.stdout.take().map(|reports| {
        let bar = bar.clone();
        PipeReader::start(move || follow(reports, &bar))
    });
    let reported = reports.and_then(|reports| reports.wait(&mut child));
    bar.finish_and_clear();
    let result = reported.unwrap_or(Ok(None));
    if result.is_err() {
        // The reports of the runtime are no longer read. Killing fails if it has ended meanwhile.
        let _ = child.kill();
    }
    let status = child.wait().map_err(|source| RuntimeError::Read { source })?;
    // The last message of the runtime is the cause of a failure.
    errors.and_then(PipeReader::drain);
    let has_failed = models.is_some_and(ModelsOfRun::end);
    let result = result?;
    match (result, status.code().and_then(Exit::from_code)) {
        (Some(result), Some(Exit::Ok)) if has_failed => Ok((Some(result), Exit::Internal)),
        (Some(result), Some(exit)) => Ok((Some(result), exit)),
        (Some(_), None) => Err(RuntimeError::Code { status }.into()),
        // An exit code alone is not trusted: a lambda can end the process with any code.
        (None, Some(exit)) if exit != Exit::Ok && explained.load(Ordering::Relaxed) => {
            Ok((None, exit))
        }
        (None, _) => Err(RuntimeError::NoResult { status }.into()),
    }
}

/// The process that runs the models of a replay, and the connection to pass to the runtime.
struct ModelsOfRun {
    service: InferenceService,
    /// Our end of the standard input of the runtime, and its end.
    handover: UnixStream,
    stdin: UnixStream,
    /// Set once the process has ended without a request.
    has_failed: Arc<AtomicBool>,
}

impl ModelsOfRun {
    fn start(
        parts: &InstalledPrograms,
        build: &BuildDir,
        manifest: &Manifest,
        limits: &InferenceLimits,
        bar: &ProgressBar,
    ) -> Result<Self, Failure> {
        let (bar, has_failed) = (bar.clone(), Arc::new(AtomicBool::new(false)));
        let failed = Arc::clone(&has_failed);
        let purpose = InferenceUse::OneLambda;
        let service = InferenceService::start(parts, limits, purpose, move |event| {
            if matches!(event, InferenceEvent::Ended(..)) {
                failed.store(true, Ordering::Relaxed);
            }
            let text = render::inference_event(&event, Paint::of_stderr());
            bar.suspend(|| print_error(&text));
        })?;
        let inference = service.add(manifest.lambda.name.as_str(), build, manifest)?;
        let cannot = |error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, "cannot connect the runtime to its models", error)
        };
        let (handover, stdin) = UnixStream::pair().map_err(|error| cannot(&error))?;
        let connections = Handover { inference: Some(inference), ..Handover::default() };
        connections.send(&handover).map_err(|error| cannot(&error))?;
        Ok(Self { service, handover, stdin, has_failed })
    }

    /// Ends the process; returns whether it had ended before.
    fn end(self) -> bool {
        let Self { service, handover, has_failed, .. } = self;
        service.stop();
        drop(handover);
        has_failed.load(Ordering::Relaxed)
    }
}

/// Starts the runtime, below `shim` if the lambda runs in the runtime's process.
fn start(
    shim: Option<PathBuf>,
    runtime: PathBuf,
    mut arguments: Vec<OsString>,
    models: Option<&ModelsOfRun>,
) -> Result<Child, RuntimeError> {
    let mut command = Command::new(shim.as_ref().unwrap_or(&runtime));
    if shim.is_some() {
        // Only components run below it here: what they cannot do needs no layer of the system.
        command.args([starter(), "--component".into(), "--".into()]).arg(&runtime);
    }
    let program = shim.unwrap_or(runtime);
    let failed = |source| RuntimeError::Start { program: program.clone(), source };
    let mut stdin = Stdio::null();
    if let Some(models) = models {
        // After the subcommand.
        arguments.insert(1, format!("--{PASSES_INFERENCE}").into());
        stdin = OwnedFd::from(models.stdin.try_clone().map_err(failed)?).into();
    }
    command
        .args(arguments)
        .stdin(stdin)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(failed)
}

/// Reads reports up to the result, which is the last; `None` if there is no result.
fn follow(reports: impl Read, bar: &ProgressBar) -> Result<Option<RuntimeResult>, RuntimeError> {
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
            Ok(Report::Summary(summary)) => return Ok(Some(RuntimeResult::Summary(summary))),
            Ok(Report::Separate { drives }) => return Ok(Some(RuntimeResult::Separate(drives))),
            Ok(Report::Checked(checked)) => return Ok(Some(RuntimeResult::Checked(checked))),
            Ok(Report::Verified(verified)) => return Ok(Some(RuntimeResult::Verified(verified))),
            // Reports of several passes, and live reports.
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

fn progress_bar() -> ProgressBar {
    // indicatif hides the bar if standard error is not a terminal.
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    let style = "{bar:30} {percent:>3} %  {human_pos} of {human_len} messages, {eta} left";
    bar.with_style(
        ProgressStyle::with_template(style).unwrap_or_else(|_| ProgressStyle::default_bar()),
    )
}

#[cfg(test)]
mod tests {
    use gleaner_supervisor::lines::REPORT_BYTES;

    use super::*;

    /// A stream that begins with `text` and never ends; counts the bytes read.
    struct Endless<'a> {
        text: &'a [u8],
        read: u64,
    }

    impl Read for Endless<'_> {
        fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
            assert!(self.read < 4 * REPORT_BYTES, "an endless line is held in memory");
            let n = match self.text.read(into)? {
                0 => io::repeat(b'x').read(into)?,
                n => n,
            };
            self.read += n as u64;
            Ok(n)
        }
    }

    #[test]
    fn an_endless_report_is_refused_and_not_held_in_memory() {
        let bar = ProgressBar::hidden();
        let progress = "{\"report\":\"progress\",\"done\":1,\"total\":2,\"at_ns\":0}\n";
        for text in ["", "\"", progress] {
            let endless = Endless { text: text.as_bytes(), read: 0 };
            let error = follow(endless, &bar).unwrap_err();
            assert!(error.to_string().contains("xxxx"), "{error}");
        }
        assert!(follow(&b""[..], &bar).unwrap().is_none());
    }
}
