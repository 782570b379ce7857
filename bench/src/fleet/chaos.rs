//! The cloud is killed again and again under a fleet that sends records and gets releases in waves.

use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use gleaner_bench::{Figure, quantile};
use hyper::Method;
use serde::Deserialize;
use tokio::task::JoinSet;
use tokio::time::sleep;

use crate::administrator::Administrator;
use crate::figure::{at_most, free};
use crate::fleet::{EnrolledFleet, enrol_all, start_all};
use crate::identity::SimulatedIdentity;
use crate::rollouts::Rollouts;
use crate::simulation::{FleetLoad, Simulation};

/// Longest pause between attempts to connect. Real vehicles wait up to five minutes, and would be
/// away most of the time.
const PAUSE_MAX: Duration = Duration::from_secs(4);
/// Interval of reports and batches, and the number of records in a batch.
const INTERVAL: Duration = Duration::from_secs(1);
const RECORDS: u64 = 2;
/// Longest time to wait for the fleet to do something.
const PATIENCE: Duration = Duration::from_secs(120);

/// A cloud that others have started.
pub struct RunningCloud {
    pub people: SocketAddr,
    /// Its address for vehicles.
    pub cloud: SocketAddr,
    /// A one-time code of an administrator.
    pub code: String,
}

/// The vehicles of a cloud, and access to it.
struct FleetMembers<'f> {
    people: SocketAddr,
    token: &'f str,
    identities: &'f [SimulatedIdentity],
}

#[derive(Deserialize)]
struct StoredLine {
    seq: u64,
    kind: String,
}

/// Measures `count` vehicles under `kills` kills, one in each `interval`.
pub async fn figures(
    count: usize,
    kills: usize,
    interval: Duration,
) -> Result<Vec<Figure>, String> {
    let mut fleet = EnrolledFleet::enrol(count).await?;
    let (simulation, vehicles) = fleet.start(count, PAUSE_MAX);
    let all = |it: &Simulation| it.connected.load(Relaxed) == count;
    if simulation.until(PATIENCE, all).await.is_none() {
        return Err("not all vehicles connect".to_owned());
    }
    simulation.load.send_replace(FleetLoad { interval: Some(INTERVAL), records: RECORDS });
    simulation.is_restarting.store(true, Relaxed);
    let rollouts = Rollouts::start(fleet.cloud.people, &fleet.token, count);
    for _ in 0..kills {
        sleep(interval).await;
        fleet.cloud.kill();
        fleet.cloud.start_again()?;
    }
    let EnrolledFleet { cloud, token, vehicles: identities, .. } = &fleet;
    let members = FleetMembers { people: cloud.people, token, identities };
    let mut figures = vec![free("kills: number of kills", "", kills as f64)];
    figures.extend(finish(&simulation, vehicles, rollouts, &members).await?);
    figures.iter().for_each(|figure| println!("{figure}"));
    Ok(figures)
}

/// Measures `count` vehicles of a running cloud, of which others kill parts until standard input
/// ends.
pub async fn figures_of(running: &RunningCloud, count: usize) -> Result<Vec<Figure>, String> {
    let token = Administrator::login(running.people, &running.code).await?;
    let identities = enrol_all(running.people, &token, count).await?;
    let (simulation, vehicles) = start_all(&identities, running.cloud, PAUSE_MAX);
    let all = |it: &Simulation| it.connected.load(Relaxed) == count;
    if simulation.until(PATIENCE, all).await.is_none() {
        return Err("not all vehicles connect".to_owned());
    }
    simulation.load.send_replace(FleetLoad { interval: Some(INTERVAL), records: RECORDS });
    simulation.is_restarting.store(true, Relaxed);
    let rollouts = Rollouts::start(running.people, &token, count);
    println!("all vehicles are connected");
    let ended = tokio::task::spawn_blocking(|| io::copy(&mut io::stdin(), &mut io::sink()));
    let _ = ended.await.map_err(|error| error.to_string())?;
    let members = FleetMembers { people: running.people, token: &token, identities: &identities };
    let figures = finish(&simulation, vehicles, rollouts, &members).await?;
    figures.iter().for_each(|figure| println!("{figure}"));
    Ok(figures)
}

