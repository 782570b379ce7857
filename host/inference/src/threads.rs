//! The threads beside the loop: one loads models, the others run them.

use std::collections::HashMap;
use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_protocol::inference::MODEL_WORKERS;
use rustix::event::{EventfdFlags, eventfd};

use crate::backend::Backends;
use crate::loader::{LoadDone, LoadJob, LoadLimits, ModelLoader};
use crate::running::{ModelWork, WorkNote};
use crate::sessions::SessionId;
use crate::worker::{ModelWorker, RunDone, RunJob, SharedModel, WorkerModel};

/// Stack of each thread: libraries follow graphs by recursion.
const STACK_BYTES: usize = 16 << 20;

pub(crate) enum ThreadResult {
    Loaded(LoadDone),
    Ran(RunDone),
}

pub(crate) struct ModelThreads {
    loads: Sender<LoadJob>,
    runs: Sender<RunJob>,
    models: HashMap<SessionId, SharedModel>,
    results: Receiver<ThreadResult>,
    /// Readable when there is a result.
    wake: Arc<OwnedFd>,
    notes: Vec<WorkNote>,
    threads: Vec<JoinHandle<()>>,
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
        let notes: Vec<WorkNote> =
            (0..=MODEL_WORKERS).map(|place| WorkNote::new(place, running.clone())).collect();
        let wake = Arc::new(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?);
        let (results_sender, results) = channel();
        let sender = ResultSender { results: results_sender, wake: Arc::clone(&wake) };
        let named = |name: &str| Builder::new().name(name.to_owned()).stack_size(STACK_BYTES);
        let (loads, load_inbox) = channel::<LoadJob>();
        let (runs, run_inbox) = channel::<RunJob>();
        let loader = ModelLoader { backends, limits, engines, note: notes[0].clone() };
        let load_sender = sender.clone();
        let mut threads = vec![named("loader").spawn(move || {
            for job in load_inbox {
                if !load_sender.send(ThreadResult::Loaded(loader.load(&job))) {
                    return;
                }
            }
        })?];
        // An idle thread holds the lock while it waits for a job.
        let run_inbox = Arc::new(Mutex::new(run_inbox));
        for note in &notes[1..] {
            let (inbox, sender) = (Arc::clone(&run_inbox), sender.clone());
            let worker = ModelWorker::new(note.clone(), limits.run_max);
            let next = move || inbox.lock().unwrap_or_else(PoisonError::into_inner).recv();
            threads.push(named("worker").spawn(move || {
                while let Ok(job) = next()
                    && sender.send(ThreadResult::Ran(worker.run(&job)))
                {}
            })?);
        }
        Ok(Self { loads, runs, models: HashMap::new(), results, wake, notes, threads })
    }

    pub(crate) fn load(&self, job: LoadJob) {
        // A thread that has ended is found by `have_ended`.
        let _ = self.loads.send(job);
    }

    pub(crate) fn add_model(&mut self, session: SessionId, model: WorkerModel) {
        self.models.insert(session, Arc::new(Mutex::new(model)));
    }

    pub(crate) fn model(&self, session: SessionId) -> Option<SharedModel> {
        self.models.get(&session).map(Arc::clone)
    }

    pub(crate) fn remove_model(&mut self, session: SessionId) {
        let model = self.models.remove(&session);
        // A large one takes a while to be removed from memory.
        let _ = Builder::new().spawn(move || drop(model));
    }

    pub(crate) fn run(&self, job: RunJob) {
        let _ = self.runs.send(job);
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
