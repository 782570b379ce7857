//! The commands for a cloud: they send requests to its `gleaner-cloud`.
//!
//! - `login`: the address and the token. `people`: users, and the audit trail. `tokens`: tokens for
//!   programs.
//! - `vehicles`: lists, enrols and revokes vehicles. `enrol`: connects this one.
//! - `clips`: lists and fetches recorded clips.
//! - `fleet`: deployments of the cloud, signed here. `plan`: the vehicles that a change concerns,
//!   and the question before it. `rollout`: waits for all their vehicles, and
//!   `waves` for the waves before.
//! - `list`: lists, part by part. `search`: what is found in records.

mod clips;
mod enrol;
mod fleet;
mod list;
mod login;
mod people;
mod plan;
mod rollout;
mod search;
mod tokens;
mod vehicles;
mod waves;

use gleaner_base::{Exit, Failure};

use crate::account::CloudAccount;
use crate::args::CloudCommand;
use crate::delegate;
use crate::output::show;
use crate::vehicle::VehicleClient;

pub(crate) use fleet::{Change, change, deploy};

pub(crate) fn run(command: &CloudCommand) -> Result<Exit, Failure> {
    match command {
        CloudCommand::Cloud { arguments } => delegate::replace("gleaner-cloud", arguments),
        CloudCommand::Login(args) => login::login(args),
        CloudCommand::Logout(args) => login::logout(args),
        CloudCommand::Whoami(args) => login::whoami(args),
        CloudCommand::Users(args) => people::users(args),
        CloudCommand::Tokens(args) => tokens::tokens(args),
        CloudCommand::Vehicles(args) => vehicles::vehicles(args),
        CloudCommand::Fleet(args) => fleet::fleet(args),
        CloudCommand::Clips(args) => clips::clips(args),
        CloudCommand::Search(args) => search::search(args),
        CloudCommand::Audit(args) => people::audit(args),
        CloudCommand::Enrol(args) => enrol::enrol(args),
        CloudCommand::Unenrol(args) => enrol::unenrol(args),
    }
}

fn client() -> Result<VehicleClient, Failure> {
    VehicleClient::of_cloud(CloudAccount::load()?)
}

/// Formats a time in s since 1970.
fn date(seconds: u64) -> String {
    gleaner_base::UtcTime::of(seconds.try_into().unwrap_or(i64::MAX)).to_string()
}

#[cfg(test)]
fn test_vehicle(
    name: &str,
    state: gleaner_fleet::people::VehicleState,
) -> gleaner_fleet::people::VehicleSummary {
    let vehicle = serde_json::json!({
        "name": name, "labels": {}, "state": state, "wanted": 0, "handled": 0, "problems": [],
        "running": 0, "deployments": 0,
    });
    serde_json::from_value(vehicle).unwrap()
}
