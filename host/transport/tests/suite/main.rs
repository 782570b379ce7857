//! The crate through its public interface: messages, replay, channels, damage, extras, loopback, sources.

mod channels;
mod damage;
mod extras;
mod invalid;
mod loopback;
mod messages;
mod replay;
mod sources;
mod support;
