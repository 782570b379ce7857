//! Deployments of the fleet, and the state that each vehicle should have by them.

use std::collections::BTreeMap;

use gleaner_base::excerpt;
use gleaner_fleet::people::FleetDeployment;
use gleaner_fleet::{Wanted, desired_digest};
use gleaner_protocol::vehicle_api::GrantStatus;

use super::vehicles::{FAILED, RUNNING, ended, json};
use super::{CloudStore, StoreChange, int, now_ms, unsigned};
use crate::error::{CloudError, CloudResult};

/// Maximum number of deployments: all of them fit into one frame for a vehicle.
const DEPLOYMENTS_MAX: i64 = 4000;

type TextMap = BTreeMap<String, String>;

/// A deployment that was sent, with its revisions.
#[derive(Debug)]
pub(crate) struct OfferedDeployment {
    pub(crate) id: String,
    pub(crate) release: u64,
    pub(crate) envelope: String,
    pub(crate) revision: String,
    pub(crate) fallback: Option<String>,
    pub(crate) grants: GrantStatus,
    pub(crate) selector: TextMap,
    /// The envelope of each revision, by its digest.
    pub(crate) revisions: BTreeMap<String, String>,
}

/// The state that a vehicle should have.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct VehicleWants {
    pub(crate) generation: u64,
    pub(crate) deployments: Vec<Wanted>,
}

/// The vehicles whose wanted state has changed.
pub(crate) type ChangedVehicles = Vec<String>;

/// Selector and wish of a deployment.
struct FleetWish {
    selector: TextMap,
    wanted: Wanted,
}

