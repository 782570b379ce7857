//! Vehicles: their certificates, their connections and what they have reported.

use std::collections::BTreeMap;

use gleaner_base::excerpt;
use gleaner_fleet::people::{VehicleState, VehicleSummary};
use gleaner_trust::VehicleName;

use super::secrets::SecretKind;
use super::wants::next_wanted;
use super::writer::DOUBLE;
use super::{ChangeAuthor, CloudStore, StoreChange, in_list, int, now, now_ms, parts, unsigned};
use crate::error::{CloudError, CloudResult};
use crate::sqlx::{self, AssertSqlSafe};

/// A certificate that was made for a vehicle.
#[derive(Debug)]
pub(crate) struct Issued {
    pub(crate) certificate: String,
    pub(crate) sha256: String,
    pub(crate) renew: u64,
    pub(crate) expires: u64,
}

impl CloudStore {
    /// Adds a vehicle, or lets one enrol again; returns the one-time token. One that is connected
    /// stays so until the token is used. One that was cut off begins its streams again.
    pub(crate) async fn invite_vehicle(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        name: &str,
    ) -> CloudResult<String> {
        let author = author.into();
        if let Err(reason) = name.parse::<VehicleName>() {
            return Err(
                CloudError::usage("no vehicle can be enrolled", "use another name").because(reason)
            );
        }
        let mut change = self.change().await?;
        change.begin_request(author).await?;
        change.begin_streams_of_revoked(name).await?;
        run!(&mut *change.tx;
            "INSERT INTO vehicles (name) VALUES ($1)
             ON CONFLICT (name) DO UPDATE SET is_revoked = 0";
            name);
        change.drop_secrets(SecretKind::Enrolment, name).await?;
        let (token, _) = change.add_secret(SecretKind::Enrolment, name).await?;
        change.note(author.name, "invite vehicle", name).await?;
        change.refresh_one(name).await?;
        change.commit().await?;
        Ok(token)
    }

    /// Gives a vehicle its certificate for the token; `None` if the token is wrong, used or too
    /// old. Former certificates stay valid until this one is used: if it is lost on its way, or
    /// cannot be stored, the vehicle is not locked out.
    pub(crate) async fn enrol(
        &self,
        name: &str,
        token: &str,
        issue: impl FnOnce() -> CloudResult<Issued>,
    ) -> CloudResult<Option<Issued>> {
        let mut change = self.change().await?;
        let subject = change.take_secret(SecretKind::Enrolment, token).await?;
        // Dropped, the change keeps the token for the vehicle that it is for.
        if subject.as_deref() != Some(name) {
            return Ok(None);
        }
        let issued = issue()?;
        change.add_certificate(name, &issued).await?;
        // Only the machine that has used the token is known from now on.
        run!(&mut *change.tx;
            "UPDATE vehicles SET is_double = 0, boot = '', former_boot = '' WHERE name = $1"; name);
        change.note(name, "enrol", name).await?;
        change.commit().await?;
        Ok(Some(issued))
    }

    /// Stores the next certificate of a vehicle. The current one stays valid until that is used,
    /// and others do not.
    pub(crate) async fn renew(
        &self,
        name: &str,
        current: &str,
        issued: &Issued,
    ) -> CloudResult<()> {
        let mut change = self.change().await?;
        change.drop_certificates(name, current).await?;
        // The vehicle may have been cut off since the request came.
        let is_valid: Option<(String,)> = row!(&mut *change.tx;
            "SELECT sha256 FROM certificates WHERE sha256 = $1"; current);
        is_valid.ok_or_else(ended)?;
        change.add_certificate(name, issued).await?;
        change.note(name, "renew", name).await?;
        change.commit().await
    }

    /// Cuts a vehicle off: none of its certificates and tokens is accepted from now on.
    pub(crate) async fn revoke(&self, actor: &str, name: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        // With a higher epoch, no connection to any replica counts, also once it is enrolled again.
        let revoked = run!(&mut *change.tx;
            "UPDATE vehicles SET is_revoked = 1, replica = '',
             epoch = CASE WHEN epoch > 0 THEN epoch + 1 ELSE 0 END WHERE name = $1";
            name);
        if revoked.rows_affected() == 0 {
            return Err(unknown(name));
        }
        change.drop_secrets(SecretKind::Enrolment, name).await?;
        change.drop_certificates(name, "").await?;
        change.note(actor, "revoke vehicle", name).await?;
        change.commit().await
    }

