//! A cloud on a temporary folder, with an enrolled fleet.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use tempfile::TempDir;
use tokio::task::JoinSet;
use tokio::time::Instant;

use crate::administrator::Administrator;
use crate::cloud_process::CloudProcess;
use crate::identity::{FleetKey, SimulatedIdentity};
use crate::simulation::Simulation;
use crate::vehicle::SimulatedVehicle;

/// Vehicles that are enrolled at a time.
const AT_A_TIME: usize = 32;

/// The cloud, its administrator and its vehicles.
pub struct EnrolledFleet {
    pub cloud: CloudProcess,
    pub token: String,
    pub vehicles: Vec<SimulatedIdentity>,
    /// Time of the enrolments, in s.
    pub enrolled_s: f64,
    _folder: TempDir,
}

impl EnrolledFleet {
    /// Starts a cloud, and enrols `count` vehicles by the requests that people and vehicles send.
    /// The cloud is started again afterwards, so that its memory is that of a fresh one.
    pub async fn enrol(count: usize) -> Result<Self, String> {
        let folder = TempDir::new().map_err(|error| error.to_string())?;
        let cloud = CloudProcess::start(&folder.path().join("data"))?;
        let code = cloud.code.as_deref().ok_or("the cloud has printed no code")?;
        let token = Administrator::login(cloud.people, code).await?;
        let begun = Instant::now();
        let vehicles = enrol_all(cloud.people, &token, count).await?;
        let enrolled_s = begun.elapsed().as_secs_f64();
        let cloud = cloud.restart()?;
        Ok(Self { cloud, token, vehicles, enrolled_s, _folder: folder })
    }

    /// Connects the administrator.
    pub async fn administrator(&self) -> Result<Administrator, String> {
        Administrator::connect(self.cloud.people, &self.token).await
    }

    /// Starts `count` of the vehicles, all at once.
    pub fn start(&self, count: usize, pause_max: Duration) -> (Arc<Simulation>, JoinSet<()>) {
        start_all(&self.vehicles[..count], self.cloud.vehicles, pause_max)
    }
}

/// Enrols `count` vehicles by the requests that people and vehicles send.
pub async fn enrol_all(
    people: SocketAddr,
    token: &str,
    count: usize,
) -> Result<Vec<SimulatedIdentity>, String> {
    let (key, taken) = (Arc::new(FleetKey::generate()?), Arc::new(AtomicUsize::new(0)));
    let mut workers = JoinSet::new();
    for _ in 0..AT_A_TIME.min(count) {
        let (key, taken) = (Arc::clone(&key), Arc::clone(&taken));
        let mut administrator = Administrator::connect(people, token).await?;
        workers.spawn(async move {
            let mut enrolled = Vec::new();
            loop {
                let index = taken.fetch_add(1, Relaxed);
                if index >= count {
                    return Ok::<_, String>(enrolled);
                }
                let enrolment = administrator.invite(&format!("car-{index}")).await?;
                enrolled.push(key.enrol(index, enrolment).await?);
            }
        });
    }
    let mut vehicles = Vec::new();
    while let Some(enrolled) = workers.join_next().await {
        vehicles.extend(enrolled.map_err(|error| error.to_string())??);
    }
    Ok(vehicles)
}

/// Starts vehicles, all at once.
pub fn start_all(
    identities: &[SimulatedIdentity],
    cloud: SocketAddr,
    pause_max: Duration,
) -> (Arc<Simulation>, JoinSet<()>) {
    let simulation = Arc::new(Simulation::new(cloud, pause_max, identities.len()));
    let mut tasks = JoinSet::new();
    for identity in identities {
        let vehicle = SimulatedVehicle::new(identity.clone(), Arc::clone(&simulation));
        tasks.spawn(vehicle.run());
    }
    (simulation, tasks)
}
