//! Connections of vehicles: their beginnings, and the reports that come by them.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use gleaner_base::{excerpt, in_one_line};
use gleaner_fleet::{Cursor, Hello, WantedProblem};
use gleaner_protocol::supervision::LambdaPhase;
use gleaner_protocol::vehicle_api::{DeploymentStatus, VehicleStatus};

use super::counting::{DOUBLE, GroupVehicles, counting, ended};
use super::numbers::{NUMBER_MAX, check_number};
use super::sql::{json, map};
use super::wants::DesiredVehicle;
use super::writer::{VehicleWrite, Waiting};
use super::{CloudStore, StoreChange, int, now, now_ms, unsigned};
use crate::error::{CloudError, CloudResult};

/// Maximum number of deployments in a report that count.
const DEPLOYMENTS_MAX: usize = 1000;

/// State of a deployment that runs as it should.
pub(super) const RUNNING: &str = "running";
/// State of a deployment that was refused, or whose lambda or revision has failed.
pub(super) const FAILED: &str = "failed";
/// State of a deployment that the vehicle could not fetch yet.
const PENDING: &str = "pending";

#[derive(Debug, Default, Clone, PartialEq)]
pub(crate) struct VehicleReport {
    /// Number of the newest desired state that it has applied.
    pub(crate) handled: u64,
    pub(crate) problems: Vec<WantedProblem>,
    pub(crate) version: String,
    /// Its labels; `None` keeps those of before.
    pub(crate) labels: Option<BTreeMap<String, String>>,
    /// The state of each deployment that it has or refuses, by its id and the SHA-256 of its
    /// envelope.
    pub(crate) states: BTreeMap<(String, String), DeploymentState>,
    pub(crate) deployments: u64,
    /// The status, as JSON.
    pub(crate) status: String,
    /// False if an earlier report of the connection had the same states.
    pub(crate) has_new_states: bool,
}

/// The state of a deployment on a vehicle: [`RUNNING`], [`FAILED`], [`PENDING`], `removed` or
/// `other`; and of one that does not run, the reason.
#[derive(Debug, Default, Clone, PartialEq, Eq, Hash)]
pub(crate) struct DeploymentState {
    /// Number of the release that the vehicle has or had; 0 of one that it does not have.
    pub(crate) release: u64,
    pub(crate) state: &'static str,
    pub(crate) reason: String,
    /// True if it has failed and its fallback runs.
    pub(crate) on_fallback: bool,
}

impl VehicleReport {
    /// Returns the report of a vehicle with this status, which `json` states.
    pub(crate) fn new(
        handled: u64,
        problems: Vec<WantedProblem>,
        status: VehicleStatus,
        json: String,
    ) -> Self {
        let all = status.deployments.len().min(DEPLOYMENTS_MAX);
        let refused = problems.iter().map(|it| {
            let state = if it.is_pending { PENDING } else { FAILED };
            let reason = excerpt(&it.describe());
            (
                (it.deployment.clone(), it.envelope.clone()),
                DeploymentState { state, reason, ..DeploymentState::default() },
            )
        });
        // What it has counts before what it could not change.
        let deployments = status.deployments.into_iter().take(DEPLOYMENTS_MAX).map(|it| {
            let state = state(&it);
            ((excerpt(&it.id), excerpt(&it.envelope)), state)
        });
        let removed = status.removed.iter().take(DEPLOYMENTS_MAX).map(|(id, release)| {
            let state =
                DeploymentState { release: *release, state: "removed", ..Default::default() };
            ((excerpt(id), String::new()), state)
        });
        let states = refused.chain(removed).chain(deployments).collect();
        Self {
            handled,
            problems,
            version: excerpt(&status.orchestrator.version),
            states,
            deployments: all as u64,
            labels: Some(status.labels),
            status: json,
            has_new_states: true,
        }
    }
}

fn state(deployment: &DeploymentStatus) -> DeploymentState {
    let lambda = deployment.status.as_ref();
    let phase = lambda.map(|status| status.phase);
    let quarantined = lambda.filter(|it| it.phase == LambdaPhase::Quarantined);
    // Without a fallback, one whose wakes fault runs on. The status may be of an earlier attempt.
    let tried = lambda.filter(|it| !deployment.is_proven && it.attempt == deployment.attempt);
    let running = tried.filter(|it| it.phase == LambdaPhase::Running);
    let faulty = running.and_then(|it| it.recent.faulty());
    let reason = deployment.refused.as_ref().or(deployment.failed.as_ref());
    let reason = reason.or(quarantined.and_then(|it| it.last_end.as_ref())).or(faulty.as_ref());
    let state = match phase {
        _ if reason.is_some() || quarantined.is_some() => FAILED,
        Some(LambdaPhase::Running) => RUNNING,
        _ => "other",
    };
    let reason = reason.map(|it| excerpt(&in_one_line(it))).unwrap_or_default();
    let on_fallback =
        state == FAILED && deployment.runs_fallback && phase == Some(LambdaPhase::Running);
    DeploymentState { release: deployment.release, state, reason, on_fallback }
}

