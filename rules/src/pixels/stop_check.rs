//! Work on pixels asks as it goes whether it may go on: nothing else could end it.

use std::cell::Cell;
use std::fmt;

use super::PixelError;

/// Bytes that are worked on between two questions: below a tenth of a millisecond, and long enough
/// for a look at a clock to be cheap.
const STRIDE: usize = 64 << 10;

/// A question that operations ask now and then: may they go on?
pub struct StopCheck<'a> {
    may_continue: &'a dyn Fn() -> bool,
    /// Bytes until the next question.
    left: Cell<usize>,
}

impl<'a> StopCheck<'a> {
    /// Asks `may_continue` at the beginning of an operation, and again before each further stretch of
    /// it.
    pub fn new(may_continue: &'a dyn Fn() -> bool) -> Self {
        Self { may_continue, left: Cell::new(0) }
    }

    /// Asks, if it is time to, before so many bytes are worked on.
    pub fn check(&self, bytes: usize) -> Result<(), PixelError> {
        if let Some(left) = self.left.get().checked_sub(bytes) {
            self.left.set(left);
            return Ok(());
        }
        self.left.set(STRIDE);
        if (self.may_continue)() { Ok(()) } else { Err(PixelError::Stopped) }
    }
}

impl fmt::Debug for StopCheck<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StopCheck").field("left", &self.left).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pixels::{Encoding, View, ops};

    /// How many rows of a picture of 1024 columns an operation reached that is stopped at its
    /// `asked`th question.
    fn rows_reached(
        asked: u32,
        operation: impl Fn(&View<'_>) -> Result<(), PixelError>,
    ) -> Result<(), PixelError> {
        let data = vec![200; 1024 * 3 * 1024];
        let questions = Cell::new(0);
        let may_continue = || {
            questions.set(questions.get() + 1);
            questions.get() < asked
        };
        let pace = StopCheck::new(&may_continue);
        let view = View::new(1024, 1024, 3 * 1024, Encoding::Rgb8, false, &data)
            .unwrap()
            .with_stop_check(&pace);
        let result = operation(&view);
        assert!(questions.get() <= asked, "it went on after it was stopped");
        result
    }

    #[test]
    fn every_operation_stops_between_rows() {
        let stopped = |result| assert!(matches!(result, Err(PixelError::Stopped)), "{result:?}");
        for asked in [1, 2, 5] {
            stopped(rows_reached(asked, |view| ops::mean_luma(view, None).map(drop)));
            stopped(rows_reached(asked, |view| ops::histogram(view, None).map(drop)));
            // The white of each kind of result shows how far it came.
            let written = |out: &[u8]| out.iter().filter(|byte| **byte == 200).count();
            let few = asked as usize * 3 * STRIDE;
            stopped(rows_reached(asked, |view| {
                let mut out = vec![0; 1024 * 1024];
                let result = ops::to_gray(view, &mut out);
                assert!(written(&out) <= few, "{}", written(&out));
                result
            }));
            for (width, height) in [(4096, 4096), (512, 512), (16, 2000), (2000, 16), (1, 1)] {
                stopped(rows_reached(asked, |view| {
                    let mut out = vec![0; ops::resized(view, width, height)?.1];
                    let result = ops::resize(view, width, height, &mut out).map(drop);
                    assert!(written(&out) <= few, "{width}x{height}: {}", written(&out));
                    result
                }));
            }
        }
        rows_reached(u32::MAX, |view| ops::mean_luma(view, None).map(drop)).unwrap();
    }
}
