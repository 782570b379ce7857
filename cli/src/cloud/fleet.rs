//! `gleaner fleet`, and the commands with `--fleet`: deployments of a cloud.

use gleaner_base::{Exit, Failure, visible};
use gleaner_fleet::people::{FleetDeployment, VehicleSummary};
use gleaner_protocol::vehicle_api::VehicleStatus;
use gleaner_trust::SecretKey;
use serde_json::{Value, json};

use super::rollout::{Goal, Rollout};
use super::{client, list, show, waves};
use crate::args::{ChangeArgs, DeployArgs, FleetArgs, FleetCommand};
use crate::render::table;
use crate::vehicle::{Former, LocalRevision, VehicleClient, deployment, path};

/// A change of a deployment.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Change {
    Rollback,
    Start,
    Stop,
    Remove,
}

pub(super) fn fleet(args: &FleetArgs) -> Result<Exit, Failure> {
    let (id, change) = match &args.command {
        None => return list(args.json),
        Some(FleetCommand::Pause(args)) => (&args.id, "pause"),
        Some(FleetCommand::Resume(args)) => (&args.id, "resume"),
        Some(FleetCommand::Abort(args)) => (&args.id, "abort"),
    };
    let path = format!("{}/{change}", path(id)?);
    let deployment: FleetDeployment = client()?.post(&path, &json!({}))?;
    show(args.json, &deployment, |deployment| {
        let waves = deployment.waves.as_ref().map(waves::in_words);
        format!("{}: {}\n", visible(&deployment.id), waves.unwrap_or_default())
    })
}

fn list(json: bool) -> Result<Exit, Failure> {
    show(json, &deployments(&client()?)?, |deployments| {
        if deployments.is_empty() {
            return "nothing is deployed: `gleaner deploy --fleet DIR --key FILE`\n".to_owned();
        }
        let head =
            ["id", "release", "revision", "selector", "state", "vehicles", "running", "failed"];
        let rows = deployments.iter().map(|it| {
            let labels = it.selector.iter();
            let labels =
                labels.map(|(name, value)| format!("{}={}", visible(name), visible(value)));
            let selector = labels.collect::<Vec<_>>().join(" ");
            [
                visible(&it.id),
                it.release.to_string(),
                visible(&it.revision.chars().take(12).collect::<String>()),
                if selector.is_empty() { "all".to_owned() } else { selector },
                if it.is_wanted { "wanted" } else { "stopped" }.to_owned(),
                it.vehicles.to_string(),
                it.running.to_string(),
                it.failed.to_string(),
            ]
        });
        let rows = std::iter::once(head.map(str::to_owned)).chain(rows);
        let mut text = table(rows.collect(), &[1, 5, 6, 7]);
        for (it, waves) in deployments.iter().filter_map(|it| Some((it, it.waves.as_ref()?))) {
            text += &format!("{}: {}\n", visible(&it.id), waves::in_words(waves));
        }
        text
    })
}

pub(crate) fn deploy(args: &DeployArgs) -> Result<Exit, Failure> {
    let key = SecretKey::load(&args.key)?;
    let local = LocalRevision::load(args)?;
    let client = client()?;
    let id = local.id(args);
    let before = deployments(&client)?.into_iter().find(|it| it.id == id);
    let newest = match &before {
        Some(before) => before.release,
        None if args.release.is_some() => 0,
        None => newest_on_vehicles(&client, &id)?,
    };
    let former = before.as_ref().map(|before| {
        // A revision that has failed on a vehicle is no fallback.
        let fallback = before.fallback.as_ref().filter(|_| before.failed > 0);
        Former { runs: Some(fallback.unwrap_or(&before.revision)), grants: &before.grants }
    });
    let deployment = deployment(args, &local, &id, former, newest)?;
    local.deploy(&client, args, &deployment, &key)?;
    let selector = deployment.selector.iter();
    let selector = selector.map(|(name, value)| (name.to_string(), value.clone())).collect();
    let release = deployment.release;
    if args.waves.plan().is_some() && !waves::wait(&client, &id, release, args)? {
        return Ok(Exit::Ok);
    }
    let goal = Goal::Revision { release };
    Rollout { id, selector, goal }.wait(&client, args.vehicle.json, args.timeout)
}

/// Runs `gleaner rollback`, `start`, `stop` and `remove` with `--fleet`.
pub(crate) fn change(args: &ChangeArgs, change: Change) -> Result<Exit, Failure> {
    let (path, client) = (path(&args.id)?, client()?);
    let found = deployments(&client)?.into_iter().find(|it| it.id == args.id);
    let FleetDeployment { id, selector, .. } = found.ok_or_else(|| {
        Failure::new(Exit::Usage, format!("the cloud has no deployment `{}`", args.id))
            .with_help("`gleaner fleet` lists them")
    })?;
    let post =
        |change: &str| client.post::<Value>(&format!("{path}/{change}"), &json!({})).map(drop);
    let goal = match change {
        Change::Rollback => post("rollback").map(|()| Goal::Fallback),
        Change::Start => post("start").map(|()| Goal::Running),
        Change::Stop => post("stop").map(|()| Goal::Stopped),
        Change::Remove => client.delete(&path).map(|()| Goal::Removed),
    };
    Rollout { id, selector, goal: goal? }.wait(&client, args.vehicle.json, args.timeout)
}

pub(super) fn deployments(client: &VehicleClient) -> Result<Vec<FleetDeployment>, Failure> {
    list::all(client, "/v1/deployments", &[])
}

/// Returns the newest release of a deployment that a vehicle has or had. It accepts only later
/// ones.
fn newest_on_vehicles(client: &VehicleClient, id: &str) -> Result<u64, Failure> {
    let vehicles: Vec<VehicleSummary> = list::all(client, "/v1/vehicles", &[])?;
    let release = |status: VehicleStatus| {
        let deployments = status.deployments.into_iter().filter(|it| it.id == id);
        deployments.map(|it| it.release).chain(status.removed.get(id).copied()).max()
    };
    // One that has not reported yet has no status.
    let statuses = vehicles
        .iter()
        .filter_map(|vehicle| client.get(&format!("/v1/vehicles/{}/status", vehicle.name)).ok());
    Ok(statuses.filter_map(release).max().unwrap_or(0))
}
