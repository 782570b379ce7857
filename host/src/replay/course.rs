//! The course of a drive: every sample delivered, and every wake that the schedule asks for, in the
//! drive's time.

use gleaner_base::Failure;
use gleaner_drives::{Replay, ReplayError, Step};
use gleaner_journal::Part;

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

/// From when until when a drive is, in ns, both inclusive, and whatever is read of it: ticks must
/// not depend on which topics are recorded. `None` where nobody knows.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct Span {
    pub(super) start_ns: Option<i64>,
    pub(super) end_ns: Option<i64>,
}

impl Span {
    /// Of this part of `drive`.
    pub(super) fn of(drive: &Replay, part: Part) -> Self {
        let start_ns = drive
            .start_ns()
            .map(|start_ns| part.from_ns.map_or(start_ns, |from_ns| from_ns.max(start_ns)));
        let end_ns = drive
            .end_ns()
            .map(|end_ns| part.to_ns.map_or(end_ns, |to_ns| end_ns.min(to_ns.saturating_sub(1))));
        Self { start_ns, end_ns }
    }
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

/// Takes a lambda through a drive. A sample is delivered, what it wakes runs, then the next; ticks
/// come before the first sample that is later, and go on to the end of the drive.
pub(super) fn take(
    drive: &mut Replay,
    span: Span,
    course: &mut impl Course,
) -> Result<Reached, Failure> {
    let mut reached = Reached { at_ns: 0, broken: None, stopped: false };
    if let Some(start_ns) = span.start_ns {
        course.schedule().begin(start_ns);
    }
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
                reached.at_ns = step.at_ns;
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
    // Of a damaged drive nobody knows what came after the last sample. A tick of the very last
    // instant is still due.
    let end_ns = span
        .end_ns
        .filter(|_| reached.broken.is_none())
        .map_or(reached.at_ns, |end_ns| end_ns.max(reached.at_ns));
    reached.stopped = !ticks(course, end_ns.saturating_add(1))?;
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
