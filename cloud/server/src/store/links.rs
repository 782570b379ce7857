//! Connections of vehicles: their beginnings, and the reports that come by them.

use std::collections::{BTreeMap, HashMap};

use gleaner_base::excerpt;
use gleaner_fleet::{Cursor, Hello};
use gleaner_protocol::supervision::LambdaPhase;
use gleaner_protocol::vehicle_api::{DeploymentStatus, VehicleStatus};

use super::vehicles::{FAILED, RUNNING, ended, json};
use super::wants::WishedVehicle;
use super::writer::{GroupVehicles, VehicleWrite, Waiting, WaitingWrite, counting};
use super::{CloudStore, StoreChange, in_list, int, list_parts, now, parts, unsigned};
use crate::error::CloudResult;
use crate::sqlx::{self, AssertSqlSafe};

/// Maximum number of deployments in a report that count.
const DEPLOYMENTS_MAX: usize = 1000;

/// A report of a vehicle, as it is stored.
#[derive(Debug, Default, Clone, PartialEq)]
pub(crate) struct VehicleReport {
    /// Number of the newest wanted state that it has handled.
    pub(crate) handled: u64,
    pub(crate) problems: Vec<String>,
    pub(crate) version: String,
    pub(crate) labels: BTreeMap<String, String>,
    /// Number and state of each deployment, by its id.
    pub(crate) states: BTreeMap<String, (u64, &'static str)>,
    /// The status, as JSON.
    pub(crate) status: String,
    /// False if an earlier report of the connection had the same states.
    pub(crate) has_new_states: bool,
}

impl VehicleReport {
    /// Returns the report of a vehicle with this status, which `json` states.
    pub(crate) fn new(
        handled: u64,
        problems: Vec<String>,
        status: VehicleStatus,
        json: String,
    ) -> Self {
        let deployments = status.deployments.into_iter().take(DEPLOYMENTS_MAX);
        let states = deployments.map(|it| {
            let state = state(&it);
            (it.id, (it.release, state))
        });
        Self {
            handled,
            problems,
            version: excerpt(&status.orchestrator.version),
            states: states.collect(),
            labels: status.labels,
            status: json,
            has_new_states: true,
        }
    }
}

fn state(deployment: &DeploymentStatus) -> &'static str {
    let phase = deployment.status.as_ref().map(|status| status.phase);
    let has_failed = deployment.failed.is_some() || deployment.refused.is_some();
    match phase {
        _ if has_failed => FAILED,
        Some(LambdaPhase::Quarantined) => FAILED,
        Some(LambdaPhase::Running) => RUNNING,
        _ => "other",
    }
}

/// A connection that begins.
pub(super) struct ConnectWrite {
    name: String,
    certificate: String,
    version: String,
    key: String,
    /// The process that has the connection.
    replica: String,
}

impl VehicleWrite for ConnectWrite {
    /// The number of the connection, and the positions of all streams of its vehicle.
    type Done = (u64, Vec<Cursor>);

    fn vehicle(&self) -> &str {
        &self.name
    }

