//! The state that each vehicle should have: of each deployment, the newest release that is open to
//! the vehicle and that it has the labels for.

use std::collections::{HashMap, HashSet};
use std::sync::{Arc, Mutex, PoisonError};

use gleaner_fleet::{Wanted, desired_digest};

use super::counting::ended;
use super::lookups::AHEAD;
use super::sql::{TextMap, map};
use super::{CloudStore, StoreChange, unsigned};
use crate::error::CloudResult;
use crate::sqlx::AnyConnection;

/// Counts a desired state, which is sent at once to a vehicle that is connected.
macro_rules! next_wanted {
    ($rest:literal) => {
        concat!(
            "UPDATE vehicles SET generation = generation + 1, offered = CASE
             WHEN replica IN (SELECT id FROM replicas) THEN generation + 1 ELSE offered END",
            $rest
        )
    };
}
pub(super) use next_wanted;

/// Maximum number of deployments of all states that are kept, some 200 bytes each.
const CACHED_MAX: usize = 32_000;

/// The state of a release that is open to all its vehicles.
pub(super) const COMPLETE: &str = "complete";

#[derive(Debug, PartialEq)]
pub(crate) struct VehicleWants {
    pub(crate) generation: u64,
    pub(crate) deployments: Arc<[Wanted]>,
    /// True if the vehicle is to stop and remove nothing.
    pub(crate) keeps: bool,
}

pub(crate) type ChangedVehicles = Vec<String>;

typed! {
    pub(super) struct DesiredVehicle {
        pub(super) name: String,
        pub(super) labels: String,
        /// The digest of its desired state so far.
        pub(super) digest: String,
    }
}

/// Desired states by their digests. It cannot be out of date, also if others change the database:
/// a vehicle's digest is read each time, and equal digests are equal states. Few differ.
#[derive(Default)]
pub(super) struct WantedStates(Mutex<HashMap<String, Arc<[Wanted]>>>);

impl WantedStates {
    fn get(&self, digest: &str) -> Option<Arc<[Wanted]>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get(digest).cloned()
    }

    fn add(&self, digest: String, state: Arc<[Wanted]>) {
        let mut states = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let kept: usize = states.values().map(|it| it.len() + 1).sum();
        if kept + state.len() > CACHED_MAX {
            states.clear();
        }
        states.insert(digest, state);
    }
}

struct FleetWishes {
    /// The releases by deployment, of each the newest first.
    releases: Vec<WishedRelease>,
    members: HashMap<String, HashSet<(String, i64)>>,
}

typed! {
    struct WishedRelease {
        selector: TextMap,
        number: i64,
        is_complete: bool,
        wanted: Wanted,
    }
}

columns!(Wanted: id, envelope, is_wanted, rollback, start);

impl CloudStore {
    pub(crate) async fn wants(&self, name: &str) -> CloudResult<VehicleWants> {
        let (generation, digest) = self.wants.find(name).await?.ok_or_else(ended)?;
        let same = digest.strip_suffix(AHEAD);
        let (digest, keeps) = (same.unwrap_or(&digest), same.is_some());
        if let Some(deployments) = self.wanted.get(digest) {
            return Ok(VehicleWants { generation: unsigned(generation), deployments, keeps });
        }
        // One transaction: the number and the deployments are of the same moment.
        let mut tx = self.pool.begin().await?;
        let row: Option<(u64, TextMap, bool)> = row!(&mut *tx; "SELECT generation, labels, is_ahead
             FROM vehicles WHERE name = $1 AND is_revoked = 0"; name);
        let (generation, labels, keeps) = row.ok_or_else(ended)?;
        let wishes = FleetWishes::load(&mut tx, &[name]).await?;
        let deployments: Arc<[Wanted]> = wishes.of(name, &labels).into();
        self.wanted.add(desired_digest(&deployments), Arc::clone(&deployments));
        Ok(VehicleWants { generation, deployments, keeps })
    }
}

impl StoreChange<'_> {
    /// Counts a new desired state of each vehicle where it has changed; returns these vehicles.
    pub(super) async fn refresh_all(&mut self) -> CloudResult<ChangedVehicles> {
        let vehicles = rows!(self;
            "SELECT name, labels, digest FROM vehicles WHERE is_revoked = 0");
        self.refresh(vehicles).await
    }

    /// Counts a new desired state of the vehicle, if it has changed.
    pub(super) async fn refresh_one(&mut self, name: &str) -> CloudResult<()> {
        let vehicle = one!(self; "SELECT name, labels, digest FROM vehicles WHERE name = $1"; name);
        self.refresh(vec![vehicle]).await.map(drop)
    }

    /// Counts a new desired state of each of these vehicles where it has changed; returns those.
    pub(super) async fn refresh(
        &mut self,
        vehicles: Vec<DesiredVehicle>,
    ) -> CloudResult<ChangedVehicles> {
        if vehicles.is_empty() {
            return Ok(Vec::new());
        }
        let names: Vec<_> = vehicles.iter().map(|it| &*it.name).collect();
        let wishes = FleetWishes::load(&mut self.tx, &names).await?;
        // Many vehicles have the same labels, and few are members of waves.
        let mut digests: HashMap<String, String> = HashMap::new();
        let mut changed: HashMap<String, Vec<String>> = HashMap::new();
        for DesiredVehicle { name, labels, digest: before } in vehicles {
            let is_member = wishes.members.contains_key(&name);
            let digest = match digests.get(&labels).filter(|_| !is_member) {
                Some(digest) => digest.clone(),
                None => desired_digest(&wishes.of(&name, &map(&labels))),
            };
            if digest != before {
                changed.entry(digest.clone()).or_default().push(name);
            }
            if !is_member {
                digests.insert(labels, digest);
            }
        }
        for (digest, names) in &changed {
            let sql = next_wanted!(", digest = $1 WHERE name IN ($2..)");
            self.run_in(sql, names, &values! { digest }).await?;
        }
        Ok(changed.into_values().flatten().collect())
    }
}

impl FleetWishes {
    /// Loads all releases, and the waves of these vehicles.
    async fn load(tx: &mut AnyConnection, names: &[&str]) -> CloudResult<Self> {
        let releases: Vec<WishedRelease> = rows!(&mut *tx; "SELECT id, number, sha256 AS envelope,
             selector, is_wanted, rollback_request AS rollback, start_request AS start,
             CASE WHEN state = $1 THEN 1 ELSE 0 END AS is_complete FROM releases JOIN deployments
             ON deployments.id = releases.deployment ORDER BY id, number DESC"; COMPLETE);
        let names = if releases.iter().all(|it| it.is_complete) { &[] } else { names };
        let rows: Vec<(String, String, i64)> = rows_in!(&mut *tx;
            "SELECT vehicle, deployment, number FROM wave_members WHERE vehicle IN ($1..)"; names);
        let mut members = HashMap::<_, HashSet<_>>::new();
        for (vehicle, deployment, number) in rows {
            members.entry(vehicle).or_default().insert((deployment, number));
        }
        Ok(Self { releases, members })
    }

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
