//! Starts and supervises the processes of one run.

use std::path::PathBuf;
use std::process::ExitStatus;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, safe_file};
use gleaner_lambda::manifest::Limits;
use gleaner_parts::Parts;
use gleaner_protocol::link::{AddLambda, ControlClient, LinkError, RecorderStatus};
use gleaner_protocol::{ExitRecord, LiveStatus};

use super::process::ChildProcess;
use super::report_stream::{ChildOutput, ReportStream};
use super::screen::Screen;
use super::{POLL_INTERVAL, arguments};
use crate::args::RunArgs;

/// Time to read the pipes after the end of all processes: processes that they left running may hold
/// the pipes open.
const DRAIN_TIMEOUT: Duration = Duration::from_millis(300);

/// Maximum number of queued outputs. Further reports stay in their pipe, and the writer counts
/// those that do not fit.
const QUEUE_LENGTH: usize = 16;

/// The end of a run.
pub(super) enum RunEnd {
    /// The run ended on request, or its time was over.
    Complete(Exit),
    /// The run could not start; a program has printed the cause.
    NotStarted(Exit),
    /// A process failed after the start.
    Broken {
        /// The failure.
        reason: String,
        /// True if the lambda had faulted before.
        faulted: bool,
    },
}

/// The lambda's process and the recorder.
pub(super) struct ProcessGroup {
    runtime: ChildProcess,
    exit_record: PathBuf,
    recorder: Option<(ChildProcess, ControlClient)>,
    stream: ReportStream,
    /// Time to run after it is ready; `None` for no limit.
    time_left: Option<Duration>,
}

