//! A fleet connects, is idle, reports and sends records, and gets a deployment.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use gleaner_bench::{Figure, quantile};
use gleaner_fleet::people::{FleetDeployment, ListPage};
use hyper::Method;
use tokio::time::{Instant, sleep, timeout};

use crate::administrator::Administrator;
use crate::figure::{at_most, free};
use crate::fleet::EnrolledFleet;
use crate::identity::SimulatedIdentity;
use crate::release::SignedRelease;
use crate::simulation::{FleetLoad, Simulation};
use crate::vehicle::{be_silent, open};

/// Longest pause between attempts to connect, as of a real vehicle.
const PAUSE_MAX: Duration = Duration::from_secs(300);
/// Interval of reports and batches of an active vehicle, and the number of records in a batch.
const INTERVAL: Duration = Duration::from_secs(5);
const RECORDS: u64 = 4;
/// Number of vehicles that send no sign of life.
const SILENT: usize = 5;
/// Longest time to wait for the fleet to do something.
const PATIENCE: Duration = Duration::from_secs(120);

/// The duration of the parts.
pub struct LoadTimes {
    /// Time without load, of which the second half is measured.
    pub idle: Duration,
    /// Time under load, apart from the deployment.
    pub active: Duration,
    /// True to wait for the end of silent connections, which takes a minute.
    pub has_silent: bool,
}

/// Measures `count` vehicles.
pub async fn figures(count: usize, times: &LoadTimes) -> Result<Vec<Figure>, String> {
    let fleet = EnrolledFleet::enrol(count + SILENT + 1).await?;
    let cloud = &fleet.cloud;
    let mut figures = Vec::new();
    let mut add = |figure: Figure| {
        println!("{figure}");
        figures.push(figure);
    };
    add(free("vehicles", "", count as f64));
    add(free("enrolment of all", "s", fleet.enrolled_s));
    let of_each = |kb: f64| kb / count as f64;

    let (fresh_kb, cpu_s) = (cloud.memory_kb(), cloud.cpu_s());
    let (simulation, _vehicles) = fleet.start(count, PAUSE_MAX);
    let connected = simulation.until(PATIENCE, |it| it.connected.load(Relaxed) == count).await;
    let connected = connected.map_or(f64::INFINITY, |it| it.as_secs_f64());
    add(at_most("all connected after", "s", 15.0, connected));
    add(free("CPU of the cloud to connect all", "s", cloud.cpu_s() - cpu_s));

    sleep(times.idle / 2).await;
    let cpu_s = cloud.cpu_s();
    sleep(times.idle / 2).await;
    let idle_cores = (cloud.cpu_s() - cpu_s) / times.idle.as_secs_f64() * 2.0;
    add(free("idle: cores of the cloud", "cores", idle_cores));
    let idle_kb = of_each(cloud.memory_kb() - fresh_kb);
    add(at_most("memory per idle vehicle", "kB", 20.0, idle_kb));

    let silent: Vec<_> = fleet.vehicles[count..count + SILENT].to_vec();
    let silent = silent.into_iter().filter(|_| times.has_silent);
    let silent =
        silent.map(|identity| tokio::spawn(measure_silence(identity, Arc::clone(&simulation))));
    let silent: Vec<_> = silent.collect();

    let (cpu_s, reports) = (cloud.cpu_s(), simulation.reports.load(Relaxed));
    let begun = Instant::now();
    simulation.load.send_replace(FleetLoad { interval: Some(INTERVAL), records: RECORDS });
    sleep(times.active).await;
    let active_s = begun.elapsed().as_secs_f64();
    let reports = (simulation.reports.load(Relaxed) - reports) as f64;
    let acknowledged = simulation.take_acknowledged_ms();
    add(free("active: cores of the cloud", "cores", (cloud.cpu_s() - cpu_s) / active_s));
    add(free("active: reports", "1/s", reports / active_s));
    let batches = acknowledged.len() as f64 / active_s;
    add(free("active: batches of records", "1/s", batches));
    for (name, share) in [("p50", 0.5), ("p99", 0.99), ("max", 1.0)] {
        let name = format!("active: batch to acknowledgement, {name}");
        add(free(&name, "ms", quantile(&acknowledged, share)));
    }
    let active_kb = of_each(cloud.memory_kb() - fresh_kb);
    add(at_most("memory per active vehicle", "kB", 50.0, active_kb));

    let mut administrator = fleet.administrator().await?;
    let cpu_s = cloud.cpu_s();
    let p99 = measure_deployment(count, &simulation, &mut administrator).await?;
    add(at_most("a deployment is applied by 99 % after", "s", 30.0, p99));
    add(free("CPU of the cloud for it", "s", cloud.cpu_s() - cpu_s));
    simulation.until(PATIENCE, |it| it.applied_s().len() >= count).await;
    // The cloud closes connections without a request.
    let mut administrator = fleet.administrator().await?;
    let begun = Instant::now();
    let all: ListPage<FleetDeployment> = administrator.get("/v1/deployments").await?;
    add(free("list of deployments", "s", begun.elapsed().as_secs_f64()));
    if all.items.first().map(|it| it.running) != Some(count as u64) {
        simulation.error(format!("of {count} vehicles, these run it: {all:?}"));
    }

    let revoked = &fleet.vehicles[count + SILENT];
    let cut_s = measure_removal(revoked, &simulation, &mut administrator).await?;
    add(at_most("a revoked vehicle is disconnected after", "s", 5.0, cut_s));
    let mut silent_s = Vec::new();
    for link in silent {
        silent_s.push(link.await.map_err(|error| error.to_string())?);
    }
    if times.has_silent {
        let longest = quantile(&silent_s, 1.0);
        add(at_most("a silent connection is ended after", "s", 60.5, longest));
    }
    add(at_most("errors", "", 0.0, simulation.errors() + simulation.losses()));
    Ok(figures)
}

