//! `gleaner run DIR`: keeps a lambda and its recorder going until ctrl-C, and shows what they
//! report.
//!
//! A process that breaks is started again, a little later each time; one that could not even start
//! is not.

mod arguments;
mod ear;
mod party;
mod process;
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

use self::party::{Ended, Party};
use self::screen::Screen;
use self::summary::Earlier;
use crate::args::RunArgs;

/// The first pause before a new start; each further one is twice as long.
const PAUSE: Duration = Duration::from_secs(1);
/// The longest pause: a broken deployment must not occupy a core with restarts.
const PAUSE_MAX: Duration = Duration::from_secs(30);
/// What ran for so long is taken for sound: its end counts as the first.
const SOUND: Duration = Duration::from_secs(60);
/// How often somebody looks whether it is time to stop.
const LOOK: Duration = Duration::from_millis(100);

/// Runs until it is told to stop, or until the time is over.
pub(crate) fn run(args: &RunArgs) -> Result<Exit, Failure> {
    let build = BuildDir::check_fresh(&args.asked.lambda)?;
    let manifest = Manifest::load(build.path())?;
    // Recorded topics need not be inputs; what is known of the largest message is what the inputs
    // say.
    let sizes = manifest.inputs.iter().map(|input| input.max_size.bytes());
    let largest = (manifest.record.is_some() && !args.no_record).then(|| sizes.max().unwrap_or(0));
    let vehicle = args.asked.vehicle.as_ref();
    let allowed = || {
        vehicle.map_or(Ok(Limits::MOST), |file| Vehicle::load(file).map(|vehicle| vehicle.limits))
    };
    let mut most = allowed()?;
    let stop = stop_flag()?;
    let mut screen = Screen::new(args.stats, args.json);
    let offset_ns = clock_offset();
    let started = Instant::now();
    let mut pause = PAUSE;
    let mut restarts = 0;
    let mut broken = Broken::default();
    let mut earlier = Earlier::default();
    let is_over = || args.last.is_some_and(|seconds| started.elapsed().as_secs() >= seconds.into());
    loop {
        let left = args
            .last
            .map(|seconds| Duration::from_secs(seconds.into()).saturating_sub(started.elapsed()));
        let begun = Instant::now();
        // The runtime reads the same file at each start, and reports one that cannot be used: that
        // is no reason to end a run.
        most = allowed().unwrap_or(most);
        let mut party = Party::start(args, most, largest, offset_ns, left, restarts)?;
        match party.attend(&mut screen, &stop)? {
            Ended::Well(exit) => {
                earlier.complete(party.last(), party.recorded(), &arguments::out(args))?;
                return broken.end(exit);
            }
            // It has said why. What ran before may run again: a network may be down for a while.
            Ended::Never(exit) if restarts == 0 => return Ok(exit),
            Ended::Never(exit) => {
                broken.add("it could not start".to_owned(), exit == Exit::LambdaFaulted)
            }
            Ended::Broken { why, faulted } => broken.add(why, faulted),
        }
        earlier.add(party.last(), party.recorded(), party.has_lost_wake());
        restarts += 1;
        pause = if begun.elapsed() >= SOUND { PAUSE } else { pause };
        let why = broken.why.as_deref().unwrap_or_default();
        screen
            .warn(&format!("{why}; starting again in {} s (restart {restarts})", pause.as_secs()));
        let until = Instant::now() + pause;
        let ends = || stop.load(Ordering::Relaxed) || is_over();
        while Instant::now() < until && !ends() {
            thread::sleep(LOOK);
        }
        if ends() {
            earlier.complete(None, None, &arguments::out(args))?;
            return broken.end(Exit::Ok);
        }
        pause = (pause * 2).min(PAUSE_MAX);
    }
}

/// Processes of a run that broke. Whether the run ends while one works, or in the pause before the
/// next, it did not go well.
#[derive(Default)]
struct Broken {
    /// Why the last one did.
    why: Option<String>,
    times: u32,
    /// A fault stays one, though the process that had it was replaced.
    faulted: bool,
}

impl Broken {
    fn add(&mut self, why: String, faulted: bool) {
        self.why = Some(why);
        self.times += 1;
        self.faulted |= faulted;
    }

    /// How the run ends whose last process ended with `exit`.
    fn end(self, exit: Exit) -> Result<Exit, Failure> {
        match self.why {
            _ if exit != Exit::Ok => Ok(exit),
            None => Ok(Exit::Ok),
            Some(_) if self.faulted => Ok(Exit::LambdaFaulted),
            Some(why) => {
                let times = if self.times == 1 {
                    "once".to_owned()
                } else {
                    format!("{} times", self.times)
                };
                let mut failure = Failure::new(Exit::Internal, format!("the run broke {times}"));
                failure.causes = vec![why];
                Err(failure.with_help(
                    "results are whole but for what happened between an end and the next start",
                ))
            }
        }
    }
}

/// Raised by ctrl-C, SIGTERM, and the end of the terminal.
fn stop_flag() -> Result<Arc<AtomicBool>, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).map_err(|error| {
            Failure::caused_by(Exit::Internal, "cannot listen for signals", &error)
        })?;
    }
    Ok(stop)
}

/// How far the vehicle's clock is ahead of CLOCK_MONOTONIC, in ns: it shows the time of day now,
/// and never jumps afterwards.
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

    /// How a run ends in which these processes broke, and whose last one ended so.
    fn end(broke: &[bool], exit: Exit) -> Exit {
        let mut broken = Broken::default();
        broke.iter().for_each(|faulted| broken.add("it ended".to_owned(), *faulted));
        broken.end(exit).unwrap_or_else(|failure| failure.exit)
    }

    #[test]
    fn a_run_in_which_a_process_broke_never_ends_as_if_none_had() {
        assert_eq!(end(&[], Exit::Ok), Exit::Ok);
        assert_eq!(end(&[], Exit::LambdaFaulted), Exit::LambdaFaulted);
        assert_eq!(end(&[false], Exit::Ok), Exit::Internal);
        assert_eq!(end(&[true, false], Exit::Ok), Exit::LambdaFaulted);
        assert_eq!(end(&[false, false], Exit::LambdaFaulted), Exit::LambdaFaulted);
    }

    #[test]
    fn how_often_a_run_broke_and_why_is_told() {
        let mut broken = Broken::default();
        ["a disk", "a network"].into_iter().for_each(|why| broken.add(why.to_owned(), false));
        let failure = broken.end(Exit::Ok).unwrap_err().to_string();
        assert!(
            failure.contains("the run broke 2 times") && failure.contains("a network"),
            "{failure}"
        );
    }
}
