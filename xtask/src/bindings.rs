//! The bindings of the Rust SDK, which a test in `tests/bindings` generates and compares.

use std::process::Command;

use crate::checkout::Checkout;

/// Returns the command that tests them; with `GLEANER_BLESS` it writes them.
pub(crate) fn test(checkout: &Checkout) -> Command {
    let mut test = checkout.cargo();
    // The generator runs for a second, so it is not optimized.
    test.args(["test", "--profile", "xtask", "--package", "gleaner-bindings"]);
    test.args(["--features", "generator"]);
    test
}