/// Returns the time in s after which the connection of a silent vehicle is ended.
async fn measure_silence(identity: SimulatedIdentity, simulation: Arc<Simulation>) -> f64 {
    let begun = Instant::now();
    let end = timeout(PATIENCE, be_silent(&identity, &simulation)).await;
    match end {
        Ok(Ok(reason)) if reason == "no sign of life" => begun.elapsed().as_secs_f64(),
        other => {
            simulation.error(format!("a silent connection: {other:?}"));
            f64::INFINITY
        }
    }
}

/// Makes a deployment; returns the time in s after which 99 % of `count` vehicles report it.
async fn measure_deployment(
    count: usize,
    simulation: &Simulation,
    administrator: &mut Administrator,
) -> Result<f64, String> {
    let release = simulation.begun.elapsed().as_secs() + 1;
    simulation.await_release(release);
    SignedRelease::new(release, None)?.deploy(administrator).await?;
    let most = count * 99 / 100;
    simulation.until(PATIENCE, |it| it.applied_s().len() >= most).await;
    let applied = simulation.applied_s();
    Ok(match applied.len() >= most {
        true => quantile(&applied, most as f64 / applied.len() as f64),
        false => f64::INFINITY,
    })
}

/// Removes a vehicle; returns the time in s after which its connection is ended.
async fn measure_removal(
    identity: &SimulatedIdentity,
    simulation: &Simulation,
    administrator: &mut Administrator,
) -> Result<f64, String> {
    let (mut socket, _) = open(identity, simulation).await?;
    let begun = Instant::now();
    let path = format!("/v1/vehicles/{}", identity.name);
    administrator.bytes(Method::DELETE, &path, None, Vec::new()).await?;
    let ended =
        async { while let Some(Ok(_)) = futures_util::StreamExt::next(&mut socket).await {} };
    let ended = timeout(PATIENCE, ended).await;
    Ok(ended.map_or(f64::INFINITY, |()| begun.elapsed().as_secs_f64()))
}
