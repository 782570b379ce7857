//! The commands for a vehicle: they send requests to its `gleaner-orchestrator`, or to its cloud.
//!
//! - `client`, `file_body`: requests over its socket, or to a cloud.
//! - `deploy`: signs a deployment, sends it and waits; starts, stops, rolls back and removes.
//!   `former`: the deployment before it, as it was signed.
//! - `trust`: trust roots. `status`, `stream`: what runs, and what happened.
//! - `top`: what each lambda costs, each second.

mod client;
mod deploy;
mod file_body;
mod former;
mod status;
mod stream;
mod top;
mod trust;

pub(crate) use client::VehicleClient;
pub(crate) use deploy::{LocalRevision, change, deploy, path, print_lines, remove};
pub(crate) use status::{cloud_line, labels_in_words, short, status};
pub(crate) use stream::{events, logs, record_text};
pub(crate) use top::top;
pub(crate) use trust::trust;
