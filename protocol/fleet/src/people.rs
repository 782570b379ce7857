//! Messages of the API for people: JSON over HTTP, each request with a token.
//!
//! `GET /v1/openapi.json` of a cloud describes all requests, their roles, and these messages.
//!
//! In the answer to a deployment, `attempt` is 0, as each vehicle counts its own, and `generation`
//! is the number of its entry in the audit trail.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use gleaner_protocol::vehicle_api::GrantStatus;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::WantedProblem;
use crate::waves::{WavePlan, WaveProgress};

/// A part of a list that can grow: `?after=CURSOR&limit=N`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "ListPageOf{T}")]
pub struct ListPage<T> {
    /// The entries.
    pub items: Vec<T>,
    /// The value of `after` for the next part. Only a part with as many entries as `limit` has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next: Option<String>,
}

impl<T> ListPage<T> {
    /// Returns a part with its entries, which are at most `limit`. `cursor` returns the position
    /// of an entry.
    pub fn of(items: Vec<T>, limit: u64, cursor: impl Fn(&T) -> String) -> Self {
        let is_full = items.len() as u64 == limit;
        let next = items.last().filter(|_| is_full).map(cursor);
        Self { items, next }
    }
}

/// The rights of a user. Each has those of the ones before.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// May read everything but the audit trail and users.
    Viewer,
    /// May start, stop and roll back deployments.
    Operator,
    /// May add and remove deployments.
    Deployer,
    /// May add and remove vehicles and users, and read the audit trail.
    Admin,
}

impl Role {
    /// Returns its name.
    pub fn as_str(self) -> &'static str {
        match self {
            Role::Viewer => "viewer",
            Role::Operator => "operator",
            Role::Deployer => "deployer",
            Role::Admin => "admin",
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let all = [Role::Viewer, Role::Operator, Role::Deployer, Role::Admin];
        all.into_iter().find(|role| role.as_str() == text).ok_or_else(|| {
            let text = gleaner_base::excerpt(text);
            format!("`{text}` is not a role; use viewer, operator, deployer or admin")
        })
    }
}

/// A request for a token, by the one-time code of an invitation.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Login {
    /// The code.
    pub code: String,
}

/// A token of a user. It is not shown again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct UserToken {
    /// The user.
    pub user: User,
    /// The token, for the header `Authorization: Bearer TOKEN`.
    pub token: String,
    /// End of the token, in s since 1970.
    pub expires: u64,
}

/// Longest lifetime of a token for programs, in days.
pub const TOKEN_DAYS_MAX: u32 = 366;

/// A request for a token for programs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NewToken {
    /// The name, one of the user's.
    pub name: String,
    /// The rights: at most those of the user.
    pub role: Role,
    /// Days until its end, at most [`TOKEN_DAYS_MAX`].
    pub days: u32,
}

/// A token for programs, without the token itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct TokenSummary {
    /// The user who has made it.
    pub user: String,
    /// The name.
    pub name: String,
    /// The rights, if the user still has them.
    pub role: Role,
    /// Its end, in s since 1970.
    pub expires: u64,
}

/// A user.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct User {
    /// The name.
    pub name: String,
    /// The rights.
    pub role: Role,
}

/// A request to add a user, or to invite one again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NewUser {
    /// The name.
    pub name: String,
    /// The rights.
    pub role: Role,
}

/// An invitation of a user.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Invitation {
    /// The user.
    pub user: User,
    /// The code, which works once.
    pub code: String,
    /// End of the code, in s since 1970.
    pub expires: u64,
}

/// A request to enrol a vehicle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NewVehicle {
    /// The name.
    pub name: String,
}

