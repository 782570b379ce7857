//! Runs a lambda over its drives in a worker, which writes no results.

use gleaner_base::Failure;
use gleaner_drives::{Replay, ReplayStep};
use gleaner_lambda::manifest::Manifest;

use super::drive_loop::{self, DriveHandler, DriveSpan};
use super::open::open_drives;
use super::options::ReplayOptions;
use super::record::ReplayRecorder;
use crate::api::Session;
use crate::api::data::{Wake, record_curves};
use crate::guest::Totals;
use crate::guest::worker::MessageSender;
use crate::invoker::Invoker;
use crate::schedule::WakeSchedule;
use crate::session_setup::{Load, RunMode, SessionSetup};

/// Runs a lambda over its drives once, and sends the totals to `reports`. The guest that `load`
/// creates sends the outcomes of its wakes.
pub(super) fn run(
    options: &ReplayOptions,
    is_recorded: bool,
    manifest: &Manifest,
    load: Load<'_>,
    reports: &MessageSender,
) -> Result<(), Failure> {
    let (mut drive, part) = open_drives(options)?;
    // The steps of a drive are those of all topics that are read, including recorded ones, and
    // ticks may fall between them.
    let _recorded =
        if is_recorded { ReplayRecorder::subscribe(manifest, options, &mut drive)? } else { None };
    let SessionSetup { inputs, session, mut guest } =
        SessionSetup::load(&mut drive, &options.lambda, manifest, RunMode::Replay, load)?;
    let curves = record_curves(&inputs);
    if guest.init().is_err() {
        // The guest has sent the fault.
        return Ok(());
    }
    session.take_log();
    let invoker = Invoker::new(session.clone(), guest);
    let mut worker_loop =
        WorkerLoop { schedule: WakeSchedule::new(manifest, &inputs), session, invoker };
    let span = DriveSpan::of(&drive, part);
    drive_loop::run(&mut drive, span, &mut worker_loop)?;
    reports.done(Totals::of(&inputs, &curves));
    Ok(())
}

struct WorkerLoop {
    schedule: WakeSchedule,
    session: Session,
    invoker: Invoker,
}

impl DriveHandler for WorkerLoop {
    fn schedule(&mut self) -> &mut WakeSchedule {
        &mut self.schedule
    }

    fn wake(&mut self, wake: Wake) -> Result<bool, Failure> {
        if !self.invoker.is_backing_off(&wake) {
            self.invoker.invoke(wake);
            // The guest has sent the log.
            self.session.take_log();
        }
        Ok(true)
    }

    fn sample(&mut self, _: &Replay, _: &ReplayStep) -> Result<(), Failure> {
        Ok(())
    }
}
