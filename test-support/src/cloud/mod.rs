//! The surroundings of a cloud in its tests: people, vehicles, an object store, and PostgreSQL.

pub mod bucket;
pub mod fake;
pub mod postgres;
