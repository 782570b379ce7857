//! The course of a replay in a worker: the lambda is woken as its schedule says, and nothing is
//! written.

use gleaner_base::Failure;
use gleaner_drives::{Replay, Step};
use gleaner_lambda::manifest::Manifest;

use super::Options;
use super::course::{self, Course, Span};
use super::open::open_drives;
use super::record::ReplayRecorder;
use crate::api::Session;
use crate::api::curves::Curves;
use crate::api::data::Wake;
use crate::guest::Totals;
use crate::guest::worker::Reports;
use crate::judge::Judge;
use crate::schedule::Schedule;
use crate::stage::{Bounds, Load, Stage};

/// Takes a lambda through its drives once, and sends the totals to `reports`. Its outcomes are sent
/// by the guest that `load` makes.
pub(super) fn work(
    options: &Options,
    is_recorded: bool,
    manifest: &Manifest,
    load: Load<'_>,
    reports: &Reports,
) -> Result<(), Failure> {
    let (mut drive, part) = open_drives(options)?;
    // The steps of a drive are those of all topics that are read, recorded ones included, and ticks
    // may be counted between them.
    let _recorded =
        if is_recorded { ReplayRecorder::subscribe(manifest, options, &mut drive)? } else { None };
    let Stage { inputs, session, mut guest } =
        Stage::set(&mut drive, &options.asked, manifest, Bounds::Replay, None, load)?;
    let curves = Curves::of(&inputs);
    if guest.init().is_err() {
        // The fault was sent.
        return Ok(());
    }
    session.take_log();
    let judge = Judge::new(session.clone(), guest);
    let mut pass = Pass { schedule: Schedule::new(manifest, &inputs), session, judge };
    let span = Span::of(&drive, part);
    course::take(&mut drive, span, &mut pass)?;
    reports.done(Totals::of(&inputs, &curves));
    Ok(())
}

struct Pass {
    schedule: Schedule,
    session: Session,
    judge: Judge,
}

impl Course for Pass {
    fn schedule(&mut self) -> &mut Schedule {
        &mut self.schedule
    }

    fn wake(&mut self, wake: Wake) -> Result<bool, Failure> {
        if !self.judge.is_backing_off(&wake) {
            self.judge.judge(wake);
            // It was sent.
            self.session.take_log();
        }
        Ok(true)
    }

    fn sample(&mut self, _: &Replay, _: &Step) -> Result<(), Failure> {
        Ok(())
    }
}