/// A vehicle in a list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct VehicleSummary {
    /// The name.
    pub name: String,
    /// The labels that it has reported.
    pub labels: BTreeMap<String, String>,
    /// Its state.
    pub state: VehicleState,
    /// Time of its last sign of life, in s since 1970; absent before the first one.
    pub seen: Option<u64>,
    /// Version of its orchestrator.
    pub version: Option<String>,
    /// Public key that verifies its clips, as it states it; empty before its first connection.
    #[serde(default)]
    pub key: String,
    /// Number of its desired state.
    pub wanted: u64,
    /// Number of the newest desired state that it has applied.
    pub handled: u64,
    /// True if it has followed a newer state than that of this cloud, which was restored from a
    /// backup: it stops and removes nothing until a person agrees.
    #[serde(default)]
    pub is_ahead: bool,
    /// True if two machines have its identity, and one of them is not let in.
    #[serde(default)]
    pub is_double: bool,
    /// The reasons why parts of its desired state are not applied.
    pub problems: Vec<WantedProblem>,
    /// Number of its deployments that run.
    pub running: u64,
    /// Number of its deployments.
    pub deployments: u64,
}

/// The state of a vehicle, as the cloud sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum VehicleState {
    /// It was invited, and has not connected yet.
    Invited,
    /// It is connected.
    Online,
    /// It is not connected.
    Offline,
    /// It was revoked.
    Revoked,
}

/// A deployment for the fleet: as for one vehicle, and with a plan of its waves.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FleetDeployRequest {
    /// The envelope of the deployment.
    pub deployment: String,
    /// The envelopes of its revision and its fallback; one that the cloud has may be left out.
    pub revisions: Vec<String>,
    /// The plan; without one, the deployment reaches all its vehicles at once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waves: Option<WavePlan>,
}

/// The highest release of a deployment that a vehicle has reported, also of one that was removed or
/// that the cloud does not have. It is unsigned, and so a hint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ReportedRelease {
    /// The vehicle.
    pub vehicle: String,
    /// Number of the release.
    pub release: u64,
}

/// A deployment of the fleet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FleetDeployment {
    /// Its id.
    pub id: String,
    /// Number of its release.
    pub release: u64,
    /// Digest of what people and waves want of it: the part of its `ETag` before the dot.
    #[serde(default)]
    pub version: String,
    /// SHA-256 of its signed envelope: what a vehicle that runs it reports.
    #[serde(default)]
    pub envelope: String,
    /// Digest of its revision.
    pub revision: String,
    /// Digest of its fallback.
    pub fallback: Option<String>,
    /// Rights of its lambda.
    #[serde(default)]
    pub grants: GrantStatus,
    /// Labels that a vehicle must have.
    pub selector: BTreeMap<String, String>,
    /// Those of older releases that vehicles still have.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub older_selectors: Vec<BTreeMap<String, String>>,
    /// False if it is stopped.
    pub is_wanted: bool,
    /// Number of vehicles that should run it.
    pub vehicles: u64,
    /// Number of these that run it.
    pub running: u64,
    /// Number of these that refuse it, or whose lambda has failed.
    pub failed: u64,
    /// Number of the failed ones that run its fallback.
    #[serde(default)]
    pub on_fallback: u64,
    /// The progress of its waves; absent once the release is for all these vehicles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waves: Option<WaveProgress>,
}

/// An entry of the audit trail.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct AuditEntry {
    /// Number of the entry.
    pub seq: u64,
    /// Time, in ms since 1970.
    pub time_ms: i64,
    /// The user, or the vehicle.
    pub actor: String,
    /// The action.
    pub action: String,
    /// The thing that it was done to.
    pub subject: String,
    /// SHA-256 over the hash of the entry before it and this entry.
    pub hash: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roles_are_parsed_and_ordered() {
        let all = ["viewer", "operator", "deployer", "admin"];
        let roles: Vec<Role> = all.iter().map(|role| role.parse().unwrap()).collect();
        assert!(roles.is_sorted());
        assert_eq!(roles.iter().map(ToString::to_string).collect::<Vec<_>>(), all);
        assert_eq!(
            "root".parse::<Role>().unwrap_err(),
            "`root` is not a role; use viewer, operator, deployer or admin"
        );
    }
}
