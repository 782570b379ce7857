//! Tests directories, databases and packed files of rosbag2, created in the form of its writers.

mod bag;
mod definitions;
mod hostile;
mod metadata;
mod packed;
mod parts;
mod reading;
