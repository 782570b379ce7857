//! The cloud of a fleet: vehicles connect to it, and people deploy by it.
//!
//! `store` is the database and `objects` has the files, in a `place`: a folder, or a bucket (`s3`).
//! Together with the certificates of `authority` they are all that survives a restart. `people` and
//! `page` answer requests of people, and `vehicles` those of vehicles, each of which keeps one
//! connection open; the entrance of `gleaner-fleet` accepts the connections of both. `hub` has
//! those of vehicles, and wakes them after a change; by `tails`, vehicles learn which of their
//! records people follow.
//! `clips` has recorded clips of vehicles, and `records` old records in files, each with a place of
//! its own. `transfer` receives files and sends them.
//!
//! One process with a database in its folder is a cloud, and so are several over one PostgreSQL
//! database and one bucket: `replicas` follows what the others have changed, and `bus` carries
//! hints that something has.
//!
//! Nothing here runs a lambda, or decides what a vehicle runs: each vehicle verifies signatures by
//! its own trust root. `counts` has the numbers that `/metrics` shows.

mod attempts;
mod authority;
mod bus;
mod clips;
mod cloud;
mod counts;
mod error;
mod folder;
mod hub;
mod objects;
mod page;
mod people;
mod place;
mod program;
mod readers;
mod records;
mod replicas;
mod request;
mod s3;
mod server;
mod sqlx;
mod store;
mod tails;
mod ticks;
mod transfer;
mod vehicles;

#[cfg(test)]
use vehicles::endpoints as endpoints_for_vehicles;

pub use program::main;
pub use server::{CloudServer, ServeOptions};
