//! Replays recorded drives to a built lambda: the same artifact as on the vehicle, as fast as the
//! machine allows.
//!
//! Time is the drive's. Each sample is delivered and the lambda runs if its schedule requests it,
//! then the next: nothing is skipped, and nothing depends on the speed of the machine.

mod digests;
mod drive_loop;
mod inspect;
mod journal_file;
mod open;
mod options;
mod packed;
mod pictures;
mod record;
mod round;
mod signals;
mod time_range;
mod topic_filter;
mod verify;
mod worker_loop;

pub use inspect::{InspectArgs, inspect};
pub use options::{ReplayArgs, ReplayJob, ReplayOptions, VerifyArgs};
pub use packed::{Packed, UnpackedArgs};

use std::io::Write;

use gleaner_base::{Exit, Failure};
use gleaner_drives::ReplayError;
use gleaner_lambda::OutputLock;
use gleaner_lambda::manifest::Manifest;
use gleaner_protocol::Report;

use self::open::DriveError;
use self::options::{Results, Task};
use self::round::ReplayOutcome;
use crate::guest::worker::MessageSender;
use crate::session_setup::Load;

/// Clock of the times of a replay.
const CLOCK: &str = crate::journal::CLOCK_OF_DRIVE;

impl ReplayJob {
    /// Runs the replay or the comparison, and writes reports to `reports`.
    ///
    /// For a replay, the exit is [`Exit::DriveDamaged`] if the drive is damaged, or
    /// [`Exit::Internal`] if it could not be read in full (results of what was read are kept); else
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
            Task::Verify(mut reference) => {
                let verified = verify::run(&options, &manifest, &mut reference, load)?;
                report(reports, &Report::Verified(verified));
                Ok(Exit::Ok)
            }
        }
    }

    /// Runs the worker's part: the guest that `load` creates sends the outcome of each wake, and
    /// the rest goes to `reports`.
    ///
    /// # Errors
    ///
    /// A failure if it cannot start. The process that reads the outcomes finds later errors itself.
    pub fn work(self, load: Load<'_>, reports: &MessageSender) -> Result<Exit, Failure> {
        let Self { options, manifest, task } = self;
        match task {
            Task::Replay(results) => {
                worker_loop::run(&options, results.record, &manifest, load, reports)?
            }
            // Over a drive, the schedule decides on the wakes; in a clip, the journal.
            Task::Verify(reference) if reference.clip.is_none() => {
                worker_loop::run(&options, false, &manifest, load, reports)?
            }
            Task::Verify(mut reference) => {
                drop(verify::run(&options, &manifest, &mut reference, load)?)
            }
        }
        Ok(Exit::Ok)
    }
}

fn replay(
    options: &ReplayOptions,
    results: &Results,
    manifest: &Manifest,
    load: Load<'_>,
    reports: &mut dyn Write,
) -> Result<Exit, Failure> {
    let _hold = OutputLock::take(&results.out)?;
    let mut n = 1;
    let ReplayOutcome { summary, broken, incomplete } = loop {
        let drive = match open::open(options) {
            // The caller replays them one by one.
            Err(ReplayError::Separate { drives })
                if results.journal.is_none() && open::are_text(&drives) =>
            {
                report(reports, &Report::Separate { drives });
                return Ok(Exit::Ok);
            }
            drive => drive.map_err(DriveError)?,
        };
        let ended = round::replay(drive, options, results, manifest, &mut *load, reports, n == 1)?;
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

/// Writes a report. Errors are ignored: the reader may have ended, and the results are in files.
fn report(reports: &mut dyn Write, report: &Report) {
    if let Ok(mut line) = serde_json::to_string(report) {
        line.push('\n');
        let _ = reports.write_all(line.as_bytes());
    }
}
