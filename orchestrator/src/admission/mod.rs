//! Admission: refuses a deployment that asks for more than the vehicle has.
//!
//! - `demand`: what a lambda asks for: as its manifest states, as measured, or as is assumed.
//! - `budgets`: the most that all lambdas may ask for, and the decision.
//! - `measured`: what lambdas used on this vehicle, in a file. `board`: the speed of the machine.
//!
//! Nothing here stops a lambda that was admitted: measurements change what is refused later.

mod board;
mod budgets;
mod demand;
mod measured;
#[cfg(test)]
mod tests;

pub(crate) use board::{fuel_per_second, machine};
pub(crate) use budgets::Budgets;
pub(crate) use demand::LambdaDemand;
pub(crate) use measured::Measurements;
