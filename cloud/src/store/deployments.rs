//! Deployments of the fleet and their releases.

use std::collections::BTreeMap;

use gleaner_fleet::people::{FleetDeployment, ReportedRelease};
use gleaner_fleet::waves::WavePlan;
use gleaner_protocol::vehicle_api::{GrantStatus, MissingObject};

use super::sql::{TextMap, json};
use super::wants::{COMPLETE, ChangedVehicles};
use super::waves::{ReleaseChoice, newest_releases, unknown};
use super::{ChangeAuthor, CloudStore, StoreChange, int, now, now_ms, unsigned};
use crate::error::{CloudError, CloudResult};

/// Maximum number of deployments: all of them fit into one frame for a vehicle.
const DEPLOYMENTS_MAX: i64 = 4000;

/// Maximum number of releases of a deployment of which none is open to all its vehicles.
const RELEASES_MAX: i64 = 8;

/// Maximum number of deployments that wait for files, which any replica may receive, and the time
/// for which one waits, in s.
const OFFERS_MAX: i64 = 64;
const OFFER_S: i64 = 86_400;

#[derive(Debug, Clone)]
pub(crate) struct OfferedDeployment {
    pub(crate) id: String,
    pub(crate) release: u64,
    pub(crate) envelope: String,
    pub(crate) revision: String,
    pub(crate) fallback: Option<String>,
    pub(crate) grants: GrantStatus,
    pub(crate) selector: TextMap,
    /// The envelope of each revision, by its digest.
    pub(crate) revisions: BTreeMap<String, String>,
    /// The plan of its waves; without one, it is open to all its vehicles at once.
    pub(crate) waves: Option<WavePlan>,
}

