//! An ingress over the loopback or a drive, with readers in the same process.

mod definitions;
mod drive;
mod granting;
mod hostile;
mod publishing;
mod restarts;
mod sharing;
mod support;