    fn waiting(write: Waiting<Self>) -> WaitingWrite {
        WaitingWrite::Connect(write)
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

    fn vehicle(&self) -> &str {
        &self.name
    }

    fn waiting(write: Waiting<Self>) -> WaitingWrite {
        WaitingWrite::Report(write)
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
        let (name, certificate) = (name.to_owned(), certificate.to_owned());
        let (version, key) = (excerpt(&hello.version), excerpt(&hello.key));
        let replica = self.replica().to_owned();
        self.write(ConnectWrite { name, certificate, version, key, replica }).await
    }

    /// Stores a report, if the connection still counts; returns whether the vehicle's wanted state
    /// has changed with its labels.
    pub(crate) async fn report(
        &self,
        name: &str,
        epoch: u64,
        report: VehicleReport,
    ) -> CloudResult<bool> {
        self.write(ReportWrite { name: name.to_owned(), epoch, report }).await
    }
}

/// Valid certificates by vehicle: the SHA-256 and the end of each.
type Certificates = HashMap<String, Vec<(String, i64)>>;

impl StoreChange<'_> {
    /// Begins connections.
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
            let ConnectWrite { name, certificate, .. } = &waiting.write;
            let all = certificates.entry(name.clone()).or_default();
            let used = all.iter().find(|(sha256, _)| sha256 == certificate);
            let expires = used.map(|(_, expires)| *expires).filter(|expires| *expires > now());
            let vehicle = vehicles.get_mut(name).filter(|it| !it.is_revoked);
            let (Some(expires), Some(vehicle)) = (expires, vehicle) else {
                waiting.result = Some(Err(ended()));
                continue;
            };
            // Used, a certificate is durable on the vehicle, and replaces the former ones.
            replaced
                .extend(all.extract_if(.., |(_, end)| *end < expires).map(|(sha256, _)| sha256));
            vehicle.epoch += 1;
            waiting.result = Some(Ok((unsigned(vehicle.epoch), Vec::new())));
            begun.insert(name.clone(), vehicle.epoch);
        }
        let mut cursors = self.cursors_of(&begun.keys().collect::<Vec<_>>()).await?;
        let mut rows = Vec::new();
        for waiting in connects.iter_mut() {
            let ConnectWrite { name, version, key, replica, .. } = &waiting.write;
            let Some(Ok((epoch, positions))) = &mut waiting.result else { continue };
            if begun.get(name) == Some(&int(*epoch)) {
                *positions = cursors.remove(name).unwrap_or_default();
                rows.push((name, *epoch, [version, key, replica]));
            }
        }
        for part in parts(&rows) {
            let sql = format!(
                "INSERT INTO vehicles (name, epoch, version, clip_key, replica, seen) VALUES {}
                 ON CONFLICT (name) DO UPDATE SET epoch = excluded.epoch,
                 version = excluded.version, clip_key = excluded.clip_key,
                 replica = excluded.replica, seen = excluded.seen",
                self.placeholders(part.len(), 6)
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for (name, epoch, texts) in part {
                query = query.bind(*name).bind(int(*epoch));
                query = texts.iter().fold(query, |query, text| query.bind(*text)).bind(now());
            }
            query.execute(&mut *self.tx).await?;
        }
        self.run_in("DELETE FROM certificates WHERE sha256 IN", &replaced).await
    }

    async fn certificates_of(&mut self, names: &[&str]) -> CloudResult<Certificates> {
        let mut certificates = Certificates::new();
        for part in list_parts(names) {
            let sql = format!(
                "SELECT vehicle, sha256, expires FROM certificates WHERE vehicle IN ({})",
                in_list(part.len())
            );
            let query = sqlx::query_as::<_, (String, String, i64)>(AssertSqlSafe(sql));
            let query = part.iter().fold(query, |query, name| query.bind(*name));
            for (vehicle, sha256, expires) in query.fetch_all(&mut *self.tx).await? {
                certificates.entry(vehicle).or_default().push((sha256, expires));
            }
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
            let ReportWrite { name, epoch, report } = &waiting.write;
            let vehicle = match counting(vehicles, name, int(*epoch)) {
                Ok(vehicle) => vehicle,
                Err(error) => {
                    waiting.result = Some(Err(error));
                    continue;
                }
            };
            waiting.result = Some(Ok(false));
            let has_new_states = rows.get(&**name).is_some_and(|(_, before)| *before);
            rows.insert(name, (report, has_new_states || report.has_new_states));
            let labels = json(&report.labels);
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
                 (name, handled, problems, status, labels, deployments, running, version)
                 VALUES {} ON CONFLICT (name) DO UPDATE SET handled = excluded.handled,
                 problems = excluded.problems, status = excluded.status, labels = excluded.labels,
                 deployments = excluded.deployments, running = excluded.running,
                 version = excluded.version",
                self.placeholders(part.len(), 8)
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for (name, (report, _)) in part {
                let states = report.states.values();
                let running = states.filter(|(_, state)| *state == RUNNING).count();
                query = query
                    .bind(*name)
                    .bind(int(report.handled))
                    .bind(json(&report.problems))
                    .bind(&report.status)
                    .bind(json(&report.labels))
                    .bind(int(report.states.len() as u64))
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
            report.states.iter().map(move |(id, (number, state))| (*name, id, *number, *state))
        });
        for part in parts(&states.collect::<Vec<_>>()) {
            let sql = format!(
                "INSERT INTO reported (vehicle, deployment, number, state) VALUES {}",
                self.placeholders(part.len(), 4)
            );
            let mut query = sqlx::query(AssertSqlSafe(sql));
            for (name, id, number, state) in part {
                query = query.bind(*name).bind(*id).bind(int(*number)).bind(*state);
            }
            query.execute(&mut *self.tx).await?;
        }
        Ok(())
    }
}
