//! The cloud of a fleet, as one process: vehicles connect to it, and people deploy by it.
//!
//! `store` is the database and `objects` the folder of files; together with the certificates of
//! `authority` they are all that survives a restart. `accept` accepts connections for both
//! listeners: `people` and `page` answer requests of people, and `vehicles` those of vehicles, each
//! of which keeps one connection open. `hub` knows these connections, and wakes them after a
//! change.
//! `clips` has recorded clips of vehicles, with a folder of its own. `transfer` receives files and
//! sends them.
//!
//! Nothing here runs a lambda, or decides what a vehicle runs: each vehicle verifies signatures by
//! its own trust root.

mod accept;
mod attempts;
mod authority;
mod clips;
mod cloud;
mod error;
mod folder;
mod hub;
mod objects;
mod page;
mod people;
mod program;
mod readers;
mod request;
mod server;
mod store;
mod transfer;
mod vehicles;

pub use program::main;
pub use server::{CloudServer, ServeOptions};
