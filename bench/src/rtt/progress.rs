//! Prints the progress of a run, with an estimate of the time that is left.

use std::time::Duration;

/// Time that a turn takes beside its warm-up and its measured time: starts, discovery, ends.
const BESIDES: Duration = Duration::from_secs(6);

pub(super) struct TurnProgress {
    /// Number of rows after the current one.
    pub(super) rows_left: u32,
    /// Expected time of a turn, until one has ended.
    expected: Duration,
    /// Number and time of the turns that have ended.
    ended: u32,
    spent: Duration,
}

impl TurnProgress {
    /// Begins a run of `rows`, whose turns take some `seconds`.
    pub(super) fn new(rows: usize, seconds: u32) -> Self {
        let expected = Duration::from_secs(seconds.into()) + BESIDES;
        Self { rows_left: rows as u32, expected, ended: 0, spent: Duration::ZERO }
    }

    /// Prints a turn that begins: its number among those of its row, and its description. Rows to
    /// come are taken to have as many turns as this one.
    pub(super) fn begin_turn(&self, [number, of_row]: [u32; 2], turn: &str) {
        let mean = self.spent.checked_div(self.ended).unwrap_or(self.expected);
        let left = mean * (1 + of_row - number + self.rows_left * of_row);
        let minutes = left.as_secs().div_ceil(60);
        eprintln!("[{number}/{of_row}] {turn}; about {minutes} min left");
    }

    /// Ends a turn that took this time.
    pub(super) fn end_turn(&mut self, time: Duration) {
        self.ended += 1;
        self.spent += time;
    }
}
