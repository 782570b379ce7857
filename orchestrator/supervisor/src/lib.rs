//! Starts and supervises the processes that run lambdas on a vehicle: an ingress, a recorder, a
//! process for models, and one for each lambda. `gleaner run` and `gleaner-supervisor` use it.
//!
//! - `spec`: what a run consists of. `observer`: its events, for those who watch it.
//! - `grants`, `arguments`: topics and arguments of the processes.
//! - `process`, `output`, `lines`, `byte_rate`: one process, and the threads that read its output.
//! - `ingress`, `recorder`, `inference`: the processes that all lambdas share, each over its
//!   restarts (`service_restarts`). `last_error`: the reason of an end. `farewell`: the end of the
//!   ingress, as other nodes see it.
//! - `supervised`: one lambda over all its restarts, with `summary`, `recent_wakes` and
//!   `revision_check`, which compares its files with their signature.
//! - `process_group`: all processes, and `drive`: a drive that the ingress plays.
//! - `failures`: the result of a run in which processes failed.
//! - `service`: the program `gleaner-supervisor`, with `reconcile`, `event_log` and `installation`:
//!   the programs on the disk, which an upgrade replaces.
//! - `wheels`: Python environments of deployed lambdas.
//!
//! A failed process is restarted alone, with a growing delay (`restart_delay`); the others receive
//! a connection to the next one, and lambdas decide without a recorder meanwhile. A first start
//! that fails ends the run, unless it is that of one lambda of several, or the run is a vehicle's.

mod arguments;
mod byte_rate;
mod drive;
mod event_log;
mod failures;
mod farewell;
mod grants;
mod inference;
mod ingress;
mod installation;
mod last_error;
pub mod lines;
mod observer;
mod output;
mod process;
mod process_group;
mod recent_wakes;
mod reconcile;
mod recorder;
mod restart_delay;
mod revision_check;
pub mod service;
mod service_restarts;
mod spec;
mod summary;
mod supervised;
pub mod wheels;

use std::ffi::OsString;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure};
use gleaner_lambda::Vehicle;

pub use event_log::EventLog;
use failures::Failures;
pub use inference::{InferenceEvent, InferenceService, InferenceUse};
pub use observer::{RestartedPart, RunObserver};
use process_group::{GroupEnd, ProcessGroup, RunRecord};
pub use reconcile::{Action, KnownLambda, reconcile};
use restart_delay::RestartDelay;
pub use spec::{ClipSigning, LambdaSpec, RunSpec};
use summary::RunCounts;
use supervised::SupervisedLambda;

/// Returns the argument that makes `gleaner-shim` end its runtime when this process dies.
pub fn starter() -> OsString {
    format!("--starter={}", std::process::id()).into()
}

/// Interval of checks whether to stop.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

struct RunContext<'a> {
    spec: &'a RunSpec,
    parts: InstalledPrograms,
    /// Offset of the vehicle's clock to CLOCK_MONOTONIC, in ns.
    offset_ns: i64,
}

/// The time of a run, which may be limited.
struct RunTime {
    limit: Option<Duration>,
    started: Instant,
    /// Set once all lambdas are ready for the first time.
    ready: Option<Instant>,
}

impl RunTime {
    fn begin(&mut self) {
        self.ready.get_or_insert_with(Instant::now);
    }

    /// Returns whether the time since the lambdas were ready is over.
    fn is_over(&self) -> bool {
        self.ready.zip(self.limit).is_some_and(|(ready, limit)| ready.elapsed() >= limit)
    }

    fn is_over_since_start(&self) -> bool {
        self.limit.is_some_and(|limit| self.started.elapsed() >= limit)
    }
}

/// Runs lambdas until `stop` is set, until the time is over, or until the end of the drive; returns
/// the exit code of the run. Results are in the folders of `lambdas`.
///
/// # Errors
///
/// A failure if a process cannot be started, if one of them failed and was started again, or if
/// results cannot be written. A lambda that could not start has printed the cause, and its exit
/// code is returned.
pub fn run(
    lambdas: Vec<LambdaSpec>,
    spec: &RunSpec,
    observer: &mut dyn RunObserver,
    stop: &AtomicBool,
) -> Result<Exit, Failure> {
    let mut lambdas: Vec<_> = lambdas.into_iter().map(SupervisedLambda::new).collect();
    let allowed = || spec.vehicle.as_ref().map_or(Ok(Vehicle::default()), Vehicle::load);
    let mut vehicle = allowed()?;
    let context = RunContext { spec, parts: InstalledPrograms::find()?, offset_ns: clock_offset() };
    let mut time = RunTime { limit: spec.duration, started: Instant::now(), ready: None };
    let mut delay = RestartDelay::new();
    let mut restarts = 0;
    let mut failures = Failures::default();
    let mut counts = RunCounts::default();
    let mut cut_short = None;
    loop {
        let attempt_started = Instant::now();
        // The runtimes read the same file at each start and report if it cannot be used. That does
        // not end the run.
        vehicle = allowed().unwrap_or(vehicle);
        let run = RunRecord { failures: &mut failures, counts: &mut counts };
        let mut group = ProcessGroup::start(&context, &mut lambdas, observer, run, &vehicle)?;
        let ended = group.run(|group| group.supervise(&mut time, stop));
        group.add_counts();
        let reason = match ended? {
            GroupEnd::Complete => break,
            // It has printed the cause. After a successful start it is restarted, since the cause
            // may be temporary, such as a network that is down.
            GroupEnd::NotStarted(exit) if restarts == 0 => return Ok(exit),
            GroupEnd::NotStarted(_) => "it could not start".to_owned(),
            GroupEnd::Broken(reason) => reason,
        };
        // It would be played again from its start, to lambdas that have seen a part of it.
        if !spec.drives.is_empty() {
            let mut failure = Failure::new(Exit::Internal, "the drive was not played to its end");
            failure.causes = vec![reason];
            cut_short = Some(failure);
            break;
        }
        failures.add(reason.clone(), false);
        restarts += 1;
        let delay = delay.after(attempt_started.elapsed());
        observer.restarts(RestartedPart::All, &reason, delay, restarts);
        let until = Instant::now() + delay;
        let ends = || stop.load(Ordering::Relaxed) || time.is_over_since_start();
        while Instant::now() < until && !ends() {
            thread::sleep(POLL_INTERVAL);
        }
        if ends() {
            break;
        }
    }
    let exits = lambdas.iter().map(SupervisedLambda::exit);
    let exit = exits.reduce(|first, next| if first == Exit::Ok { next } else { first });
    for lambda in lambdas {
        lambda.complete(&counts)?;
    }
    cut_short.map_or_else(|| failures.end(exit.unwrap_or(Exit::Ok)), Err)
}

/// Returns the offset of the vehicle's clock to CLOCK_MONOTONIC, in ns. The vehicle's clock shows
/// the current time of day, and never jumps afterwards.
fn clock_offset() -> i64 {
    use rustix::time::{ClockId, clock_gettime};
    let ns = |clock| {
        let now = clock_gettime(clock);
        now.tv_sec.saturating_mul(1_000_000_000).saturating_add(now.tv_nsec)
    };
    ns(ClockId::Realtime).saturating_sub(ns(ClockId::Monotonic))
}
