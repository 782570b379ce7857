//! The cloud of a fleet: vehicles connect to it, and people deploy by it.
//!
//! The doors `people` (an API), `page` and `vehicles` parse requests, check rights, and render; the
//! entrance of `gleaner-fleet` accepts their connections. They use the services in `cloud`, none of
//! which names it or a door: `accounts`, `enrolments`, `deployments`, `clips` and `records`.
//!
//! `store` is the database and `objects` has the files, in a `place`: a folder, or a bucket.
//! Together with the certificates of `authority` they are all that survives a restart. `hub` has
//! the connections of vehicles, and wakes them after a change; by `live_streams`, vehicles learn
//! which of their records people follow. `transfer` receives files and sends them.
//!
//! One process with a database in its folder is a cloud, and so are several over one PostgreSQL
//! database and one bucket: `replicas` follows what the others have changed, and `bus` carries
//! hints that something has.
//!
//! Nothing here runs a lambda, or decides what a vehicle runs: each vehicle verifies signatures by
//! its own trust root. `counts` has the numbers that `/metrics` shows.

mod accounts;
mod attempts;
mod authority;
// Without `scaled`, no hint is sent or received.
#[cfg_attr(not(feature = "scaled"), allow(dead_code))]
mod bus;
mod clips;
mod cloud;
mod counts;
mod deployments;
mod enrolments;
mod error;
mod folder;
mod hub;
mod live_streams;
mod objects;
mod page;
mod people;
mod place;
mod program;
mod readers;
mod records;
mod replicas;
mod request;
#[cfg(feature = "scaled")]
mod scaled;
mod server;
mod sqlx;
mod store;
mod ticks;
mod transfer;
#[cfg(any(test, not(feature = "scaled")))]
#[cfg_attr(feature = "scaled", expect(dead_code, unused_imports, reason = "only its test runs"))]
mod unscaled;
mod vehicles;

#[cfg(not(feature = "scaled"))]
use unscaled as scaled;
#[cfg(test)]
use vehicles::endpoints as endpoints_for_vehicles;

pub use program::main;
pub use server::{CloudServer, ServeOptions};
