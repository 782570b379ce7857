//! Tests the crate through its public interface: replay, channels, damage, extras, rosbag2.

#[cfg(feature = "bags")]
mod bags;
mod channels;
mod damage;
mod extras;
mod flips;
mod invalid;
mod replay;
mod separate;
mod support;
