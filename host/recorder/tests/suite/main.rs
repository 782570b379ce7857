//! The recorder through its public interface, and its process within a test, as one program: each
//! file is a subject.

mod commands;
mod in_the_way;
mod kills;
mod late;
mod live;
mod preroll;
mod process;
mod recorder;
#[cfg(feature = "program")]
mod running;
mod support;
mod windows;
