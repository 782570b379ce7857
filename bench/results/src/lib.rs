//! Results of a benchmark: what was measured, on which machine, and what it means.
//!
//! - [`BenchResults`] is one run: tables of [`Figure`]s, and [`Series`] of single measurements with
//!   all of their values, and quantities with their [`Growth`]. It is stored as JSON, as Markdown,
//!   and as a page with plots.
//! - [`Summary`] has the statistics of a series, and [`MeasuredDifference`] compares two.
//! - [`Comparison`] compares two runs.
//! - [`IsolationCosts`] become a recommendation.
//! - [`SequenceEntry`] is one of several benchmarks that ran one after the other.
//! - [`Machine`] is where a run took place, [`CoreList`] a part of its cores, and [`PowerMeter`]
//!   measures the power that it takes.

mod comparison;
mod core_list;
mod figure;
mod growth;
mod machine;
mod markdown;
mod page;
mod power;
mod recommendation;
mod results;
mod sequence;
mod statistics;

pub use comparison::Comparison;
pub use core_list::CoreList;
pub use figure::{Figure, Goal};
pub use growth::{Growth, GrowthCurve};
pub use machine::Machine;
pub use power::PowerMeter;
pub use recommendation::{AttackCounts, IsolationCosts, KindValues, WakeCosts};
pub use results::{BenchResults, Reception, Series, SeriesGroup};
pub use sequence::{BenchEnd, OUTPUT, SequenceEntry};
pub use statistics::{MeasuredDifference, Summary, quantile};
