//! Directories, databases and packed files of rosbag2, made on the spot as its writers make them.

mod bag;
mod definitions;
mod hostile;
mod metadata;
mod packed;
mod parts;
mod reading;
#[path = "../suite/support.rs"]
mod support;
