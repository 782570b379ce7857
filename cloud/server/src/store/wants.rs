//! The state that each vehicle should have: of each deployment, the newest release that is open to
//! the vehicle and that it has the labels for.

use std::collections::{BTreeMap, HashMap, HashSet};

use gleaner_fleet::{Wanted, desired_digest};

use super::deployments::COMPLETE;
use super::vehicles::ended;
use super::{CloudStore, StoreChange, unsigned};
use crate::error::CloudResult;

pub(super) type TextMap = BTreeMap<String, String>;

/// The state that a vehicle should have.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct VehicleWants {
    pub(crate) generation: u64,
    pub(crate) deployments: Vec<Wanted>,
}

/// The vehicles whose wanted state has changed.
pub(crate) type ChangedVehicles = Vec<String>;

/// All releases, and the vehicles that waves have reached.
struct FleetWishes {
    /// The releases by deployment, of each the newest first.
    releases: Vec<WishedRelease>,
    members: HashMap<String, HashSet<(String, i64)>>,
}

struct WishedRelease {
    selector: TextMap,
    number: i64,
    is_complete: bool,
    wanted: Wanted,
}

impl CloudStore {
    /// Returns the state that a vehicle should have.
    pub(crate) async fn wants(&self, name: &str) -> CloudResult<VehicleWants> {
        // One transaction: the number and the deployments are of the same moment.
        let mut tx = self.pool.begin().await?;
        let row: Option<(i64, String)> = row!(&mut *tx;
            "SELECT generation, labels FROM vehicles WHERE name = $1 AND is_revoked = 0";
            name);
        let (generation, labels) = row.ok_or_else(ended)?;
        let deployments = FleetWishes::load(&mut tx, name).await?.of(name, &map(&labels));
        Ok(VehicleWants { generation: unsigned(generation), deployments })
    }
}

impl StoreChange<'_> {
    /// Counts a new wanted state of the vehicle `only`, or of all if it is empty, where it has
    /// changed; returns these vehicles.
    pub(super) async fn refresh(&mut self, only: &str) -> CloudResult<ChangedVehicles> {
        let wishes = FleetWishes::load(&mut self.tx, only).await?;
        let vehicles: Vec<(String, String, String)> = rows!(&mut *self.tx;
            "SELECT name, labels, digest FROM vehicles
             WHERE is_revoked = 0 AND ($1 = '' OR name = $1)";
            only);
        // Many vehicles have the same labels, and few are members of waves.
        let mut digests: HashMap<String, String> = HashMap::new();
        let mut changed = Vec::new();
        for (name, labels, before) in vehicles {
            let is_member = wishes.members.contains_key(&name);
            let digest = match digests.get(&labels).filter(|_| !is_member) {
                Some(digest) => digest.clone(),
                None => desired_digest(&wishes.of(&name, &map(&labels))),
            };
            if digest != before {
                run!(&mut *self.tx;
                    "UPDATE vehicles SET generation = generation + 1, digest = $2 WHERE name = $1";
                    &name, &digest);
                changed.push(name);
            }
            if !is_member {
                digests.insert(labels, digest);
            }
        }
        Ok(changed)
    }
}

impl FleetWishes {
    /// Loads the releases, and the members among the vehicle `only`, or among all if it is empty.
    async fn load(tx: &mut sqlx::Transaction<'static, sqlx::Any>, only: &str) -> CloudResult<Self> {
        type Row = (String, i64, String, String, i64, i64, i64, String);
        let rows: Vec<Row> = rows!(&mut **tx;
            "SELECT id, number, sha256, selector, is_wanted, rollback_request, start_request, state
             FROM releases JOIN deployments ON deployments.id = releases.deployment
             ORDER BY id, number DESC");
        let release = |(id, number, envelope, selector, is_wanted, rollback, start, state): Row| {
            let (is_wanted, rollback, start) =
                (is_wanted != 0, unsigned(rollback), unsigned(start));
            let wanted = Wanted { id, envelope, is_wanted, rollback, start };
            WishedRelease {
                selector: map(&selector),
                number,
                is_complete: state == COMPLETE,
                wanted,
            }
        };
        let pairs: Vec<(String, String, i64)> = rows!(&mut **tx;
            "SELECT vehicle, deployment, number FROM wave_members
             WHERE $1 = '' OR vehicle = $1";
            only);
        let mut members: HashMap<String, HashSet<(String, i64)>> = HashMap::new();
        for (vehicle, deployment, number) in pairs {
            members.entry(vehicle).or_default().insert((deployment, number));
        }
        Ok(Self { releases: rows.into_iter().map(release).collect(), members })
    }

    /// Returns the deployments that a vehicle should have.
    fn of(&self, name: &str, labels: &TextMap) -> Vec<Wanted> {
        let members = self.members.get(name);
        let mut wanted: Vec<Wanted> = Vec::new();
        for release in &self.releases {
            let id = &release.wanted.id;
            let is_open = release.is_complete
                || members.is_some_and(|all| all.contains(&(id.clone(), release.number)));
            let is_newest = wanted.last().is_none_or(|last| last.id != *id);
            if is_newest && is_open && selects(&release.selector, labels) {
                wanted.push(release.wanted.clone());
            }
        }
        wanted
    }
}

pub(super) fn selects(selector: &TextMap, labels: &TextMap) -> bool {
    selector.iter().all(|(name, value)| labels.get(name) == Some(value))
}

pub(super) fn map(json: &str) -> TextMap {
    serde_json::from_str(json).unwrap_or_default()
}
