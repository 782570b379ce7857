//! Tests of the recorder through its public interface, and of its process within a test: one
//! program, with one file for each subject.

mod commands;
mod in_the_way;
mod kills;
mod late;
mod layouts;
mod live;
mod preroll;
mod process;
mod recorder;
mod restarts;
#[cfg(feature = "program")]
mod running;
mod support;
mod windows;
