//! Tests the crate through its public interface: replay, channels, damage, extras.

mod channels;
mod damage;
mod extras;
mod invalid;
mod replay;
mod support;
