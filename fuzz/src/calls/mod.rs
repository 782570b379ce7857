//! Fuzzes calls of a lambda into the host, through the WIT: the component `driver`
//! (`tests/lambdas/driver`) makes the calls that an input lists.
//!
//! An input is a list of wakes, separated by [`WAKE`]. A wake begins with the messages of the two
//! cameras: for each, a byte with the bits of [`picture`], then the data that these bits require.
//! The rest of the wake is the program of `driver`.

#[cfg(feature = "calls")]
mod driver;
#[cfg(feature = "calls")]
mod pictures;

use gleaner_test_support::operations::{DriverStep, Operation};

/// Separator of wakes.
pub const WAKE: &[u8] = b"WAKE";

/// Bits of the byte that selects and modifies the message of a camera.
pub mod picture {
    /// Index of one of the four valid messages.
    pub const WHICH: u8 = 3;
    /// The message is marked as big-endian.
    pub const BIG_ENDIAN: u8 = 4;
    /// The message is truncated: its length follows in two bytes.
    pub const SHORT: u8 = 8;
    /// Number of modifications, times 16. They follow: two bytes for an offset, one for a value.
    pub const CHANGES: u8 = 0x70;
    /// No valid message is used: the message follows, its length in a byte, then its bytes.
    pub const OWN: u8 = 0x80;
}

/// Encodes calls with their arguments as a program for `driver`.
pub fn program(calls: &[(Operation, &[u8])]) -> Vec<u8> {
    calls
        .iter()
        .flat_map(|(operation, arguments)| DriverStep::Call(*operation).with(arguments))
        .collect()
}

/// Runs the input in a driver, then the reference calls, and then the input again in another
/// driver. Asserts that the reference calls use the usual fuel, and that both runs of the input
/// have the same results. Returns whether each wake of the first run received its program.
#[cfg(feature = "calls")]
pub fn check(data: &[u8]) -> bool {
    use crate::budget;
    use driver::{DriverInstance, MEMORY, reference_fuel};

    let reference = reference_fuel();
    budget::within(MEMORY, || {
        let run = || {
            let mut driver = DriverInstance::new();
            let results: Vec<_> = wakes(data).into_iter().map(|wake| driver.wake(wake)).collect();
            (results, driver)
        };
        let (first, mut driver) = run();
        assert_eq!(driver.run_reference(), reference, "the instance before kept a frame");
        driver.end();
        assert_eq!(first, run().0, "the same calls have different results");
        first.iter().all(|wake| wake.ran)
    })
}

/// Splits an input into at most `WAKES_MAX` wakes. The limit bounds the run time of an input.
#[cfg(feature = "calls")]
fn wakes(data: &[u8]) -> Vec<&[u8]> {
    const WAKES_MAX: usize = 8;
    let (mut wakes, mut rest) = (Vec::new(), data);
    while let Some(at) = rest
        .windows(WAKE.len())
        .position(|word| word == WAKE)
        .filter(|_| wakes.len() < WAKES_MAX - 1)
    {
        wakes.push(&rest[..at]);
        rest = &rest[at + WAKE.len()..];
    }
    wakes.push(rest);
    wakes
}