    /// Lets a vehicle follow the state of this cloud although it has followed a newer one.
    pub(crate) async fn agree(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        name: &str,
    ) -> CloudResult<()> {
        let author = author.into();
        let mut change = self.change().await?;
        let found = run!(&mut *change.tx;
            concat!("UPDATE vehicles SET ", next_wanted!(), ", is_ahead = 0 WHERE name = $1");
            name);
        if found.rows_affected() == 0 {
            return Err(unknown(name));
        }
        change.note(author.name, "agree to the restored state", name).await?;
        change.commit().await
    }

    /// Returns the vehicle with the certificate of this SHA-256, if it is valid.
    pub(crate) async fn vehicle_of(&self, sha256: &str) -> CloudResult<Option<String>> {
        let found = self.certificates.find(sha256).await?;
        Ok(found.filter(|(expires, _)| *expires > now()).map(|(_, name)| name))
    }

    pub(crate) async fn vehicles(
        &self,
        after: &str,
        most: u64,
    ) -> CloudResult<Vec<VehicleSummary>> {
        let rows: Vec<VehicleRow> = rows!(&self.pool;
            concat!(vehicle_columns!(), " WHERE name > $1 ORDER BY name LIMIT $2");
            after, int(most));
        Ok(rows.into_iter().map(summary).collect())
    }

    /// Returns the newest status of a vehicle, as JSON with its age.
    pub(crate) async fn status(&self, name: &str) -> CloudResult<String> {
        let status: Option<(String, i64)> =
            row!(&self.pool; "SELECT status, reported_ms FROM vehicles WHERE name = $1"; name);
        let (status, reported_ms) = status.ok_or_else(|| unknown(name))?;
        // What is stored was parsed as an object, without an age.
        let Some(fields) = status.trim_end().strip_suffix('}') else {
            return Err(CloudError::missing(
                format!("vehicle `{name}` has not reported yet"),
                "enrol it, and start its orchestrator",
            ));
        };
        let age_s = (now_ms() - reported_ms).max(0) as f64 / 1000.0;
        Ok(format!("{fields},\"age_s\":{age_s}}}"))
    }

    /// Stores the times of the last signs of life.
    pub(crate) async fn seen(&self, times: &BTreeMap<String, i64>) -> CloudResult<()> {
        let mut names_of = BTreeMap::<i64, Vec<&String>>::new();
        for (name, time) in times {
            names_of.entry(*time).or_default().push(name);
        }
        for (time, names) in names_of {
            // A transaction for each second, so that what vehicles send does not wait for all.
            let mut change = self.change().await?;
            for part in parts(&names) {
                let (names, last) = (in_list(part.len()), part.len() + 1);
                let sql = format!(
                    "UPDATE vehicles SET seen = ${last} WHERE seen < ${last} AND name IN ({names})"
                );
                let query = sqlx::query(AssertSqlSafe(sql));
                let query = part.iter().fold(query, |query, name| query.bind(*name));
                query.bind(time).execute(&mut *change.tx).await?;
            }
            change.commit().await?;
        }
        Ok(())
    }
}