impl CloudStore {
    /// Stores a deployment and its revisions; returns the number of the change. The same envelope
    /// again starts it, if it was stopped.
    pub(crate) async fn deploy(
        &self,
        actor: &str,
        offered: &OfferedDeployment,
    ) -> CloudResult<(u64, ChangedVehicles)> {
        let OfferedDeployment { id, release, envelope, .. } = offered;
        let sha256 = gleaner_trust::sha256(envelope.as_bytes()).to_string();
        let mut change = self.change().await?;
        let before: Option<(i64, String)> =
            row!(&mut *change.tx; "SELECT number, sha256 FROM deployments WHERE id = $1"; id);
        if let Some((stored, digest)) = &before
            && *digest != sha256
            && int(*release) <= *stored
        {
            let message = format!("deployment `{id}` has release {stored}; this is {release}");
            return Err(CloudError::denied(message, "sign it again with a higher release"));
        }
        let (count,): (i64,) = one!(&mut *change.tx; "SELECT COUNT(*) FROM deployments");
        if before.is_none() && count >= DEPLOYMENTS_MAX {
            let message = format!("the fleet has {count} deployments; no more are stored");
            return Err(CloudError::denied(message, "remove some that are not needed any more"));
        }
        for (digest, envelope) in &offered.revisions {
            run!(&mut *change.tx;
                "INSERT INTO revisions (digest, envelope) VALUES ($1, $2)
                 ON CONFLICT (digest) DO NOTHING";
                digest, envelope);
        }
        let is_same = before.is_some_and(|(_, digest)| digest == sha256);
        if is_same {
            run!(&mut *change.tx; "UPDATE deployments SET is_wanted = 1 WHERE id = $1"; id);
        } else {
            run!(&mut *change.tx;
                "INSERT INTO deployments (id, number, sha256, envelope, revision, fallback,
                 grants, selector, is_wanted, rollback_request)
                 VALUES ($1, $2, $3, $4, $5, $6, $7, $8, 1, 0)
                 ON CONFLICT (id) DO UPDATE SET number = excluded.number,
                 sha256 = excluded.sha256, envelope = excluded.envelope,
                 revision = excluded.revision, fallback = excluded.fallback,
                 grants = excluded.grants, selector = excluded.selector, is_wanted = 1,
                 rollback_request = 0";
                id, int(*release), &sha256, envelope, &offered.revision,
                offered.fallback.as_deref().unwrap_or_default(),
                json(&offered.grants), json(&offered.selector));
        }
        let number = change.note(actor, &format!("deploy release {release}"), id).await?;
        let changed = change.refresh("").await?;
        change.commit().await?;
        Ok((number, changed))
    }

    /// Starts or stops a deployment.
    pub(crate) async fn set_wanted(
        &self,
        actor: &str,
        id: &str,
        is_wanted: bool,
    ) -> CloudResult<ChangedVehicles> {
        let mut change = self.change().await?;
        let sql = "UPDATE deployments SET is_wanted = $2 WHERE id = $1";
        let found = run!(&mut *change.tx; sql; id, i64::from(is_wanted)).rows_affected();
        change.finish(found, actor, if is_wanted { "start" } else { "stop" }, id).await
    }

    /// Requests each vehicle to run the fallback of a deployment.
    pub(crate) async fn roll_back(&self, actor: &str, id: &str) -> CloudResult<ChangedVehicles> {
        let mut change = self.change().await?;
        // Numbers are times: a request is new also for a vehicle that followed one of a deployment
        // of this id that was removed since, or that a restored backup does not have.
        let found = run!(&mut *change.tx;
            "UPDATE deployments SET rollback_request =
             CASE WHEN rollback_request < $2 THEN $2 ELSE rollback_request + 1 END
             WHERE id = $1 AND fallback <> ''";
            id, now_ms())
        .rows_affected();
        if found == 0 && self.deployment_exists(id).await? {
            let message = format!("deployment `{id}` has no fallback");
            return Err(CloudError::usage(message, "deploy the former revision again"));
        }
        change.finish(found, actor, "roll back", id).await
    }

    /// Removes a deployment.
    pub(crate) async fn remove_deployment(
        &self,
        actor: &str,
        id: &str,
    ) -> CloudResult<ChangedVehicles> {
        let mut change = self.change().await?;
        let found = run!(&mut *change.tx; "DELETE FROM deployments WHERE id = $1"; id);
        let found = found.rows_affected();
        change.finish(found, actor, "remove deployment", id).await
    }

    async fn deployment_exists(&self, id: &str) -> CloudResult<bool> {
        let row: Option<(String,)> =
            row!(&self.pool; "SELECT id FROM deployments WHERE id = $1"; id);
        Ok(row.is_some())
    }

    /// Returns all deployments, with the number of vehicles that should run them and do.
    pub(crate) async fn deployments(&self) -> CloudResult<Vec<FleetDeployment>> {
        type Row = (String, i64, String, String, String, String, i64);
        let rows: Vec<Row> = rows!(&self.pool;
            "SELECT id, number, revision, fallback, grants, selector, is_wanted FROM deployments
             ORDER BY id");
        let vehicles: Vec<(String, String, i64, i64)> = rows!(&self.pool;
            "SELECT name, labels, generation, handled FROM vehicles WHERE is_revoked = 0");
        let vehicles: Vec<(String, TextMap, bool)> = vehicles
            .into_iter()
            .map(|(name, labels, generation, handled)| (name, map(&labels), handled >= generation))
            .collect();
        let reported: Vec<(String, String, i64, String)> =
            rows!(&self.pool; "SELECT vehicle, deployment, number, state FROM reported");
        let reported: BTreeMap<_, _> = reported
            .into_iter()
            .map(|(vehicle, id, number, state)| ((vehicle, id), (number, state)))
            .collect();
        let deployment = |(id, number, revision, fallback, grants, selector, is_wanted): Row| {
            let mut deployment = FleetDeployment {
                id,
                release: unsigned(number),
                revision,
                fallback: (!fallback.is_empty()).then_some(fallback),
                grants: serde_json::from_str(&grants).unwrap_or_default(),
                selector: map(&selector),
                is_wanted: is_wanted != 0,
                vehicles: 0,
                running: 0,
                failed: 0,
            };
            for (name, labels, has_handled) in &vehicles {
                if !selects(&deployment.selector, labels) {
                    continue;
                }
                deployment.vehicles += 1;
                let report = reported.get(&(name.clone(), deployment.id.clone()));
                match report.filter(|(reported, _)| *reported == number) {
                    Some((_, state)) if state == RUNNING => deployment.running += 1,
                    Some((_, state)) if state == FAILED => deployment.failed += 1,
                    // It has handled its wanted state, and has not accepted this.
                    None if *has_handled && deployment.is_wanted => deployment.failed += 1,
                    _ => {}
                }
            }
            deployment
        };
        Ok(rows.into_iter().map(deployment).collect())
    }

    /// Returns one of the [`deployments`](Self::deployments).
    pub(crate) async fn deployment(&self, id: &str) -> CloudResult<FleetDeployment> {
        let all = self.deployments().await?;
        all.into_iter().find(|it| it.id == id).ok_or_else(|| unknown(id))
    }

    /// Returns the envelope of a deployment with this SHA-256.
    pub(crate) async fn envelope(&self, sha256: &str) -> CloudResult<Option<String>> {
        let sql = "SELECT envelope FROM deployments WHERE sha256 = $1";
        let row: Option<(String,)> = row!(&self.pool; sql; sha256);
        Ok(row.map(|(envelope,)| envelope))
    }

    /// Returns the envelope of a revision with this digest.
    pub(crate) async fn revision(&self, digest: &str) -> CloudResult<Option<String>> {
        let sql = "SELECT envelope FROM revisions WHERE digest = $1";
        let row: Option<(String,)> = row!(&self.pool; sql; digest);
        Ok(row.map(|(envelope,)| envelope))
    }

    /// Returns the state that a vehicle should have.
    pub(crate) async fn wants(&self, name: &str) -> CloudResult<VehicleWants> {
        // One transaction: the number and the deployments are of the same moment.
        let mut tx = self.pool.begin().await?;
        let row: Option<(i64, String)> = row!(&mut *tx;
            "SELECT generation, labels FROM vehicles WHERE name = $1 AND is_revoked = 0";
            name);
        let (generation, labels) = row.ok_or_else(ended)?;
        let deployments = wanted_by(&map(&labels), &wishes(&mut tx).await?);
        Ok(VehicleWants { generation: unsigned(generation), deployments })
    }
}

