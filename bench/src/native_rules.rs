//! Rules of the examples that run as native code, too, where the examples keep them to themselves.

use gleaner_sdk::kernels::mean::mean;

/// Length of a window of `examples/imu-fft` in seconds.
pub const FFT_WINDOW_S: f64 = 1.25;

/// Length of the window of accelerations of `examples/brake-dark`.
pub const BRAKE_WINDOW_NS: i64 = 500_000_000;
/// Age of the oldest sample of a full window.
const FULL_NS: i64 = 450_000_000;
/// Shortest time between two of its triggers.
pub const REFRACTORY_NS: i64 = 3_000_000_000;

/// Returns the mean of a window of accelerations, if it is full at `now`, and below `brake_mps2`.
pub fn braking(at_ns: &[i64], values: &[f64], now: i64, brake_mps2: f64) -> Option<f64> {
    let is_full = at_ns.first().is_some_and(|oldest| now - oldest >= FULL_NS);
    mean(values).filter(|mean| is_full && *mean < brake_mps2)
}
