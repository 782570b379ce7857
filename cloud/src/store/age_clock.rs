//! The clock by which records and clips age. What is removed does not come back, and the clock of a
//! machine can be wrong by months: so this one counts the time that processes have measured. It
//! begins at the time of the machine, never goes back, and stands still while no process runs.
//!
//! Processes over one database share it: each counts on from what it has found, and the furthest
//! one counts. None makes it faster than time, whatever the clock of its machine shows, but by the
//! few days that a time without any process counts.

use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use super::{CloudStore, DAY_S, StoreChange, now};
use crate::error::CloudResult;

/// The most that the time between two processes counts, as only clocks of machines measure it.
const AWAY_MAX_S: i64 = 3 * DAY_S;
/// Time for which a new process only looks, to find others that count. It is longer than the
/// interval at which they do, and than the time in which most machines set their clocks.
const ALONE_S: i64 = 150;
/// A change of the clock of the machine by this is logged.
const JUMP_S: i64 = 3600;

#[derive(Debug)]
pub(super) struct AgeClock {
    started: Instant,
    last: Mutex<Option<ClockLook>>,
}

/// A look at the clock, at a time since the start of this process.
#[derive(Debug, Clone, Copy)]
struct ClockLook {
    up_s: i64,
    wall: i64,
    seconds: i64,
    /// The stored clock as the process has found it, as long as it only looks.
    found: Option<(i64, i64)>,
}

impl AgeClock {
    pub(super) fn start() -> Self {
        Self { started: Instant::now(), last: Mutex::default() }
    }
}

impl CloudStore {
    /// Returns the clock at the last look.
    pub(super) fn age_now(&self) -> i64 {
        let last = *self.ages.last.lock().unwrap_or_else(PoisonError::into_inner);
        last.map_or(0, |last| last.seconds)
    }

    /// Returns by how much the clock of the machine is ahead of this one, in s.
    pub(crate) fn age_lag(&self) -> i64 {
        now() - self.age_now()
    }

    /// Counts the time since the last look.
    pub(crate) async fn count_age(&self) -> CloudResult<()> {
        let up_s = i64::try_from(self.ages.started.elapsed().as_secs()).unwrap_or(i64::MAX);
        self.count_age_at(up_s, now()).await.map(drop)
    }

    /// Counts the time up to `up_s` after the start of this process; returns the clock.
    pub(super) async fn count_age_at(&self, up_s: i64, wall: i64) -> CloudResult<i64> {
        let mut change = self.change().await?;
        let row: Option<(i64, i64)> = row!(change; "SELECT seconds, wall FROM age_clock");
        let stored = match row {
            Some(stored) => stored,
            None => change.begin_age(wall).await?,
        };
        let last = *self.ages.last.lock().unwrap_or_else(PoisonError::into_inner);
        let found = Some(stored);
        let last = last.unwrap_or(ClockLook { up_s, wall, seconds: stored.0, found });
        let mut look = ClockLook { up_s, wall, ..last };
        look.seconds = stored.0.max(last.seconds + up_s - last.up_s);
        let jump_s = (wall - last.wall) - (up_s - last.up_s);
        if jump_s.abs() > JUMP_S {
            tracing::warn!(jump_s, "the system clock was set; ages are unaffected");
        }
        if let Some((seconds, before)) = look.found.filter(|_| up_s >= ALONE_S) {
            look.found = None;
            // Others that have counted meanwhile have measured the time before, too.
            if stored.0 == seconds {
                let away_s = (wall - up_s).saturating_sub(before);
                look.seconds += away_s.clamp(0, AWAY_MAX_S);
                if away_s > AWAY_MAX_S {
                    tracing::warn!(
                        away_s,
                        "after a pause, records and clips age by at most 3 days"
                    );
                }
            }
        }
        if look.found.is_none() {
            run!(change; "UPDATE age_clock SET seconds = $1, wall = $2"; look.seconds, wall);
        }
        change.commit().await?;
        *self.ages.last.lock().unwrap_or_else(PoisonError::into_inner) = Some(look);
        Ok(look.seconds)
    }
}

impl StoreChange<'_> {
    /// Begins the clock at the time of the machine, unless that is days after the last sign of life
    /// in the database. Notes of later days are of a clock that was wrong.
    async fn begin_age(&mut self, wall: i64) -> CloudResult<(i64, i64)> {
        let (entry, seen): (i64, i64) = one!(self; "SELECT (SELECT COALESCE(MAX(time_ms), 0) / 1000
             FROM audit), (SELECT COALESCE(MAX(seen), 0) FROM vehicles)");
        let seconds = match entry.max(seen) {
            0 => wall,
            last => wall.min(last + AWAY_MAX_S),
        };
        run!(self; "DELETE FROM arrival_days WHERE day > $1"; seconds / DAY_S);
        run!(self; "INSERT INTO age_clock (seconds, wall) VALUES ($1, $2)"; seconds, wall);
        Ok((seconds, wall))
    }
}
