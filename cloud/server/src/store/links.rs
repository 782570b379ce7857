//! Connections of vehicles: their beginnings, and the reports that come by them.

use std::collections::{BTreeMap, HashMap};

use gleaner_base::{excerpt, in_one_line};
use gleaner_fleet::{Cursor, Hello, WantedProblem};
use gleaner_protocol::supervision::LambdaPhase;
use gleaner_protocol::vehicle_api::{DeploymentStatus, VehicleStatus};

use super::numbers::check_number;
use super::vehicles::{FAILED, PENDING, RUNNING, ended, json};
use super::wants::{WishedVehicle, map};
use super::writer::{DOUBLE, GroupVehicles, VehicleWrite, Waiting, WaitingWrite, counting};
use super::{CloudStore, StoreChange, int, now, now_ms, parts, unsigned};
use crate::error::{CloudError, CloudResult};
use crate::sqlx::{self, AssertSqlSafe};

/// Maximum number of deployments in a report that count.
const DEPLOYMENTS_MAX: usize = 1000;

#[derive(Debug, Default, Clone, PartialEq)]
pub(crate) struct VehicleReport {
    /// Number of the newest wanted state that it has handled.
    pub(crate) handled: u64,
    pub(crate) problems: Vec<WantedProblem>,
    pub(crate) version: String,
    /// Its labels; `None` keeps those of before.
    pub(crate) labels: Option<BTreeMap<String, String>>,
    /// The state of each deployment that it has or refuses, by its id and the SHA-256 of its
    /// envelope.
    pub(crate) states: BTreeMap<(String, String), DeploymentState>,
    /// Number of the deployments that it has.
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
            let reason = excerpt(&it.in_words());
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
    name: String,
    certificate: String,
    version: String,
    key: String,
    /// Number of the newest wanted state that it has followed.
    followed: u64,
    /// Boot of its machine.
    boot: String,
    /// The process that has the connection.
    replica: String,
}

impl VehicleWrite for ConnectWrite {
    /// The number of the connection, and the positions of all streams of its vehicle.
    type Done = (u64, Vec<Cursor>);

    const WAITING: fn(Waiting<Self>) -> WaitingWrite = WaitingWrite::Connect;

    fn vehicle(&self) -> &str {
        &self.name
    }
}

/// A report to store, if the connection still counts.
pub(super) struct ReportWrite {
    name: String,
    epoch: u64,
    report: VehicleReport,
}

impl VehicleWrite for ReportWrite {
    /// True if the wanted state has changed with the labels.
    type Done = bool;

    const WAITING: fn(Waiting<Self>) -> WaitingWrite = WaitingWrite::Report;

    fn vehicle(&self) -> &str {
        &self.name
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
        check_number("twice the followed wanted state", hello.followed.saturating_mul(2))?;
        let (name, certificate) = (name.to_owned(), certificate.to_owned());
        let (version, key) = (excerpt(&hello.version), excerpt(&hello.key));
        let (followed, boot) = (hello.followed, excerpt(&hello.boot));
        let replica = self.replica().to_owned();
        self.write(ConnectWrite { name, certificate, version, key, followed, boot, replica }).await
    }