impl CloudStore {
    /// Stores a deployment and its revisions; returns the number of the change. The same envelope
    /// again starts it, if it was stopped, and leaves its waves as they are.
    pub(crate) async fn deploy(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        offered: &OfferedDeployment,
    ) -> CloudResult<(u64, ChangedVehicles)> {
        let author = author.into();
        let OfferedDeployment { id, release, envelope, waves, .. } = offered;
        if let Some(Err(reason)) = waves.as_ref().map(WavePlan::check) {
            let help = "correct the options of the waves";
            return Err(CloudError::usage("the plan of the waves is refused", help).because(reason));
        }
        let sha256 = gleaner_trust::sha256(envelope.as_bytes()).to_string();
        let mut change = self.change().await?;
        if let Some(number) = change.begin_request(author).await? {
            return Ok((number.parse().unwrap_or_default(), Vec::new()));
        }
        let before = change.newest(id).await?;
        let is_same = before.as_ref().is_some_and(|before| before.sha256 == sha256);
        if let Some(before) = &before
            && !is_same
            && int(*release) <= before.number
        {
            let stored = before.number;
            let message = format!("deployment `{id}` has release {stored}; this is {release}");
            return Err(CloudError::denied(message, "sign it again with a higher release"));
        }
        let count: i64 = one!(change; "SELECT COUNT(*) FROM deployments");
        if before.is_none() && count >= DEPLOYMENTS_MAX {
            let message = format!("the fleet has {count} deployments; no more are stored");
            return Err(CloudError::denied(message, "remove some that are no longer needed"));
        }
        for (digest, envelope) in &offered.revisions {
            run!(change; "INSERT INTO revisions (digest, envelope)
                 VALUES ($1, $2) ON CONFLICT (digest) DO NOTHING"; digest, envelope);
        }
        run!(change; "INSERT INTO deployments (id, is_wanted)
             VALUES ($1, 1) ON CONFLICT (id) DO UPDATE SET is_wanted = 1"; id);
        let number = change.note(author.name, &format!("deploy release {release}"), id).await?;
        if let Some(key) = author.key {
            run!(change; "UPDATE request_keys SET answer = $3 WHERE actor = $1 AND name = $2";
                author.user, &key.name, number.to_string());
        }
        if before.as_ref().is_some_and(|before| !before.is_wanted) {
            change.restart_wave(id).await?;
        }
        if !is_same {
            change.add_release(offered, &sha256).await?;
        }
        let changed = change.refresh_all().await?;
        change.commit().await?;
        Ok((number, changed))
    }

    /// Starts or stops a deployment. A start also reaches vehicles where it is quarantined.
    pub(crate) async fn set_wanted(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        id: &str,
        is_wanted: bool,
    ) -> CloudResult<ChangedVehicles> {
        let author = author.into();
        let mut change = self.change().await?;
        change.expect(author, id).await?;
        if is_wanted && change.newest(id).await?.is_some_and(|it| !it.is_wanted) {
            change.restart_wave(id).await?;
        }
        if is_wanted {
            // As for a fallback: a number that is above all before.
            run!(change; "UPDATE releases SET start_request = CASE WHEN start_request < $2
                 THEN $2 ELSE start_request + 1 END WHERE deployment = $1"; id, now_ms());
        }
        let sql = "UPDATE deployments SET is_wanted = $2 WHERE id = $1";
        let found = run!(change; sql; id, is_wanted).rows_affected();
        change.finish(found, author.name, if is_wanted { "start" } else { "stop" }, id).await
    }

    /// Requests each vehicle with the newest release to run its fallback. Its waves reach no more
    /// vehicles.
    pub(crate) async fn roll_back(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        id: &str,
    ) -> CloudResult<ChangedVehicles> {
        let author = author.into();
        let (mut change, actor) = (self.change().await?, author.name);
        change.expect(author, id).await?;
        let newest = change.newest_of(id).await?;
        if newest.fallback.is_empty() {
            let message = format!("deployment `{id}` has no fallback");
            return Err(CloudError::usage(message, "deploy the former revision again"));
        }
        change.request_fallback(id, newest.number, &format!("rolled back by {actor}")).await?;
        change.finish(1, actor, "roll back", id).await
    }

    pub(crate) async fn remove_deployment(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        id: &str,
    ) -> CloudResult<ChangedVehicles> {
        let author = author.into();
        let mut change = self.change().await?;
        change.expect(author, id).await?;
        run!(change; "DELETE FROM wave_members WHERE deployment = $1"; id);
        run!(change; "DELETE FROM releases WHERE deployment = $1"; id);
        let found = run!(change; "DELETE FROM deployments WHERE id = $1"; id);
        let found = found.rows_affected();
        change.finish(found, author.name, "remove deployment", id).await
    }

    /// Returns the deployments after this id, at most `most`, each with the number of vehicles that
    /// should run its newest release and do.
    pub(crate) async fn deployments(
        &self,
        after: &str,
        most: u64,
    ) -> CloudResult<Vec<FleetDeployment>> {
        self.some_deployments(ReleaseChoice::Part(after, most)).await
    }

    pub(crate) async fn deployment(&self, id: &str) -> CloudResult<FleetDeployment> {
        self.some_deployments(ReleaseChoice::Of(id)).await?.pop().ok_or_else(|| unknown(id))
    }

    async fn some_deployments(
        &self,
        choice: ReleaseChoice<'_>,
    ) -> CloudResult<Vec<FleetDeployment>> {
        // One transaction: all numbers are of the same moment.
        let mut tx = self.pool.begin().await?;
        let releases = newest_releases(&mut tx, choice).await?;
        let mut deployments = Vec::new();
        for release in releases {
            let all = release.count(&mut tx, false).await?;
            // Vehicles that the waves have not reached do not have the release: no failure.
            let reached = match &*release.state {
                COMPLETE => all,
                _ => release.count(&mut tx, true).await?,
            };
            let waves = release.progress(&reached)?;
            let older_selectors = rows!(&mut *tx; "SELECT DISTINCT selector FROM releases
                 WHERE deployment = $1 AND number <> $2"; &release.deployment, release.number);
            deployments.push(FleetDeployment {
                version: release.version(),
                id: release.deployment,
                release: unsigned(release.number),
                envelope: release.sha256,
                revision: release.revision,
                fallback: (!release.fallback.is_empty()).then_some(release.fallback),
                grants: release.grants,
                selector: release.selector,
                older_selectors,
                is_wanted: release.is_wanted,
                vehicles: all.vehicles,
                running: all.running,
                failed: reached.failed,
                on_fallback: reached.on_fallback,
                waves,
            });
        }
        Ok(deployments)
    }

    /// Returns the highest releases of a deployment that vehicles have reported, at most `most`.
    pub(crate) async fn reported_releases(
        &self,
        id: &str,
        most: i64,
    ) -> CloudResult<Vec<ReportedRelease>> {
        let rows: Vec<(String, u64)> = rows!(self; "SELECT vehicle, number
             FROM reported JOIN vehicles ON name = vehicle WHERE deployment = $1
             AND number > 0 AND is_revoked = 0 ORDER BY number DESC, vehicle LIMIT $2"; id, most);
        let release = |(vehicle, release)| ReportedRelease { vehicle, release };
        Ok(rows.into_iter().map(release).collect())
    }

    pub(crate) async fn newest_envelope(&self, id: &str) -> CloudResult<String> {
        let envelope: Option<String> = row!(self;
            "SELECT envelope FROM releases WHERE deployment = $1 ORDER BY number DESC LIMIT 1"; id);
        envelope.ok_or_else(|| unknown(id))
    }

    /// Accepts these files from now on, for the deployment `id`; without any, none for it.
    pub(crate) async fn await_files(&self, id: &str, files: &[MissingObject]) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(change;
            "DELETE FROM awaited_files WHERE deployment = $1 OR time <= $2"; id, now() - OFFER_S);
        let count: i64 = one!(change; "SELECT COUNT(DISTINCT deployment) FROM awaited_files");
        if !files.is_empty() && count >= OFFERS_MAX {
            let help = "send the files of those that were offered, or wait a day";
            return Err(CloudError::busy("too many deployments wait for files", help));
        }
        for file in files {
            run!(change; "INSERT INTO awaited_files (deployment, sha256, bytes, time)
                 VALUES ($1, $2, $3, $4)"; id, &file.sha256, file.bytes, now());
        }
        change.commit().await
    }

    pub(crate) async fn awaited_length(&self, sha256: &str) -> CloudResult<u64> {
        let bytes: Option<u64> =
            row!(self; "SELECT bytes FROM awaited_files WHERE sha256 = $1"; sha256);
        bytes.ok_or_else(|| {
            let help = "send the deployment first, and then the files that are missing";
            CloudError::usage(format!("no deployment needs the file {sha256}"), help)
        })
    }

    pub(crate) async fn envelope(&self, sha256: &str) -> CloudResult<Option<String>> {
        Ok(self.envelopes.find(sha256).await?.map(|(_, envelope)| envelope))
    }

    pub(crate) async fn revision(&self, digest: &str) -> CloudResult<Option<String>> {
        Ok(self.revisions.find(digest).await?.map(|(_, envelope)| envelope))
    }
}

impl StoreChange<'_> {
    /// Adds a release, and opens it to its vehicles, or its first wave.
    async fn add_release(&mut self, offered: &OfferedDeployment, sha256: &str) -> CloudResult<()> {
        let OfferedDeployment { id, release, envelope, waves, .. } = offered;
        let count: i64 = one!(self; "SELECT COUNT(*) FROM releases WHERE deployment = $1"; id);
        if waves.is_some() && count >= RELEASES_MAX {
            let message = format!(
                "deployment `{id}` has {count} releases, and only the oldest can be open to all"
            );
            return Err(CloudError::denied(message, "deploy this one without waves"));
        }
        // The waves of an older release go on no more: vehicles that have it get this one, too.
        run!(self; "UPDATE releases
             SET state = 'aborted', since = $2, reason = 'as a newer release came'
             WHERE deployment = $1 AND state IN ('running', 'paused')"; id, now());
        run!(self; "INSERT INTO releases (deployment, number,
             sha256, envelope, revision, fallback, grants, selector, rollback_request, state, plan)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, 0, 'running', $9)";
            id, release, sha256, envelope, &offered.revision,
            offered.fallback.as_deref().unwrap_or_default(), json(&offered.grants),
            json(&offered.selector), waves.as_ref().map(json).unwrap_or_default());
        match waves {
            None => self.complete(id, int(*release)).await,
            Some(_) => self.open_wave(id, int(*release), 1).await.map(drop),
        }
    }
}
