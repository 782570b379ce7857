//! The two threads beside the loop: one loads models, one runs them.

use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use rustix::event::{EventfdFlags, eventfd};

use crate::backend::Backends;
use crate::loader::{LoadDone, LoadJob, LoadLimits, ModelLoader};
use crate::running::{ModelWork, WorkKind, WorkNote};
use crate::worker::{ModelWorker, RunDone, WorkerRequest};

/// Stack of both threads: libraries follow graphs by recursion.
const STACK_BYTES: usize = 16 << 20;

pub(crate) enum ThreadResult {
    Loaded(LoadDone),
    Ran(RunDone),
}

/// The threads, as the loop uses them.
pub(crate) struct ModelThreads {
    loads: Sender<LoadJob>,
    runs: Sender<WorkerRequest>,
    results: Receiver<ThreadResult>,
    /// Readable when there is a result.
    wake: Arc<OwnedFd>,
    notes: [WorkNote; 2],
    threads: [JoinHandle<()>; 2],
}

/// Sends results, and wakes the loop.
#[derive(Clone)]
struct ResultSender {
    results: Sender<ThreadResult>,
    wake: Arc<OwnedFd>,
}

impl ResultSender {
    /// Returns whether the loop still receives results.
    fn send(&self, result: ThreadResult) -> bool {
        let is_sent = self.results.send(result).is_ok();
        // It fails only if 2^64 results wait.
        let _ = rustix::io::write(&*self.wake, &1_u64.to_ne_bytes());
        is_sent
    }
}

impl ModelThreads {
    /// Starts the threads. They note their work in `running`, and write engines to the folder
    /// `engines`, if there is one.
    pub(crate) fn start(
        backends: Backends,
        limits: LoadLimits,
        engines: Option<PathBuf>,
        running: Option<File>,
    ) -> io::Result<Self> {
        let running = running.map(Arc::new);
        let notes = [WorkKind::Load, WorkKind::Run].map(|it| WorkNote::new(it, running.clone()));
        let wake = Arc::new(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?);
        let (results_sender, results) = channel();
        let sender = ResultSender { results: results_sender, wake: Arc::clone(&wake) };
        let (loads, load_inbox) = channel::<LoadJob>();
        let (runs, run_inbox) = channel::<WorkerRequest>();
        let loader = ModelLoader { backends, limits, engines, note: notes[0].clone() };
        let mut worker = ModelWorker::new(notes[1].clone(), limits.run_max);
        let named = |name: &str| Builder::new().name(name.to_owned()).stack_size(STACK_BYTES);
        let load_sender = sender.clone();
        let load_thread = named("loader").spawn(move || {
            for job in load_inbox {
                if !load_sender.send(ThreadResult::Loaded(loader.load(&job))) {
                    return;
                }
            }
        })?;
        let run_thread = named("worker").spawn(move || {
            for request in run_inbox {
                let done = worker.handle(request);
                if done.is_some_and(|done| !sender.send(ThreadResult::Ran(done))) {
                    return;
                }
            }
        })?;
        Ok(Self { loads, runs, results, wake, notes, threads: [load_thread, run_thread] })
    }

    pub(crate) fn load(&self, job: LoadJob) {
        // A thread that has ended is found by `have_ended`.
        let _ = self.loads.send(job);
    }

    pub(crate) fn request(&self, request: WorkerRequest) {
        let _ = self.runs.send(request);
    }

    pub(crate) fn wake(&self) -> &OwnedFd {
        &self.wake
    }

    pub(crate) fn result(&self) -> Option<ThreadResult> {
        self.results.try_recv().ok()
    }

    /// Resets [`wake`](Self::wake). Call it before the results are taken.
    pub(crate) fn clear_wake(&self) {
        let _ = rustix::io::read(&*self.wake, &mut [0; 8]);
    }

    /// Returns whether a thread has ended, which is an error of this program.
    pub(crate) fn have_ended(&self) -> bool {
        self.threads.iter().any(JoinHandle::is_finished)
    }

    pub(crate) fn are_busy(&self) -> bool {
        self.notes.iter().any(WorkNote::is_busy)
    }

    pub(crate) fn overdue(&self, now: Instant) -> Option<ModelWork> {
        self.notes.iter().find_map(|note| note.overdue(now))
    }

    /// Waits until no model is in use, at most for `timeout`.
    pub(crate) fn wait_idle(&self, timeout: Duration) {
        let until = Instant::now() + timeout;
        while self.are_busy() && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}