    /// Stores a report, if the connection still counts; returns whether the vehicle's wanted state
    /// has changed with its labels.
    pub(crate) async fn report(
        &self,
        name: &str,
        epoch: u64,
        report: VehicleReport,
    ) -> CloudResult<bool> {
        report.check_numbers()?;
        self.write(ReportWrite { name: name.to_owned(), epoch, report }).await
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
type Certificates = HashMap<String, Vec<(String, i64)>>;

impl StoreChange<'_> {
    pub(super) async fn connect_all(
        &mut self,
        vehicles: &mut GroupVehicles,
        connects: &mut [&mut Waiting<ConnectWrite>],
    ) -> CloudResult<()> {
        let names: Vec<_> = connects.iter().map(|it| &*it.write.name).collect();
        let mut certificates = self.certificates_of(&names).await?;
        let mut replaced = Vec::new();
        // The newest connection of each vehicle.
        let mut begun = BTreeMap::new();
        for waiting in connects.iter_mut() {
            let ConnectWrite { name, certificate, followed, boot, .. } = &waiting.write;
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
            replaced
                .extend(all.extract_if(.., |(_, end)| *end < expires).map(|(sha256, _)| sha256));
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
        let mut cursors = self.cursors_of(&begun.keys().collect::<Vec<_>>()).await?;
        let mut rows = Vec::new();
        for waiting in connects.iter_mut() {
            let ConnectWrite { name, version, key, replica, .. } = &waiting.write;
            let Some(Ok((epoch, positions))) = &mut waiting.result else { continue };
            if let Some(vehicle) = begun.get(name).filter(|it| it.epoch == int(*epoch)) {
                *positions = cursors.remove(name).unwrap_or_default();
                let [boot, former] = &vehicle.boots;
                rows.push((name, vehicle, [version, key, replica, boot, former]));
            }
        }
        for part in parts(&rows) {
            let sql = format!(
                "INSERT INTO vehicles
                 (name, epoch, generation, offered, is_ahead, is_double, version, clip_key, replica,
                 boot, former_boot, seen) VALUES {} ON CONFLICT (name) DO UPDATE SET epoch = excluded.epoch,
                 generation = excluded.generation, offered = excluded.offered,
                 is_ahead = excluded.is_ahead, is_double = excluded.is_double,
                 boot = excluded.boot, former_boot = excluded.former_boot, version = excluded.version, clip_key = excluded.clip_key,
                 replica = excluded.replica, seen = excluded.seen",
                self.placeholders(part.len(), 12)
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for (name, it, texts) in part {
                query = query.bind(*name).bind(it.epoch).bind(it.generation).bind(it.offered);
                query = query.bind(it.is_ahead).bind(it.is_double);
                query = texts.iter().fold(query, |query, text| query.bind(*text)).bind(now());
            }
            query.execute(&mut *self.tx).await?;
        }
        let doubles = begun.iter().filter(|(_, it)| it.is_double == DOUBLE);
        let doubles: Vec<_> = doubles.map(|(name, _)| name).collect();
        self.run_in("UPDATE vehicles SET is_double = 2 WHERE name IN", &doubles).await?;
        self.run_in("DELETE FROM certificates WHERE sha256 IN", &replaced).await
    }

    async fn certificates_of(&mut self, names: &[&str]) -> CloudResult<Certificates> {
        let mut certificates = Certificates::new();
        let rows: Vec<(String, String, i64)> = rows_in!(&mut *self.tx;
            "SELECT vehicle, sha256, expires FROM certificates WHERE vehicle IN ()"; names);
        for (vehicle, sha256, expires) in rows {
            certificates.entry(vehicle).or_default().push((sha256, expires));
        }
        // A vehicle whose name came twice was read twice.
        for all in certificates.values_mut() {
            all.sort_unstable();
            all.dedup();
        }
        Ok(certificates)
    }

    /// Stores reports of connections that still count.
    pub(super) async fn report_all(
        &mut self,
        vehicles: &mut GroupVehicles,
        reports: &mut [&mut Waiting<ReportWrite>],
    ) -> CloudResult<()> {
        let mut relabeled = Vec::new();
        // The newest report of each vehicle; states are new if those of any report are.
        let mut rows: BTreeMap<&str, (&VehicleReport, bool)> = BTreeMap::new();
        for waiting in reports.iter_mut() {
            let ReportWrite { name, epoch, report } = &mut waiting.write;
            let vehicle = match counting(vehicles, name, int(*epoch)) {
                Ok(vehicle) => vehicle,
                Err(error) => {
                    waiting.result = Some(Err(error));
                    continue;
                }
            };
            waiting.result = Some(Ok(false));
            let has_new_states = rows.get(&**name).is_some_and(|(_, before)| *before);
            let labels = json(report.labels.get_or_insert_with(|| map(&vehicle.labels)));
            rows.insert(&**name, (&*report, has_new_states || report.has_new_states));
            if labels != vehicle.labels {
                vehicle.labels.clone_from(&labels);
                let digest = vehicle.digest.clone();
                relabeled.push(WishedVehicle { name: name.clone(), labels, digest });
            }
        }
        let rows: Vec<_> = rows.into_iter().collect();
        self.store_reports(&rows).await?;
        let changed: Vec<_> = rows.iter().filter(|(_, (_, is_new))| *is_new).collect();
        self.store_states(&changed.iter().map(|(name, (it, _))| (*name, *it)).collect::<Vec<_>>())
            .await?;
        let changed = self.refresh(relabeled).await?;
        for waiting in reports.iter_mut() {
            if let Some(Ok(has_changed)) = &mut waiting.result {
                *has_changed = changed.contains(&waiting.write.name);
            }
        }
        Ok(())
    }

    async fn store_reports(&mut self, rows: &[(&str, (&VehicleReport, bool))]) -> CloudResult<()> {
        for part in parts(rows) {
            let sql = format!(
                "INSERT INTO vehicles
                 (name, handled, problems, status, reported_ms, labels, deployments, running,
                 version)
                 VALUES {} ON CONFLICT (name) DO UPDATE SET handled = excluded.handled,
                 problems = excluded.problems, status = excluded.status,
                 reported_ms = excluded.reported_ms, labels = excluded.labels,
                 deployments = excluded.deployments, running = excluded.running,
                 version = excluded.version",
                self.placeholders(part.len(), 9)
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for (name, (report, _)) in part {
                let states = report.states.values();
                let running = states.filter(|it| it.state == RUNNING).count();
                query = query
                    .bind(*name)
                    .bind(int(report.handled))
                    .bind(json(&report.problems))
                    .bind(&report.status)
                    .bind(now_ms())
                    .bind(json(&report.labels))
                    .bind(int(report.deployments))
                    .bind(int(running as u64))
                    .bind(&report.version);
            }
            query.execute(&mut *self.tx).await?;
        }
        Ok(())
    }

    async fn store_states(&mut self, reports: &[(&str, &VehicleReport)]) -> CloudResult<()> {
        let names: Vec<_> = reports.iter().map(|(name, _)| *name).collect();
        self.run_in("DELETE FROM reported WHERE vehicle IN", &names).await?;
        let states = reports.iter().flat_map(|(name, report)| {
            report.states.iter().map(move |(key, state)| (*name, key, state))
        });
        for part in parts(&states.collect::<Vec<_>>()) {
            let sql = format!(
                "INSERT INTO reported (vehicle, deployment, envelope, number, state, reason,
                 on_fallback) VALUES {}",
                self.placeholders(part.len(), 7)
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for (name, (id, envelope), it) in part {
                query = query.bind(*name).bind(id).bind(envelope).bind(int(it.release));
                query = query.bind(it.state).bind(&it.reason).bind(i64::from(it.on_fallback));
            }
            query.execute(&mut *self.tx).await?;
        }
        Ok(())
    }
}
