//! Lets the caller stop an operation on pixels, which checks for it as it proceeds.

use std::cell::Cell;
use std::fmt;

use super::PixelError;

/// Bytes that are processed between two checks: less than 0.1 ms of work, and enough to make
/// reading a clock cheap in comparison.
const STRIDE: usize = 64 << 10;

/// A callback that operations call regularly, to check whether to continue.
pub struct StopCheck<'a> {
    may_continue: &'a dyn Fn() -> bool,
    /// Bytes until the next check.
    left: Cell<usize>,
}

impl<'a> StopCheck<'a> {
    /// Creates a check with a callback, which is called at the start of an operation and before
    /// each further part.
    pub fn new(may_continue: &'a dyn Fn() -> bool) -> Self {
        Self { may_continue, left: Cell::new(0) }
    }

    /// Calls the callback, if due, before `bytes` bytes are processed.
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

    /// Runs an operation on an image of 1024 columns, and stops it at check number `at`.
    fn stopped_at(
        at: u32,
        operation: impl Fn(&View<'_>) -> Result<(), PixelError>,
    ) -> Result<(), PixelError> {
        let data = vec![200; 1024 * 3 * 1024];
        let checks = Cell::new(0);
        let may_continue = || {
            checks.set(checks.get() + 1);
            checks.get() < at
        };
        let stop_check = StopCheck::new(&may_continue);
        let view = View::new(1024, 1024, 3 * 1024, Encoding::Rgb8, false, &data)
            .unwrap()
            .with_stop_check(&stop_check);
        let result = operation(&view);
        assert!(checks.get() <= at, "it continued after it was stopped");
        result
    }

    #[test]
    fn every_operation_stops_between_rows() {
        let stopped = |result| assert!(matches!(result, Err(PixelError::Stopped)), "{result:?}");
        for at in [1, 2, 5] {
            stopped(stopped_at(at, |view| ops::mean_luma(view, None).map(drop)));
            stopped(stopped_at(at, |view| ops::histogram(view, None).map(drop)));
            // The number of white bytes in the result shows the progress.
            let written = |out: &[u8]| out.iter().filter(|byte| **byte == 200).count();
            let few = at as usize * 3 * STRIDE;
            stopped(stopped_at(at, |view| {
                let mut out = vec![0; 1024 * 1024];
                let result = ops::to_gray(view, &mut out);
                assert!(written(&out) <= few, "{}", written(&out));
                result
            }));
            for (width, height) in [(4096, 4096), (512, 512), (16, 2000), (2000, 16), (1, 1)] {
                stopped(stopped_at(at, |view| {
                    let mut out = vec![0; ops::resized(view, width, height)?.1];
                    let result = ops::resize(view, width, height, &mut out).map(drop);
                    assert!(written(&out) <= few, "{width}x{height}: {}", written(&out));
                    result
                }));
            }
        }
        stopped_at(u32::MAX, |view| ops::mean_luma(view, None).map(drop)).unwrap();
    }
}
