//! Tests the crate through its public interface: definitions, fields, and sources of definitions.

mod loopback;
mod messages;
mod sources;
