//! `gleaner fleet`, and the commands with `--fleet`: deployments of a cloud.

use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, visible};
use gleaner_fleet::people::{FleetDeployment, ReportedRelease, VehicleSummary};
use gleaner_trust::SecretKey;
use hyper::Method;
use serde_json::json;

use super::plan::{FleetPlan, Selector, selects};
use super::rollout::{Goal, Rollout};
use super::{client, list, show, waves};
use crate::args::{ChangeArgs, DeployArgs, FleetArgs, FleetCommand};
use crate::render::table;
use crate::vehicle::{LocalRevision, VehicleClient, labels_in_words, path, short};

/// Time in which a vehicle that has connected reports its labels.
const LABELS: Duration = Duration::from_secs(2);

#[derive(Clone, Copy)]
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
        let waves = deployment.waves.as_ref().map(waves::describe);
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
            let selector = labels_in_words(&it.selector);
            let failed = match it.on_fallback {
                0 => it.failed.to_string(),
                count => format!("{}, of which {count} run the fallback", it.failed),
            };
            [
                visible(&it.id),
                it.release.to_string(),
                short(&it.revision),
                if selector.is_empty() { "all".to_owned() } else { selector },
                if it.is_wanted { "active" } else { "stopped" }.to_owned(),
                it.vehicles.to_string(),
                it.running.to_string(),
                failed,
            ]
        });
        let mut text = table(&head, rows, &[1, 5, 6]);
        for (it, waves) in deployments.iter().filter_map(|it| Some((it, it.waves.as_ref()?))) {
            text += &format!("{}: {}\n", visible(&it.id), waves::describe(waves));
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
    // Vehicles that the waves have not reached do not have it.
    let all = |it: &FleetDeployment| it.waves.as_ref().map_or(it.vehicles, |it| it.vehicles);
    let failed = before.as_ref().map(|before| (before.failed, all(before)));
    let next = local.next(&client, args, &key, failed)?;
    let labels = next.deployment.selector.iter();
    let selector: Selector =
        labels.map(|(name, value)| (name.to_string(), value.clone())).collect();
    let before: Vec<&Selector> = before
        .iter()
        .flat_map(|it| std::iter::once(&it.selector).chain(&it.older_selectors))
        .collect();
    let (plan, vehicles) = plan(&client, &before, &selector)?;
    let reported: Vec<ReportedRelease> = client.get(&format!("{}/reported", path(&id)?))?;
    // Others do not get it.
    let is_chosen = |it: &&ReportedRelease| {
        vehicles.iter().any(|vehicle| vehicle.name == it.vehicle && selects(&selector, vehicle))
    };
    next.announce(args, reported.iter().find(is_chosen))?;
    let json = args.vehicle.json;
    plan.confirm(&id, &selector, (args.yes, json))?;
    let envelope = local.deploy(&client, args, &next.deployment, &key)?.envelope;
    if args.waves.plan().is_some() && !waves::wait(&client, &id, &envelope, args)? {
        return Ok(Exit::Ok);
    }
    let goal = Goal::Revision { release: next.deployment.release };
    let rollout = Rollout { id, selector, envelope: Some(envelope), goal, plan };
    rollout.wait(&client, json, args.timeout)
}

/// Returns the plan of a deployment. A vehicle that has just connected reports its labels a moment
/// later: that is waited for if no vehicle matches.
fn plan(
    client: &VehicleClient,
    before: &[&Selector],
    selector: &Selector,
) -> Result<(FleetPlan, Vec<VehicleSummary>), Failure> {
    let started = Instant::now();
    loop {
        let vehicles: Vec<VehicleSummary> = list::all(client, "/v1/vehicles", &[])?;
        let plan = FleetPlan::of_deployment(&vehicles, before, selector);
        if plan.matches_any() || vehicles.is_empty() || started.elapsed() >= LABELS {
            return Ok((plan, vehicles));
        }
        thread::sleep(LABELS / 10);
    }
}

/// Runs `gleaner rollback`, `start`, `stop` and `remove` with `--fleet`.
pub(crate) fn change(args: &ChangeArgs, change: Change) -> Result<Exit, Failure> {
    let (path, client) = (path(&args.id)?, client()?);
    let found = deployments(&client)?.into_iter().find(|it| it.id == args.id);
    let FleetDeployment { id, selector, older_selectors, envelope, waves, version, .. } = found
        .ok_or_else(|| {
            Failure::new(Exit::Usage, format!("the cloud has no deployment `{}`", args.id))
                .with_help("`gleaner fleet` lists them")
        })?;
    let vehicles: Vec<VehicleSummary> = list::all(&client, "/v1/vehicles", &[])?;
    let (method, end, goal, removal) = match change {
        Change::Rollback => (Method::POST, "/rollback", Goal::Fallback, None),
        Change::Start => (Method::POST, "/start", Goal::Running, None),
        Change::Stop => (Method::POST, "/stop", Goal::Stopped, Some("stops on")),
        Change::Remove => (Method::DELETE, "", Goal::Removed, Some("is removed from")),
    };
    let mut plan = FleetPlan::default();
    if let Some(removal) = removal {
        let had: Vec<_> = std::iter::once(&selector).chain(&older_selectors).collect();
        plan = FleetPlan::of_removal(&vehicles, &had, removal);
        plan.confirm(&id, &selector, (args.yes, args.vehicle.json))?;
    }
    // What was planned is changed, and nothing that came since.
    let version = Some(&*version).filter(|version| !version.is_empty());
    client.change(method, &format!("{path}{end}"), version)?;
    // In waves, vehicles run different ones.
    let envelope = Some(envelope).filter(|it| waves.is_none() && !it.is_empty());
    let rollout = Rollout { id, selector, envelope, goal, plan };
    rollout.wait(&client, args.vehicle.json, args.timeout)
}

pub(super) fn deployments(client: &VehicleClient) -> Result<Vec<FleetDeployment>, Failure> {
    list::all(client, "/v1/deployments", &[])
}
