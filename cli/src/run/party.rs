//! The processes of one run, from their start to their end.

use std::path::PathBuf;
use std::process::ExitStatus;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, own_file};
use gleaner_lambda::manifest::Limits;
use gleaner_parts::Parts;
use gleaner_protocol::link::{Add, Control, RecorderStatus};
use gleaner_protocol::{ExitRecord, Live};

use super::ear::{Ear, Heard};
use super::process::Process;
use super::screen::Screen;
use super::{LOOK, arguments};
use crate::args::RunArgs;

/// How long after the end of all processes their streams may still bring something: what they left
/// running may hold them open.
const REST: Duration = Duration::from_millis(300);

/// Reports that may wait to be shown. Beyond that they stay in their pipe, and whoever writes them
/// counts what does not go in.
const UNHEARD: usize = 16;

/// How a run ended.
pub(super) enum Ended {
    /// It was told to, or its time was over.
    Well(Exit),
    /// It could not start, and has said why.
    Never(Exit),
    /// It broke after it had started.
    Broken {
        /// What broke.
        why: String,
        /// Whether the lambda had faulted before.
        faulted: bool,
    },
}

/// A lambda's process, and its recorder's.
pub(super) struct Party {
    runtime: Process,
    exit_record: PathBuf,
    recorder: Option<(Process, Control)>,
    ear: Ear,
    /// How long it is to run, once it is ready.
    left: Option<Duration>,
}

impl Party {
    /// Starts them. `most` are the limits of this vehicle; `largest` is the largest sample that is
    /// recorded, in bytes; none if nothing is.
    pub(super) fn start(
        args: &RunArgs,
        most: Limits,
        largest: Option<u64>,
        offset_ns: i64,
        left: Option<Duration>,
        restarts: u32,
    ) -> Result<Self, Failure> {
        // Recorder and shim write there before the runtime looks.
        own_file::real_place(&arguments::out(args), &args.asked.lambda)?;
        let parts = Parts::find()?;
        let (say, heard) = mpsc::sync_channel(UNHEARD);
        let failed = |error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Internal, "cannot connect lambda and recorder", error)
        };
        let mut recorder = None;
        let mut socket = None;
        if let Some(largest) = largest {
            let (mut control, stdin) = Control::pair().map_err(|error| failed(&error))?;
            let line = arguments::recorder(args, largest, offset_ns);
            let process = Process::start(
                &parts,
                "gleaner-recorder",
                line,
                Some(stdin),
                None,
                Heard::Recorder,
                &say,
            )?;
            let add =
                Add { lambda: args.asked.lambda.clone(), remaps: arguments::remaps(args), most };
            socket = Some(control.add(&add).map_err(|error| failed(&error))?);
            recorder = Some((process, control));
        }
        let line = arguments::runtime(args, socket.is_some(), offset_ns, restarts);
        let exit_record = arguments::out(args).join(ExitRecord::FILE);
        let shim = Some(arguments::shim(args, &exit_record, restarts));
        let runtime =
            Process::start(&parts, "gleaner-runtime", line, socket, shim, Heard::Runtime, &say)?;
        Ok(Self { runtime, exit_record, recorder, ear: Ear::new(heard), left })
    }

    /// What the lambda's process counted, as it said last.
    pub(super) fn last(&mut self) -> Option<Live> {
        self.ear.last.take()
    }

    /// What the recorder counted, as it said last.
    pub(super) fn recorded(&mut self) -> Option<Box<RecorderStatus>> {
        self.ear.recorded.take()
    }

    /// Whether a wake ended with the lambda's process.
    pub(super) fn has_lost_wake(&self) -> bool {
        self.ear.has_lost_wake
    }

    /// Shows what they report until they end, which they do when `stop` is raised.
    pub(super) fn attend(
        &mut self,
        screen: &mut Screen,
        stop: &AtomicBool,
    ) -> Result<Ended, Failure> {
        let Self { runtime, exit_record, recorder, ear, left } = self;
        let mut ready: Option<Instant> = None;
        let mut asked = false;
        let status = loop {
            ear.look(screen, LOOK);
            ready = ready.or_else(|| ear.is_ready.then(Instant::now));
            let is_over = ready.zip(*left).is_some_and(|(ready, left)| ready.elapsed() >= left);
            if stop.load(Ordering::Relaxed) || is_over {
                asked = true;
                break runtime.end(ear, screen)?;
            }
            if let Some(status) = runtime.status()? {
                break status;
            }
            if let Some((recorder, _)) = recorder
                && let Some(status) = recorder.status()?
            {
                runtime.end(ear, screen)?;
                ear.listen(screen, REST);
                return Ok(match status.code().and_then(Exit::from_code) {
                    // It has said why.
                    Some(exit) if !ear.is_ready && exit != Exit::Ok => Ended::Never(exit),
                    _ => Ended::Broken {
                        why: in_words("the recorder", status),
                        faulted: ear.has_faulted,
                    },
                });
            }
        };
        if let Some((recorder, control)) = recorder {
            // One that has gone meanwhile has nothing left to complete.
            let _ = control.stop();
            let status = recorder.wait(ear, screen)?;
            if !status.success() {
                screen.warn(&format!(
                    "{}: clips may be unfinished, and are recovered by the next run",
                    in_words("the recorder", status)
                ));
            }
        }
        ear.listen(screen, REST);
        let record = ExitRecord::read(exit_record).ok();
        // A lambda can have its own process end as if that had been requested. The shim knows
        // whether it was, and whether in time.
        let asked = record.as_ref().map_or(asked, |record| record.asked);
        Ok(match status.code().and_then(Exit::from_code) {
            // Told to end before it could listen for that.
            None if asked && !ear.is_ready => Ended::Well(Exit::Ok),
            Some(exit @ (Exit::Ok | Exit::LambdaFaulted)) if asked && ear.has_ended => {
                Ended::Well(exit)
            }
            Some(exit) if !ear.is_ready && exit != Exit::Ok => Ended::Never(exit),
            _ => {
                let why = record.as_ref().and_then(ExitRecord::sentence);
                let faulted =
                    ear.has_faulted || record.is_some_and(|record| record.is_the_lambdas());
                let why = why.map_or_else(
                    || in_words("the lambda's process", status),
                    |why| format!("the lambda's process {why}"),
                );
                Ended::Broken { why, faulted }
            }
        })
    }
}

fn in_words(who: &str, status: ExitStatus) -> String {
    format!("{who} ended by itself ({status})")
}