impl StoreChange<'_> {
    /// Commits a change of `found` deployments.
    async fn finish(
        mut self,
        found: u64,
        actor: &str,
        action: &str,
        id: &str,
    ) -> CloudResult<ChangedVehicles> {
        if found == 0 {
            return Err(unknown(id));
        }
        self.note(actor, action, id).await?;
        let changed = self.refresh("").await?;
        self.commit().await?;
        Ok(changed)
    }

    /// Counts a new wanted state of the vehicle `only`, or of all if it is empty, where it has
    /// changed; returns these vehicles.
    pub(super) async fn refresh(&mut self, only: &str) -> CloudResult<ChangedVehicles> {
        let wishes = wishes(&mut self.tx).await?;
        let vehicles: Vec<(String, String, String)> = rows!(&mut *self.tx;
            "SELECT name, labels, digest FROM vehicles
             WHERE is_revoked = 0 AND ($1 = '' OR name = $1)";
            only);
        let mut changed = Vec::new();
        for (name, labels, before) in vehicles {
            let digest = desired_digest(&wanted_by(&map(&labels), &wishes));
            if digest != before {
                run!(&mut *self.tx;
                    "UPDATE vehicles SET generation = generation + 1, digest = $2 WHERE name = $1";
                    &name, digest);
                changed.push(name);
            }
        }
        Ok(changed)
    }
}

async fn wishes(tx: &mut sqlx::Transaction<'static, sqlx::Any>) -> CloudResult<Vec<FleetWish>> {
    let rows: Vec<(String, String, String, i64, i64)> = rows!(&mut **tx;
        "SELECT id, sha256, selector, is_wanted, rollback_request FROM deployments ORDER BY id");
    let wish = |(id, envelope, selector, is_wanted, rollback): (_, _, String, i64, i64)| {
        let rollback = unsigned(rollback);
        let wanted = Wanted { id, envelope, is_wanted: is_wanted != 0, rollback };
        FleetWish { selector: map(&selector), wanted }
    };
    Ok(rows.into_iter().map(wish).collect())
}

fn wanted_by(labels: &TextMap, wishes: &[FleetWish]) -> Vec<Wanted> {
    let chosen = wishes.iter().filter(|wish| selects(&wish.selector, labels));
    chosen.map(|wish| wish.wanted.clone()).collect()
}

fn selects(selector: &TextMap, labels: &TextMap) -> bool {
    selector.iter().all(|(name, value)| labels.get(name) == Some(value))
}

fn map(json: &str) -> TextMap {
    serde_json::from_str(json).unwrap_or_default()
}

fn unknown(id: &str) -> CloudError {
    let message = format!("there is no deployment `{}`", excerpt(id));
    CloudError::missing(message, "list the deployments, and use one of their ids")
}
