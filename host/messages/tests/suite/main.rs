//! Tests the crate through its public interface: definitions, fields, and sources of definitions.

mod messages;
mod sources;
#[path = "../../../drives/tests/suite/support.rs"]
mod support;
