//! The program `gleaner-orchestrator`: the daemon of a vehicle.
//!
//! - `layout`, `durable`, `state`, `store`, `spools`: its files: desired state, trust, revisions,
//!   records.
//! - `trust`, `checked`, `admission`: what may run. `compile`: native code before it runs.
//! - `core`: the state, and the operations that change it; `deploying`: new deployments, and their
//!   removal. `report`: the state for users.
//! - `bounded_process`: programs that must end within a time.
//! - `link`: starts `gleaner-supervisor`, which runs all other processes, and sends it the wanted
//!   state.
//! - `api`, `streams`, `metrics`: the socket for users. `objects`: files that they and the cloud
//!   send.
//! - `cloud`: the connection to the cloud, if the vehicle is enrolled.
//!
//! Lambdas do not depend on it: it can end and start again while they run.

mod admission;
mod api;
mod bounded_process;
mod checked;
mod clock_jumps;
mod cloud;
mod compile;
mod deploying;
mod durable;
mod layout;
mod link;
mod metrics;
mod objects;
mod orchestrator;
mod program;
mod report;
mod spools;
mod state;
mod store;
mod streams;
mod trust;

pub use program::main;
