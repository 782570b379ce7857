//! Results of benchmarks: raw values, and the machine on which they were measured.
//!
//! - [`BenchResults`] is one run: rows ([`Figure`]) with goals, groups of [`Series`] with all of
//!   their values, and quantities with their [`Growth`]. It is stored as JSON; the tables, the page
//!   and the plots are made of that file by `bench/analysis`, which has all of the statistics.
//! - [`SequenceEntry`] is one of several benchmarks that ran one after the other.
//! - [`Machine`] is where a run took place, [`CoreList`] a part of its cores, [`EnergyMeter`]
//!   measures the energy that it takes, and [`Throttling`] finds out whether it was slowed down.

mod analysis;
mod core_list;
mod energy;
mod figure;
mod machine;
mod results;
mod sequence;
mod statistics;
mod throttling;

pub use analysis::{compare, python, render};
pub use core_list::CoreList;
pub use energy::{EnergyMeter, PartEnergy};
pub use figure::{Figure, Goal};
pub use machine::Machine;
pub use results::{BenchResults, Growth, GrowthCurve, Reception, Series, SeriesGroup};
pub use sequence::{BenchEnd, OUTPUT, SequenceEntry};
pub use statistics::{median, quantile};
pub use throttling::Throttling;
