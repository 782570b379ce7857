//! A stream keeps what it acknowledged, and marks what it lost, after kills, power cuts, failures
//! of the disk, and changed bytes.
//!
//! `GLEANER_SEEDS` is the number of power cuts, by default 200, and `GLEANER_KILLS` that of kills,
//! by default 20.

mod budget;
mod damage;
mod faults;
mod folder;
mod follow;
mod kills;
mod model;
mod power_cut;