pub(super) struct ConnectWrite {
    certificate: String,
    version: String,
    key: String,
    /// Number of the newest desired state that it has followed.
    followed: u64,
    boot: String,
    replica: String,
}

impl VehicleWrite for ConnectWrite {
    /// The number of the connection, and the positions of all streams of its vehicle.
    type Done = (u64, Vec<Cursor>);

    /// The first one: older connections of the vehicles do not count any more.
    const TURN: u8 = 0;

    async fn apply(
        change: &mut StoreChange<'_>,
        vehicles: &mut GroupVehicles,
        connects: &mut [&mut Waiting<Self>],
    ) -> CloudResult<()> {
        let names: Vec<_> = connects.iter().map(|it| &*it.vehicle).collect();
        let mut certificates = change.certificates_of(&names).await?;
        let mut replaced = Vec::new();
        // The newest connection of each vehicle.
        let mut begun = BTreeMap::new();
        for waiting in connects.iter_mut() {
            let ConnectWrite { certificate, followed, boot, .. } = &waiting.write;
            let name = &waiting.vehicle;
            let all = certificates.entry(name.clone()).or_default();
            let used = all.iter().find(|(sha256, _)| sha256 == certificate);
            let expires = used.map(|(_, expires)| *expires).filter(|expires| *expires > now());
            let vehicle = vehicles.get_mut(name).filter(|it| !it.is_revoked);
            let (Some(expires), Some(vehicle)) = (expires, vehicle) else {
                waiting.result = Some(Err(ended()));
                continue;
            };
            if !vehicle.admits(boot) {
                waiting.result = Some(Err(double(name)));
                begun.insert(name.clone(), vehicle.clone());
                continue;
            }
            // Used, a certificate is durable on the vehicle, and replaces the former ones.
            let former = all.extract_if(.., |(_, end)| *end < expires);
            replaced.extend(former.map(|(sha256, _)| sha256));
            vehicle.epoch += 1;
            if int(*followed) > vehicle.offered {
                // Also if others have counted the number meanwhile: it stands for another state.
                // Later states have numbers above those that the vehicle knows.
                vehicle.generation = vehicle.generation.max(int(*followed)) + 1;
                vehicle.is_ahead = 1;
            }
            vehicle.offered = vehicle.generation;
            waiting.result = Some(Ok((unsigned(vehicle.epoch), Vec::new())));
            begun.insert(name.clone(), vehicle.clone());
        }
        let mut cursors = change.cursors_of(&begun.keys().collect::<Vec<_>>()).await?;
        let mut rows = Vec::new();
        for waiting in connects.iter_mut() {
            let (name, write) = (&waiting.vehicle, &waiting.write);
            let Some(Ok((epoch, positions))) = &mut waiting.result else { continue };
            if let Some(it) = begun.get(name).filter(|it| it.epoch == int(*epoch)) {
                *positions = cursors.remove(name).unwrap_or_default();
                rows.push(values! {
                    name, it.epoch, it.generation, it.offered, it.is_ahead, it.is_double,
                    &write.version, &write.key, &write.replica, &it.boot, &it.former_boot, now()
                });
            }
        }
        let others = "epoch, generation, offered, is_ahead, is_double, version, clip_key, replica, \
                      boot, former_boot, seen";
        change.upsert(("vehicles", "name", others), &rows).await?;
        let doubles = begun.iter().filter(|(_, it)| it.is_double == DOUBLE);
        let doubles: Vec<_> = doubles.map(|(name, _)| name).collect();
        change
            .run_in("UPDATE vehicles SET is_double = 2 WHERE name IN ($1..)", &doubles, &[])
            .await?;
        change.run_in("DELETE FROM certificates WHERE sha256 IN ($1..)", &replaced, &[]).await
    }
}

/// A report to store, if the connection still counts.
pub(super) struct ReportWrite {
    epoch: u64,
    report: VehicleReport,
}

impl VehicleWrite for ReportWrite {
    /// True if the desired state has changed with the labels.
    type Done = bool;

    const TURN: u8 = 1;