impl StoreChange<'_> {
    /// Begins the next life of each stream of a vehicle that was cut off, and its list of clips: no
    /// number that a thief may have sent stands for records of the one that is enrolled, and no
    /// mere announcement for its clips.
    async fn begin_streams_of_revoked(&mut self, name: &str) -> CloudResult<()> {
        const IS_REVOKED: &str =
            "EXISTS (SELECT 1 FROM vehicles WHERE vehicles.name = $1 AND is_revoked = 1)";
        const ANNOUNCED: &str = "vehicle = $1 AND state <> 'stored' AND parts = 0";
        for change in [
            "UPDATE streams SET life = life + 1, next = 0, seq = 0, boot = '', boot_ns = 0
             WHERE vehicle = $1",
            "UPDATE clip_vehicles SET position = '' WHERE vehicle = $1",
            &format!(
                "DELETE FROM clip_words WHERE clip IN (SELECT seq FROM clips WHERE {ANNOUNCED})"
            ),
            &format!("DELETE FROM clips WHERE {ANNOUNCED}"),
        ] {
            let sql = format!("{change} AND {IS_REVOKED}");
            sqlx::query(AssertSqlSafe(sql)).bind(name).execute(&mut *self.tx).await?;
        }
        Ok(())
    }

    /// Adds a certificate. In the database, each ends after the former ones, by which the newest
    /// is known.
    async fn add_certificate(&mut self, name: &str, issued: &Issued) -> CloudResult<()> {
        let (last,): (i64,) = one!(&mut *self.tx;
            "SELECT COALESCE(MAX(expires), 0) FROM certificates WHERE vehicle = $1"; name);
        run!(&mut *self.tx;
            "INSERT INTO certificates (sha256, vehicle, expires) VALUES ($1, $2, $3)";
            &issued.sha256, name, int(issued.expires).max(last + 1));
        Ok(())
    }

    async fn drop_certificates(&mut self, name: &str, kept: &str) -> CloudResult<()> {
        run!(&mut *self.tx;
            "DELETE FROM certificates WHERE vehicle = $1 AND sha256 <> $2";
            name, kept);
        Ok(())
    }
}

/// The columns of a [`VehicleRow`].
macro_rules! vehicle_columns {
    () => {
        "SELECT name, is_revoked, epoch, seen, version, labels, generation, handled, problems,
         running, deployments, is_ahead, is_double, clip_key,
         CASE WHEN replica IN (SELECT id FROM replicas) THEN 1 ELSE 0 END FROM vehicles"
    };
}
pub(super) use vehicle_columns;

/// The values from which the summary of a vehicle is made.
pub(super) type VehicleRow =
    (String, i64, i64, i64, String, String, i64, i64, String, i64, i64, i64, i64, String, i64);

pub(super) fn summary(row: VehicleRow) -> VehicleSummary {
    let (name, is_revoked, epoch, seen, version, labels, wanted, handled, problems, ..) = row;
    VehicleSummary {
        labels: serde_json::from_str(&labels).unwrap_or_default(),
        state: vehicle_state(is_revoked, epoch, row.14),
        seen: (seen > 0).then_some(unsigned(seen)),
        version: (!version.is_empty()).then_some(version),
        key: row.13,
        wanted: unsigned(wanted),
        handled: unsigned(handled),
        is_ahead: row.11 != 0,
        is_double: row.12 >= DOUBLE,
        problems: serde_json::from_str(&problems).unwrap_or_default(),
        running: unsigned(row.9),
        deployments: unsigned(row.10),
        name,
    }
}

/// Returns the state of a vehicle with these values. It is online if a process whose lease has not
/// ended has its newest connection.
pub(super) fn vehicle_state(is_revoked: i64, epoch: i64, is_online: i64) -> VehicleState {
    match () {
        () if is_revoked != 0 => VehicleState::Revoked,
        () if is_online != 0 => VehicleState::Online,
        () if epoch == 0 => VehicleState::Invited,
        () => VehicleState::Offline,
    }
}

/// State of a deployment that runs as it should.
pub(super) const RUNNING: &str = "running";
/// State of a deployment that was refused, or whose lambda or revision has failed.
pub(super) const FAILED: &str = "failed";

/// State of a deployment that the vehicle could not fetch yet.
pub(super) const PENDING: &str = "pending";

/// Returns the error of a connection that does not count any more.
pub(super) fn ended() -> CloudError {
    let message = "this connection does not count: the vehicle has a newer one, or was cut off";
    CloudError::denied(message, "connect again")
}

/// Returns the error of a vehicle that does not exist.
pub(super) fn unknown(name: &str) -> CloudError {
    let message = format!("there is no vehicle `{}`", excerpt(name));
    CloudError::missing(message, "`gleaner vehicles` lists all")
}

pub(super) fn json(value: &impl serde::Serialize) -> String {
    serde_json::to_string(value).unwrap_or_default()
}
