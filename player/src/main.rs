//! Plays drives as live topics of ROS 2.
fn main() {}
