//! The loop over a drive: delivers every sample and runs every wake that the schedule requests, in
//! the drive's time.

use gleaner_base::Failure;
use gleaner_drives::{Replay, ReplayError, ReplayStep};
use gleaner_journal::TimeRange;

use crate::api::data::Wake;
use crate::schedule::WakeSchedule;

/// Handles the samples and wakes of a loop over a drive.
pub(super) trait DriveHandler {
    fn schedule(&mut self) -> &mut WakeSchedule;

    /// Runs a wake that is due. Returns false to end the loop.
    fn wake(&mut self, wake: Wake) -> Result<bool, Failure>;

    /// Handles a sample that was delivered, before the wake that it causes.
    fn sample(&mut self, drive: &Replay, step: &ReplayStep) -> Result<(), Failure>;
}

/// First and last stamp of a drive in ns, both inclusive, over all its topics: ticks must not
/// depend on the topics that are recorded. `None` if unknown.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct DriveSpan {
    pub(super) start_ns: Option<i64>,
    pub(super) end_ns: Option<i64>,
}

impl DriveSpan {
    /// The span of this range of `drive`.
    pub(super) fn of(drive: &Replay, part: TimeRange) -> Self {
        let start_ns = drive
            .start_ns()
            .map(|start_ns| part.from_ns.map_or(start_ns, |from_ns| from_ns.max(start_ns)));
        let end_ns = drive
            .end_ns()
            .map(|end_ns| part.to_ns.map_or(end_ns, |to_ns| end_ns.min(to_ns.saturating_sub(1))));
        Self { start_ns, end_ns }
    }
}

pub(super) struct LoopEnd {
    /// Stamp of the last sample; 0 if there was none.
    pub(super) at_ns: i64,
    /// The error that ended it before the end of the drive.
    pub(super) broken: Option<ReplayError>,
    /// Set if a wake ended it.
    pub(super) stopped: bool,
}

/// Runs a lambda over a drive. Each sample is delivered, then the wakes that it causes run. Ticks
/// run before the first later sample, and up to the end of the drive.
pub(super) fn run(
    drive: &mut Replay,
    span: DriveSpan,
    handler: &mut impl DriveHandler,
) -> Result<LoopEnd, Failure> {
    let mut reached = LoopEnd { at_ns: 0, broken: None, stopped: false };
    if let Some(start_ns) = span.start_ns {
        handler.schedule().begin(start_ns);
    }
    loop {
        match drive.peek_at_ns() {
            Ok(Some(next_ns)) => reached.stopped = !ticks(handler, next_ns)?,
            Ok(None) => break,
            Err(error) => {
                reached.broken = Some(error);
                break;
            }
        }
        if reached.stopped {
            return Ok(reached);
        }
        match drive.step() {
            Ok(Some(step)) => {
                reached.at_ns = step.at_ns;
                handler.sample(drive, &step)?;
            }
            Ok(None) => break,
            Err(error) => {
                reached.broken = Some(error);
                break;
            }
        }
        while let Some(wake) = handler.schedule().next_event() {
            if !handler.wake(wake)? {
                reached.stopped = true;
                return Ok(reached);
            }
        }
    }
    // The end of a damaged drive is unknown: its last sample counts. A tick at the very end is
    // still due.
    let end_ns = span
        .end_ns
        .filter(|_| reached.broken.is_none())
        .map_or(reached.at_ns, |end_ns| end_ns.max(reached.at_ns));
    reached.stopped = !ticks(handler, end_ns.saturating_add(1))?;
    Ok(reached)
}

/// Runs the ticks that are due before `at_ns`; returns false if one of them ends the loop.
fn ticks(handler: &mut impl DriveHandler, at_ns: i64) -> Result<bool, Failure> {
    while let Some(tick) = handler.schedule().next_tick(at_ns) {
        if !handler.wake(tick)? {
            return Ok(false);
        }
    }
    Ok(true)
}
