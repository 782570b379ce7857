//! Vehicles: their certificates, their connections and what they have reported.

use std::collections::BTreeMap;

use gleaner_base::excerpt;
use gleaner_fleet::people::VehicleSummary;
use gleaner_trust::VehicleName;

use super::counting::ended;
use super::secrets::SecretKind;
use super::wants::next_wanted;
use super::{ChangeAuthor, CloudStore, StoreChange, int, now, now_ms};
use crate::error::{CloudError, CloudResult};

#[derive(Debug)]
pub(crate) struct Issued {
    pub(crate) certificate: String,
    pub(crate) sha256: String,
    pub(crate) renew: u64,
    pub(crate) expires: u64,
}

impl CloudStore {
    /// Adds a vehicle, or lets one enrol again; returns the one-time token. One that is connected
    /// stays so until the token is used. One that was revoked begins its streams again.
    pub(crate) async fn invite_vehicle(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        name: &str,
    ) -> CloudResult<String> {
        let author = author.into();
        if let Err(reason) = name.parse::<VehicleName>() {
            let refused = CloudError::usage("no vehicle can be enrolled", "use another name");
            return Err(refused.because(reason));
        }
        let mut change = self.change().await?;
        change.begin_request(author).await?;
        change.begin_streams_of_revoked(name).await?;
        run!(change; "INSERT INTO vehicles (name)
             VALUES ($1) ON CONFLICT (name) DO UPDATE SET is_revoked = 0"; name);
        change.drop_secrets(SecretKind::ENROLMENT, name, "").await?;
        let (token, _) = change.add_secret(SecretKind::ENROLMENT, name).await?;
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
        let subject = change.take_secret(SecretKind::ENROLMENT, token).await?;
        // Dropped, the change keeps the token for the vehicle that it is for.
        if subject.as_deref() != Some(name) {
            return Ok(None);
        }
        let issued = issue()?;
        change.add_certificate(name, &issued).await?;
        // Only the machine that has used the token is known from now on.
        run!(change;
            "UPDATE vehicles SET is_double = 0, boot = '', former_boot = '' WHERE name = $1"; name);
        change.commit_noted(name, "enrol", name).await?;
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
        run!(change; "DELETE FROM certificates WHERE vehicle = $1 AND sha256 <> $2"; name, current);
        // The vehicle may have been revoked since the request came.
        let valid: Option<String> = row!(change;
            "SELECT sha256 FROM certificates WHERE sha256 = $1"; current);
        valid.ok_or_else(ended)?;
        change.add_certificate(name, issued).await?;
        change.commit_noted(name, "renew", name).await
    }

    /// Cuts a vehicle off: none of its certificates and tokens is accepted from now on.
    pub(crate) async fn revoke(&self, actor: &str, name: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        // With a higher epoch, no connection to any replica counts, also once it is enrolled again.
        let revoked = run!(change; "UPDATE vehicles SET is_revoked = 1, replica = '', epoch = CASE
             WHEN epoch > 0 THEN epoch + 1 ELSE 0 END WHERE name = $1"; name);
        if revoked.rows_affected() == 0 {
            return Err(unknown(name));
        }
        change.drop_secrets(SecretKind::ENROLMENT, name, "").await?;
        run!(change; "DELETE FROM certificates WHERE vehicle = $1"; name);
        change.commit_noted(actor, "revoke vehicle", name).await
    }

    /// Lets a vehicle follow the state of this cloud although it has followed a newer one.
    pub(crate) async fn agree(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        name: &str,
    ) -> CloudResult<()> {
        let author = author.into();
        let mut change = self.change().await?;
        let found = run!(change; next_wanted!(", is_ahead = 0 WHERE name = $1"); name);
        if found.rows_affected() == 0 {
            return Err(unknown(name));
        }
        change.commit_noted(author.name, "agree to the restored state", name).await
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
        let sql = vehicle_summary!("WHERE name > $1 ORDER BY name LIMIT $2");
        Ok(rows!(self; sql; after, most))
    }

    /// Returns the newest status of a vehicle, as JSON with its age.
    pub(crate) async fn status(&self, name: &str) -> CloudResult<String> {
        let status: Option<(String, i64)> =
            row!(self; "SELECT status, reported_ms FROM vehicles WHERE name = $1"; name);
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
            let sql = "UPDATE vehicles SET seen = $1 WHERE seen < $1 AND name IN ($2..)";
            change.run_in(sql, &names, &values! { time }).await?;
            change.commit().await?;
        }
        Ok(())
    }
}

impl StoreChange<'_> {
    /// Begins the next life of each stream of a vehicle that was revoked, and its list of clips: no
    /// number that a thief may have sent stands for records of the one that is enrolled, and no
    /// mere announcement for its clips.
    async fn begin_streams_of_revoked(&mut self, name: &str) -> CloudResult<()> {
        let revoked: Option<String> = row!(self;
            "SELECT name FROM vehicles WHERE name = $1 AND is_revoked = 1"; name);
        if revoked.is_none() {
            return Ok(());
        }
        for sql in [
            "UPDATE streams SET life = life + 1, next = 0, seq = 0, boot = '', boot_ns = 0
             WHERE vehicle = $1",
            "UPDATE clip_vehicles SET position = '' WHERE vehicle = $1",
            "DELETE FROM clip_words WHERE clip IN (SELECT seq FROM clips
             WHERE vehicle = $1 AND state <> 'stored' AND parts = 0)",
            "DELETE FROM clips WHERE vehicle = $1 AND state <> 'stored' AND parts = 0",
        ] {
            run!(self; sql; name);
        }
        Ok(())
    }

    /// Adds a certificate. In the database, each ends after the former ones, by which the newest
    /// is known.
    async fn add_certificate(&mut self, name: &str, issued: &Issued) -> CloudResult<()> {
        let last: i64 = one!(self;
            "SELECT COALESCE(MAX(expires), 0) FROM certificates WHERE vehicle = $1"; name);
        run!(self; "INSERT INTO certificates (sha256, vehicle, expires) VALUES ($1, $2, $3)";
            &issued.sha256, name, int(issued.expires).max(last + 1));
        Ok(())
    }
}

columns!(VehicleSummary: name, labels, state, seen, version, key, wanted, handled, is_ahead,
    is_double, problems, running, deployments);

/// The state of a vehicle: it is online if a process whose lease has not ended has its newest
/// connection.
macro_rules! vehicle_state {
    () => {
        "CASE WHEN is_revoked <> 0 THEN 'revoked'
         WHEN replica IN (SELECT id FROM replicas) THEN 'online'
         WHEN epoch = 0 THEN 'invited' ELSE 'offline' END AS state"
    };
}
pub(super) use vehicle_state;

/// A query of a [`VehicleSummary`]. `is_double` is [`DOUBLE`](super::counting::DOUBLE) at most.
macro_rules! vehicle_summary {
    ($rest:literal) => {
        concat!(
            "SELECT name, labels, NULLIF(seen, 0) AS seen, NULLIF(version, '') AS version,
             clip_key AS key, generation AS wanted, handled, is_ahead, CASE
             WHEN is_double >= 2 THEN 1 ELSE 0 END AS is_double, problems, running, deployments, ",
            crate::store::vehicles::vehicle_state!(),
            " FROM vehicles ",
            $rest
        )
    };
}
pub(super) use vehicle_summary;

pub(super) fn unknown(name: &str) -> CloudError {
    let message = format!("there is no vehicle `{}`", excerpt(name));
    CloudError::missing(message, "`gleaner vehicles` lists all")
}
