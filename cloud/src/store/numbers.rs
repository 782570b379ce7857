//! Numbers from outside. The database has no unsigned ones: a number that is too large for it is
//! refused by its name, as a clamped one would stand for another.

use std::fmt::Display;

use crate::error::{CloudError, CloudResult};

/// Largest number of a vehicle, as in its spools: each can still be counted up.
pub(crate) const NUMBER_MAX: u64 = 1 << 62;

pub(super) fn check_number(name: impl Display, number: u64) -> CloudResult<()> {
    check_up_to(NUMBER_MAX, name, number)
}

/// Refuses a life that is too large. After `last`, which the cloud itself may have counted up, the
/// next one is always possible.
pub(super) fn check_life(stream: &str, last: Option<u64>, life: u64) -> CloudResult<()> {
    let most = last.map_or(0, |last| last.saturating_add(1)).max(NUMBER_MAX);
    check_up_to(most, format_args!("`life` of stream `{stream}`"), life)
}

fn check_up_to(most: u64, name: impl Display, number: u64) -> CloudResult<()> {
    if number <= most {
        return Ok(());
    }
    let message = format!("{name} cannot be {number}: the largest number is {most}");
    Err(CloudError::usage(message, "use a version of gleaner that fits the one of the cloud"))
}
