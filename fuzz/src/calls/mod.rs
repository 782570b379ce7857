//! Calls of a lambda into the host, through the WIT: the component `driver`
//! (`tests/lambdas/driver`) makes those that an input says.
//!
//! An input is a list of wakes, with [`WAKE`] between them. A wake is a byte for each of the two
//! pictures, with what it says they are changed by, and then the program of `driver`.

#[cfg(feature = "calls")]
mod driver;
#[cfg(feature = "calls")]
mod pictures;

use gleaner_operations::{Operation, Step};

/// What stands between two wakes.
pub const WAKE: &[u8] = b"WAKE";

/// The byte before each picture.
pub mod picture {
    /// These bits choose one of four.
    pub const WHICH: u8 = 3;
    /// Its sample says that it is big-endian.
    pub const BIG_ENDIAN: u8 = 4;
    /// It ends behind as many bytes as the next two say.
    pub const SHORT: u8 = 8;
    /// Times 16: how often two bytes for a place and one for a value follow.
    pub const CHANGES: u8 = 0x70;
    /// It is what follows: a length in a byte, and so many bytes.
    pub const OWN: u8 = 0x80;
}

/// Calls with their arguments, as a program for `driver`.
pub fn program(calls: &[(Operation, &[u8])]) -> Vec<u8> {
    calls.iter().flat_map(|(operation, arguments)| Step::Call(*operation).with(arguments)).collect()
}

/// Makes the calls twice, and then some that are known by another instance. Whether each wake of it
/// could run.
#[cfg(feature = "calls")]
pub fn check(data: &[u8]) -> bool {
    use crate::budget;
    use driver::{Driver, MEMORY, known};

    let known = known();
    budget::within(MEMORY, || {
        let run = || {
            let mut driver = Driver::new();
            let woke: Vec<_> = wakes(data).into_iter().map(|wake| driver.wake(wake)).collect();
            (woke, driver)
        };
        let (first, mut driver) = run();
        assert_eq!(driver.give_back(), known, "what was lent to an instance before is missing");
        driver.end();
        assert_eq!(first, run().0, "the same calls are decided otherwise");
        first.iter().all(|wake| wake.ran)
    })
}

/// The parts of an input: so many wakes at most, so that each has its share of the time.
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
