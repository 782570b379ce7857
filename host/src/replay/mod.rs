//! A built lambda over recorded drives: the very same artifact as on the vehicle, pulled as fast as
//! the machine goes.
//!
//! Time is the drive's. A sample is delivered, the lambda runs if its schedule says so, then the
//! next: nothing is skipped, and nothing depends on how fast the machine is.

mod chosen;
mod course;
mod digests;
mod hold;
mod inspect;
mod journal_file;
mod open;
mod options;
mod packed;
mod part;
mod pictures;
mod record;
mod round;
mod signals;
mod verify;
mod work;

pub use inspect::{InspectArgs, inspect};
pub use options::{Job, Options, ReplayArgs, VerifyArgs};
pub use packed::{Packed, UnpackedArgs};

use std::io::Write;

use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::Manifest;
use gleaner_protocol::Report;

use self::hold::Hold;
use self::options::{Results, Task};
use self::round::Ended;
use crate::guest::worker::Reports;
use crate::stage::Load;

/// What the times of a replay are.
const CLOCK: &str = crate::journal::CLOCK_OF_DRIVE;

impl Job {
    /// Does it, and writes reports to `reports`.
    ///
    /// For a replay, the exit is [`Exit::DriveDamaged`] if the drive ended in damage, or
    /// [`Exit::Internal`] if it could not be read further (results up to there are kept); else
    /// [`Exit::LambdaFaulted`] if a wake faulted, else [`Exit::Ok`].
    ///
    /// # Errors
    ///
    /// A failure if it cannot start, or results cannot be written; of a comparison, the first
    /// difference.
    pub fn run(self, load: Load<'_>, reports: &mut dyn Write) -> Result<Exit, Failure> {
        let Self { options, manifest, task } = self;
        match task {
            Task::Replay(results) => replay(&options, &results, &manifest, load, reports),
            Task::Verify(mut claim) => {
                let verified = verify::run(&options, &manifest, &mut claim, load)?;
                report(reports, &Report::Verified(verified));
                Ok(Exit::Ok)
            }
        }
    }

    /// Does what a worker has to do for it: the guest that `load` makes sends the outcome of each
    /// wake, and the rest goes to `reports`.
    ///
    /// # Errors
    ///
    /// A failure if it cannot start. What is found wrong later, the process that reads the outcomes
    /// finds as well.
    pub fn work(self, load: Load<'_>, reports: &Reports) -> Result<Exit, Failure> {
        let Self { options, manifest, task } = self;
        match task {
            Task::Replay(results) => {
                work::work(&options, results.record, &manifest, load, reports)?
            }
            // Over a drive the schedule leads, whatever the journal holds; in a clip, the journal.
            Task::Verify(claim) if claim.clip.is_none() => {
                work::work(&options, false, &manifest, load, reports)?
            }
            Task::Verify(mut claim) => drop(verify::run(&options, &manifest, &mut claim, load)?),
        }
        Ok(Exit::Ok)
    }
}

fn replay(
    options: &Options,
    results: &Results,
    manifest: &Manifest,
    load: Load<'_>,
    reports: &mut dyn Write,
) -> Result<Exit, Failure> {
    let _hold = Hold::take(&results.out)?;
    let mut n = 1;
    let Ended { summary, broken, incomplete } = loop {
        let ended = round::replay(options, results, manifest, &mut *load, reports, n == 1)?;
        if results.repeat > 1 {
            report(reports, &Report::Round(round::report(n, &ended.summary)));
        }
        if n >= results.repeat {
            break ended;
        }
        n += 1;
    };
    let faulted = if summary.faults > 0 { Exit::LambdaFaulted } else { Exit::Ok };
    let exit = broken.unwrap_or(faulted);
    report(reports, &Report::Summary(Box::new(summary)));
    let Some(error) = incomplete else { return Ok(exit) };
    let failure = Failure::from(error);
    Err(Failure { exit: if exit == Exit::Ok { failure.exit } else { exit }, ..failure })
}

/// Whoever listens may have gone; the results are in files.
fn report(reports: &mut dyn Write, report: &Report) {
    if let Ok(mut line) = serde_json::to_string(report) {
        line.push('\n');
        let _ = reports.write_all(line.as_bytes());
    }
}
