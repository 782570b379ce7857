//! `gleaner run DIR`: supervises a lambda and its recorder until Ctrl-C, and prints their reports.
//!
//! A failed process is restarted with a growing delay. A first start that fails ends the run.

mod arguments;
mod process;
mod process_group;
mod report_stream;
mod screen;
mod summary;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::Limits;
use gleaner_lambda::{BuildDir, Manifest, Vehicle};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use self::process_group::{ProcessGroup, RunEnd};
use self::screen::Screen;
use self::summary::EarlierCounts;
use crate::args::RunArgs;

/// Delay before the first restart; it doubles with each further one.
const DELAY: Duration = Duration::from_secs(1);
/// Maximum delay, so that a broken deployment does not occupy a core with restarts.
const DELAY_MAX: Duration = Duration::from_secs(30);
/// Run time after which the delay is reset.
const HEALTHY: Duration = Duration::from_secs(60);
/// Interval of checks whether to stop.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Runs until a signal, or until the time is over.
pub(crate) fn run(args: &RunArgs) -> Result<Exit, Failure> {
    let build = BuildDir::check_fresh(&args.target.lambda)?;
    let manifest = Manifest::load(build.path())?;
    // Recorded topics need not be inputs, but only inputs state a maximum size.
    let sizes = manifest.inputs.iter().map(|input| input.max_size.bytes());
    let largest = (manifest.record.is_some() && !args.no_record).then(|| sizes.max().unwrap_or(0));
    let vehicle = args.target.vehicle.as_ref();
    let allowed = || {
        vehicle.map_or(Ok(Limits::MAX), |file| Vehicle::load(file).map(|vehicle| vehicle.limits))
    };
    let mut limits = allowed()?;
    let stop = stop_flag()?;
    let mut screen = Screen::new(args.stats, args.json);
    let offset_ns = clock_offset();
    let started = Instant::now();
    let mut delay = DELAY;
    let mut restarts = 0;
    let mut failures = Failures::default();
    let mut earlier = EarlierCounts::default();
    let is_over = || args.last.is_some_and(|seconds| started.elapsed().as_secs() >= seconds.into());
    loop {
        let time_left = args
            .last
            .map(|seconds| Duration::from_secs(seconds.into()).saturating_sub(started.elapsed()));
        let attempt_started = Instant::now();
        // The runtime reads the same file at each start and reports if it cannot be used. That does
        // not end the run.
        limits = allowed().unwrap_or(limits);
        let mut group = ProcessGroup::start(
            args,
            &mut screen,
            limits,
            largest,
            offset_ns,
            time_left,
            restarts,
        )?;
        match group.supervise(&mut screen, &stop)? {
            RunEnd::Complete(exit) => {
                earlier.complete(
                    group.last_status(),
                    group.recorder_status(),
                    &arguments::out(args),
                )?;
                return failures.end(exit);
            }
            // It has printed the cause. After a successful start it is restarted, since the cause
            // may be temporary, such as a network that is down.
            RunEnd::NotStarted(exit) if restarts == 0 => return Ok(exit),
            RunEnd::NotStarted(exit) => {
                failures.add("it could not start".to_owned(), exit == Exit::LambdaFaulted)
            }
            RunEnd::Broken { reason, faulted } => failures.add(reason, faulted),
        }
        earlier.add(group.last_status(), group.recorder_status(), group.has_lost_wake());
        restarts += 1;
        delay = if attempt_started.elapsed() >= HEALTHY { DELAY } else { delay };
        let reason = failures.reason.as_deref().unwrap_or_default();
        screen.warn(&format!("{reason}; restarting in {} s (restart {restarts})", delay.as_secs()));
        let until = Instant::now() + delay;
        let ends = || stop.load(Ordering::Relaxed) || is_over();
        while Instant::now() < until && !ends() {
            thread::sleep(POLL_INTERVAL);
        }
        if ends() {
            earlier.complete(None, None, &arguments::out(args))?;
            return failures.end(Exit::Ok);
        }
        delay = (delay * 2).min(DELAY_MAX);
    }
}

/// Failed processes of a run. A run with failures does not end with success, even if its last
/// process does.
#[derive(Default)]
struct Failures {
    /// Reason of the last failure.
    reason: Option<String>,
    times: u32,
    /// True if the lambda faulted in one of the processes.
    faulted: bool,
}

impl Failures {
    fn add(&mut self, reason: String, faulted: bool) {
        self.reason = Some(reason);
        self.times += 1;
        self.faulted |= faulted;
    }

    /// Returns the result of the run if its last process ended with `exit`.
    fn end(self, exit: Exit) -> Result<Exit, Failure> {
        match self.reason {
            _ if exit != Exit::Ok => Ok(exit),
            None => Ok(Exit::Ok),
            Some(_) if self.faulted => Ok(Exit::LambdaFaulted),
            Some(reason) => {
                let times = if self.times == 1 {
                    "once".to_owned()
                } else {
                    format!("{} times", self.times)
                };
                let mut failure = Failure::new(Exit::Internal, format!("a process failed {times}"));
                failure.causes = vec![reason];
                Err(failure.with_help(
                    "the results lack only the time between each failure and its restart",
                ))
            }
        }
    }
}

/// Returns a flag that is set by Ctrl-C, SIGTERM, and the end of the terminal.
fn stop_flag() -> Result<Arc<AtomicBool>, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&stop))
            .map_err(|error| Failure::caused_by(Exit::Internal, "cannot handle signals", &error))?;
    }
    Ok(stop)
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the exit code of a run with these failures, true for a fault, and this last exit
    /// code.
    fn end(faults: &[bool], exit: Exit) -> Exit {
        let mut failures = Failures::default();
        faults.iter().for_each(|faulted| failures.add("it ended".to_owned(), *faulted));
        failures.end(exit).unwrap_or_else(|failure| failure.exit)
    }

    #[test]
    fn a_run_with_failures_does_not_end_with_success() {
        assert_eq!(end(&[], Exit::Ok), Exit::Ok);
        assert_eq!(end(&[], Exit::LambdaFaulted), Exit::LambdaFaulted);
        assert_eq!(end(&[false], Exit::Ok), Exit::Internal);
        assert_eq!(end(&[true, false], Exit::Ok), Exit::LambdaFaulted);
        assert_eq!(end(&[false, false], Exit::LambdaFaulted), Exit::LambdaFaulted);
    }

    #[test]
    fn failures_are_counted_and_the_last_one_is_the_cause() {
        let mut failures = Failures::default();
        ["a disk", "a network"]
            .into_iter()
            .for_each(|reason| failures.add(reason.to_owned(), false));
        let failure = failures.end(Exit::Ok).unwrap_err().to_string();
        assert!(
            failure.contains("a process failed 2 times") && failure.contains("a network"),
            "{failure}"
        );
    }
}
