//! An ingress over the loopback or a drive, and its program, with readers in this process.

mod definitions;
mod drive;
mod granting;
mod hostile;
mod program;
mod publishing;
mod restarts;
mod sharing;
mod support;
