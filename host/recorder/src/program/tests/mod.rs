//! Tests of the process, within a test: one file for each subject. These, and those that kill a
//! process, are unit tests because they share support with others. Here as there, `step` of
//! `durable.rs` does nothing unless a test sets its last step.

mod commands;
mod kills;
mod layouts;
mod process;
mod restarts;
mod running;