/// Waits until all are connected after the last kill; returns what was measured.
async fn finish(
    simulation: &Arc<Simulation>,
    mut vehicles: JoinSet<()>,
    rollouts: Rollouts,
    members: &FleetMembers<'_>,
) -> Result<Vec<Figure>, String> {
    let count = members.identities.len();
    let all = |it: &Simulation| it.connected.load(Relaxed) == count;
    let after = simulation.until(PATIENCE, all).await;
    let after = after.map_or(f64::INFINITY, |it| it.as_secs_f64());
    simulation.is_restarting.store(false, Relaxed);
    let rollouts = rollouts.finish().await?;
    sleep(Duration::from_secs(3)).await;
    simulation.load.send_replace(FleetLoad::default());
    sleep(Duration::from_secs(3)).await;
    vehicles.abort_all();
    while vehicles.join_next().await.is_some() {}
    let sent = simulation.take_acknowledged_ms().len() as f64 * RECORDS as f64;
    let stored = stored(members, simulation).await?;

    let mut administrator = Administrator::connect(members.people, members.token).await?;
    let wrong_steps = rollouts.wrong_steps(&mut administrator).await?;
    let names = members.identities.iter().map(|it| &it.name);
    let wrong_of = |name: &String| rollouts.wrong_releases(&simulation.wanted_of(name));
    let wrong_releases = names.map(wrong_of).sum::<usize>() as f64;

    let reconnected = simulation.take_reconnected_s();
    let mut figures = vec![
        free("kills: vehicles", "", count as f64),
        free("kills: records that were acknowledged", "", sent),
        free("kills: records that are stored", "", stored),
        at_most("kills: records lost, or stored twice", "", 0.0, simulation.losses()),
        at_most("kills: all connected after the last one", "s", 30.0, after),
    ];
    figures.extend([
        free("kills: rollout steps", "", rollouts.steps.len() as f64),
        at_most("kills: rollout steps taken twice or missed", "", 0.0, wrong_steps),
        at_most("kills: releases that a vehicle got twice or not", "", 0.0, wrong_releases),
    ]);
    for (name, share) in [("p50", 0.5), ("p99", 0.99), ("max", 1.0)] {
        let name = format!("kills: time without a connection, {name}");
        figures.push(free(&name, "s", quantile(&reconnected, share)));
    }
    figures.push(at_most("kills: other errors", "", 0.0, simulation.errors()));
    Ok(figures)
}

/// Reads the records of all vehicles; returns their number. Each vehicle must have each number
/// once, to the last one that was acknowledged.
async fn stored(members: &FleetMembers<'_>, simulation: &Simulation) -> Result<f64, String> {
    let mut administrator = Administrator::connect(members.people, members.token).await?;
    let mut all = 0;
    for vehicle in members.identities {
        let path = format!("/v1/vehicles/{}/events", vehicle.name);
        let lines = administrator.bytes(Method::GET, &path, None, Vec::new()).await?;
        let mut times = BTreeMap::<u64, u64>::new();
        for line in lines.split(|byte| *byte == b'\n').filter(|line| !line.is_empty()) {
            let line: StoredLine =
                serde_json::from_slice(line).map_err(|error| error.to_string())?;
            if line.kind != "event" {
                simulation.loss(format!("{}: a line of kind `{}`", vehicle.name, line.kind));
            }
            *times.entry(line.seq).or_default() += 1;
        }
        let acknowledged = simulation.end_of(&vehicle.name);
        let is_whole = (0..acknowledged).all(|seq| times.contains_key(&seq));
        if !is_whole || times.values().any(|count| *count != 1) {
            simulation.loss(format!("{}: {acknowledged} acknowledged", vehicle.name));
        }
        all += times.len();
    }
    Ok(all as f64)
}