    async fn apply(
        change: &mut StoreChange<'_>,
        vehicles: &mut GroupVehicles,
        reports: &mut [&mut Waiting<Self>],
    ) -> CloudResult<()> {
        let mut relabeled = Vec::new();
        // The newest report of each vehicle; states are new if those of any report are.
        let mut rows: BTreeMap<&str, (&VehicleReport, bool)> = BTreeMap::new();
        for waiting in reports.iter_mut() {
            let (name, ReportWrite { epoch, report }) = (&waiting.vehicle, &mut waiting.write);
            let vehicle = counting(vehicles, name, int(*epoch))
                .map_err(|error| waiting.result = Some(Err(error)));
            let Ok(vehicle) = vehicle else { continue };
            waiting.result = Some(Ok(false));
            let has_new_states = rows.get(&**name).is_some_and(|(_, before)| *before);
            let labels = json(report.labels.get_or_insert_with(|| map(&vehicle.labels)));
            rows.insert(&**name, (&*report, has_new_states || report.has_new_states));
            if labels != vehicle.labels {
                vehicle.labels.clone_from(&labels);
                let digest = vehicle.digest.clone();
                relabeled.push(DesiredVehicle { name: name.clone(), labels, digest });
            }
        }
        let all = rows.iter().map(|(name, (report, _))| {
            let running = report.states.values().filter(|it| it.state == RUNNING).count();
            values! {
                *name, report.handled, json(&report.problems), &report.status, now_ms(),
                json(&report.labels), report.deployments, running, &report.version
            }
        });
        let others =
            "handled, problems, status, reported_ms, labels, deployments, running, version";
        change.upsert(("vehicles", "name", others), &all.collect::<Vec<_>>()).await?;
        let changed = rows.into_iter().filter(|(_, (_, is_new))| *is_new);
        let changed: Vec<_> = changed.map(|(name, (report, _))| (name, report)).collect();
        change.store_states(&changed).await?;
        let changed = change.refresh(relabeled).await?;
        for waiting in reports.iter_mut() {
            if let Some(Ok(has_changed)) = &mut waiting.result {
                *has_changed = changed.contains(&waiting.vehicle);
            }
        }
        Ok(())
    }
}

impl CloudStore {
    /// Begins a connection of a vehicle; returns its number, and the positions of all streams.
    /// `certificate` is the SHA-256 of its certificate, which may have been replaced since the
    /// request was let in.
    pub(crate) async fn connect(
        &self,
        name: &str,
        certificate: &str,
        hello: &Hello,
    ) -> CloudResult<(u64, Vec<Cursor>)> {
        // It is counted up.
        check_number("twice the followed desired state", hello.followed.saturating_mul(2))?;
        let write = ConnectWrite {
            certificate: certificate.to_owned(),
            version: excerpt(&hello.version),
            key: excerpt(&hello.key),
            followed: hello.followed,
            boot: excerpt(&hello.boot),
            replica: self.replica().to_owned(),
        };
        self.write(name, write).await
    }

    /// Stores a report, if the connection still counts; returns whether the vehicle's desired state
    /// has changed with its labels.
    pub(crate) async fn report(
        &self,
        name: &str,
        epoch: u64,
        report: VehicleReport,
    ) -> CloudResult<bool> {
        check_number("the applied desired state", report.handled)?;
        for ((id, _), state) in &report.states {
            // The name is for an error only.
            if state.release > NUMBER_MAX {
                check_number(format_args!("the release of `{}`", excerpt(id)), state.release)?;
            }
        }
        self.write(name, ReportWrite { epoch, report }).await
    }
}

/// Returns the error of a machine that has come back although another one has its identity.
fn double(name: &str) -> CloudError {
    let message = format!("another machine has the identity of `{name}`, and is let in instead");
    let help = "run `gleaner unenrol --new-identity` on the copy, and enrol it under a name of its \
                own; enrol the other one again";
    CloudError::denied(message, help)
}

/// Valid certificates by vehicle: the SHA-256 and the end of each.
type Certificates = HashMap<String, BTreeSet<(String, i64)>>;

impl StoreChange<'_> {
    async fn certificates_of(&mut self, names: &[&str]) -> CloudResult<Certificates> {
        let mut certificates = Certificates::new();
        let rows: Vec<(String, String, i64)> = rows_in!(self;
            "SELECT vehicle, sha256, expires FROM certificates WHERE vehicle IN ($1..)"; names);
        for (vehicle, sha256, expires) in rows {
            // A vehicle whose name came twice is read twice.
            certificates.entry(vehicle).or_default().insert((sha256, expires));
        }
        Ok(certificates)
    }

    async fn store_states(&mut self, reports: &[(&str, &VehicleReport)]) -> CloudResult<()> {
        let names: Vec<_> = reports.iter().map(|(name, _)| *name).collect();
        self.run_in("DELETE FROM reported WHERE vehicle IN ($1..)", &names, &[]).await?;
        let states = reports.iter().flat_map(|(name, report)| {
            report.states.iter().map(move |((id, envelope), it)| {
                values! { *name, id, envelope, it.release, it.state, &it.reason, it.on_fallback }
            })
        });
        let sql = "INSERT INTO reported
                   (vehicle, deployment, envelope, number, state, reason, on_fallback) VALUES ()";
        self.insert::<i64, 7>(sql, &states.collect::<Vec<_>>()).await.map(drop)
    }
}
