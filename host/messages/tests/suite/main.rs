//! The crate through its public interface: definitions, fields, and where definitions are found.

mod messages;
mod sources;
#[path = "../../../drives/tests/suite/support.rs"]
mod support;
