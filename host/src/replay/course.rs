//! The course of a drive: every sample delivered, and every wake that the schedule asks for, in the drive's time.

use gleaner_protocol::Failure;
use gleaner_transport::replay::{Replay, ReplayError, Step};

use crate::api::data::Wake;
use crate::schedule::Schedule;

/// What happens on the way.
pub(super) trait Course {
    /// The lambda's wakes.
    fn schedule(&mut self) -> &mut Schedule;

    /// One of them is due. False ends the course here.
    fn wake(&mut self, wake: Wake) -> Result<bool, Failure>;

    /// A sample was delivered, and nobody woken yet.
    fn sample(&mut self, drive: &Replay, step: &Step) -> Result<(), Failure>;
}

/// How far a course went.
pub(super) struct Reached {
    /// Stamp of the last sample; 0 if there was none.
    pub(super) at_ns: i64,
    /// What ended it before the end of the drive.
    pub(super) broken: Option<ReplayError>,
    /// Whether a wake ended it.
    pub(super) stopped: bool,
}

/// Takes a lambda through a drive. A sample is delivered, what it wakes runs, then the next; ticks come before the first sample
/// that is later.
pub(super) fn take(drive: &mut Replay, course: &mut impl Course) -> Result<Reached, Failure> {
    let mut reached = Reached { at_ns: 0, broken: None, stopped: false };
    let mut any = false;
    loop {
        match drive.peek_at_ns() {
            Ok(Some(next_ns)) => reached.stopped = !ticks(course, next_ns)?,
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
                (reached.at_ns, any) = (step.at_ns, true);
                course.sample(drive, &step)?;
            }
            Ok(None) => break,
            Err(error) => {
                reached.broken = Some(error);
                break;
            }
        }
        while let Some(wake) = course.schedule().next_event() {
            if !course.wake(wake)? {
                reached.stopped = true;
                return Ok(reached);
            }
        }
    }
    if any {
        // A tick of the very last instant is still due.
        reached.stopped = !ticks(course, reached.at_ns.saturating_add(1))?;
    }
    Ok(reached)
}

/// Runs the ticks that are due before a sample of `at_ns`; false if one of them ends the course.
fn ticks(course: &mut impl Course, at_ns: i64) -> Result<bool, Failure> {
    while let Some(tick) = course.schedule().next_tick(at_ns) {
        if !course.wake(tick)? {
            return Ok(false);
        }
    }
    Ok(true)
}