impl ProcessGroup {
    /// Starts the processes. `limits` are the limits of this vehicle; `largest` is the largest
    /// recorded sample in bytes, `None` if nothing is recorded. `screen` shows why a recorder ended
    /// at its start.
    pub(super) fn start(
        args: &RunArgs,
        screen: &mut Screen,
        limits: Limits,
        largest: Option<u64>,
        offset_ns: i64,
        time_left: Option<Duration>,
        restarts: u32,
    ) -> Result<Self, Failure> {
        // Recorder and shim write into the folder before the runtime checks it.
        safe_file::refuse_linked(&arguments::out(args), &args.target.lambda)?;
        let parts = Parts::find()?;
        let (sender, output) = mpsc::sync_channel(QUEUE_LENGTH);
        let failed = |error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, "cannot connect lambda and recorder", error)
        };
        let mut recorder = None;
        let mut socket = None;
        if let Some(largest) = largest {
            let (mut control, stdin) = ControlClient::pair().map_err(|error| failed(&error))?;
            let line = arguments::recorder(args, largest, offset_ns);
            let process = ChildProcess::start(
                &parts,
                "gleaner-recorder",
                line,
                Some(stdin),
                None,
                ChildOutput::Recorder,
                &sender,
            )?;
            let add = AddLambda {
                lambda: args.target.lambda.clone(),
                remaps: arguments::remaps(args),
                most: limits,
                grants: Vec::new(),
            };
            match control.add(&add) {
                Ok(lambda_end) => socket = Some(lambda_end),
                Err(LinkError::Gone { .. }) => {
                    drop(sender);
                    return recorder_not_started(process, ReportStream::new(output), screen);
                }
                Err(error) => return Err(failed(&error)),
            }
            recorder = Some((process, control));
        }
        let line = arguments::runtime(args, socket.is_some(), offset_ns, restarts);
        let exit_record = arguments::out(args).join(ExitRecord::FILE);
        let shim = Some(arguments::shim(args, &exit_record, restarts));
        let runtime = ChildProcess::start(
            &parts,
            "gleaner-runtime",
            line,
            socket,
            shim,
            ChildOutput::Runtime,
            &sender,
        )?;
        Ok(Self { runtime, exit_record, recorder, stream: ReportStream::new(output), time_left })
    }

    /// Takes the last status of the lambda.
    pub(super) fn last_status(&mut self) -> Option<LiveStatus> {
        self.stream.last.take()
    }

    /// Takes the last status of the recorder.
    pub(super) fn recorder_status(&mut self) -> Option<Box<RecorderStatus>> {
        self.stream.recorder.take()
    }

    /// Returns whether the lambda's process ended during a wake.
    pub(super) fn has_lost_wake(&self) -> bool {
        self.stream.has_lost_wake
    }

    /// Shows the output of the processes until they end, and ends them when `stop` is set.
    pub(super) fn supervise(
        &mut self,
        screen: &mut Screen,
        stop: &AtomicBool,
    ) -> Result<RunEnd, Failure> {
        let Self { runtime, exit_record, recorder, stream, time_left } = self;
        let mut ready: Option<Instant> = None;
        let mut requested = false;
        let status = loop {
            stream.poll(screen, POLL_INTERVAL);
            ready = ready.or_else(|| stream.is_ready.then(Instant::now));
            let is_over =
                ready.zip(*time_left).is_some_and(|(ready, limit)| ready.elapsed() >= limit);
            if stop.load(Ordering::Relaxed) || is_over {
                requested = true;
                break runtime.end(stream, screen)?;
            }
            if let Some(status) = runtime.status()? {
                break status;
            }
            if let Some((recorder, _)) = recorder
                && let Some(status) = recorder.status()?
            {
                runtime.end(stream, screen)?;
                stream.drain(screen, DRAIN_TIMEOUT);
                return Ok(match status.code().and_then(Exit::from_code) {
                    // It has printed the cause.
                    Some(exit) if !stream.is_ready && exit != Exit::Ok => RunEnd::NotStarted(exit),
                    _ => RunEnd::Broken {
                        reason: ended("the recorder", status),
                        faulted: stream.has_faulted,
                    },
                });
            }
        };
        if let Some((recorder, control)) = recorder {
            // Fails if the recorder has ended meanwhile, and then has nothing to complete.
            let _ = control.stop();
            let status = recorder.wait(stream, screen)?;
            if !status.success() {
                screen.warn(&format!(
                    "{}: clips may be unfinished, and are recovered by the next run",
                    ended("the recorder", status)
                ));
            }
        }
        stream.drain(screen, DRAIN_TIMEOUT);
        let record = ExitRecord::read(exit_record).ok();
        // A lambda can end its process as if that had been requested. The shim records whether it
        // was requested, and in time.
        let requested = record.as_ref().map_or(requested, |record| record.end_requested);
        Ok(match status.code().and_then(Exit::from_code) {
            // Ended before it could handle the signal.
            None if requested && !stream.is_ready => RunEnd::Complete(Exit::Ok),
            Some(exit @ (Exit::Ok | Exit::LambdaFaulted)) if requested && stream.has_ended => {
                RunEnd::Complete(exit)
            }
            Some(exit) if !stream.is_ready && exit != Exit::Ok => RunEnd::NotStarted(exit),
            _ => {
                let reason = record.as_ref().and_then(ExitRecord::sentence);
                let faulted =
                    stream.has_faulted || record.is_some_and(|record| record.is_caused_by_lambda());
                let reason = reason.map_or_else(
                    || ended("the lambda's process", status),
                    |reason| format!("the lambda's process {reason}"),
                );
                RunEnd::Broken { reason, faulted }
            }
        })
    }
}

/// Shows why the recorder ended before it knew the lambda: it prints the cause.
fn recorder_not_started<T>(
    mut recorder: ChildProcess,
    mut stream: ReportStream,
    screen: &mut Screen,
) -> Result<T, Failure> {
    let status = recorder.wait(&mut stream, screen)?;
    stream.drain(screen, DRAIN_TIMEOUT);
    let exit = status.code().and_then(Exit::from_code).filter(|exit| *exit != Exit::Ok);
    let failure = Failure::new(exit.unwrap_or(Exit::Internal), ended("the recorder", status));
    Err(failure.with_help("see its message above; to run without clips: --no-record"))
}

fn ended(process: &str, status: ExitStatus) -> String {
    format!("{process} ended by itself ({status})")
}
