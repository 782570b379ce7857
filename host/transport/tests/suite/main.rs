//! The crate through its public interface: messages, replay, damage, loopback.

mod damage;
mod loopback;
mod messages;
mod replay;
mod support;
