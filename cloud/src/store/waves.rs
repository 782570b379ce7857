//! Waves: a release opens to more vehicles only once those before have shown that it works.
//!
//! Each step is one transaction with the counts that it follows from, so that it is taken once.

use axum::http::StatusCode;
use gleaner_base::excerpt;
use gleaner_fleet::waves::{OnFailure, WavePlan, WaveProgress, WaveState};
use gleaner_protocol::vehicle_api::GrantStatus;
use sha2::{Digest, Sha256};

use super::links::{FAILED, RUNNING};
use super::sql::TextMap;
use super::wants::{COMPLETE, ChangedVehicles, selects};
use super::{ChangeAuthor, CloudStore, StoreChange, int, now, now_ms, unsigned};
use crate::error::{CloudError, CloudResult};
use crate::sqlx::AnyConnection;

/// Actor of steps that the cloud takes by a plan.
pub(super) const WAVES: &str = "waves";

/// Time after which a wave does not wait for vehicles that are not connected, in s. It covers
/// several intervals at which signs of life are stored.
pub(super) const AWAY_S: i64 = 120;

typed! {
    #[derive(Debug)]
    pub(super) struct Release {
        pub(super) deployment: String,
        pub(super) number: i64,
        pub(super) sha256: String,
        pub(super) revision: String,
        pub(super) fallback: String,
        pub(super) grants: GrantStatus,
        pub(super) selector: TextMap,
        rollback_request: i64,
        pub(super) state: String,
        plan: String,
        wave: i64,
        since: i64,
        reason: String,
        pub(super) is_wanted: bool,
    }
}

/// Numbers of vehicles of a release, or of its waves.
#[derive(Debug, Default, Clone, Copy, PartialEq)]
pub(super) struct VehicleCount {
    pub(super) vehicles: u64,
    pub(super) running: u64,
    pub(super) failed: u64,
    /// Those of the failed ones that run the fallback.
    pub(super) on_fallback: u64,
    /// Those of the failed ones that a person knew of when the waves went on.
    forgiven: u64,
    /// Those of a wave that fell silent before the end of its soak time, also if they ran it.
    away: u64,
}

typed! {
    /// Vehicles with the same labels and standing.
    struct VehicleGroup {
        labels: TextMap,
        standing: String,
        on_fallback: bool,
        is_forgiven: bool,
        vehicles: u64,
    }
}

#[derive(Debug, PartialEq)]
enum WaveStep {
    Wait,
    /// Opens this wave, to vehicles that came since, too.
    Open(i64),
    Complete,
    Pause(String),
    Rollback(String),
}

#[derive(Debug, Clone, Copy)]
pub(super) enum ReleaseChoice<'c> {
    Of(&'c str),
    /// Those after this id, at most so many.
    Part(&'c str, u64),
}

pub(super) async fn newest_releases(
    tx: &mut AnyConnection,
    choice: ReleaseChoice<'_>,
) -> CloudResult<Vec<Release>> {
    let (is_one, id, most) = match choice {
        ReleaseChoice::Of(id) => (true, id, 1),
        ReleaseChoice::Part(after, most) => (false, after, most),
    };
    Ok(rows!(&mut *tx;
        "SELECT deployment, number, sha256, revision, fallback, grants, selector,
         rollback_request, state, plan, wave, since, reason, is_wanted
         FROM releases JOIN deployments ON deployments.id = releases.deployment
         WHERE number = (SELECT MAX(number) FROM releases AS other
                         WHERE other.deployment = releases.deployment)
         AND CASE WHEN $1 = 1 THEN deployment = $2 ELSE deployment > $2 END
         ORDER BY deployment LIMIT $3"; is_one, id, most))
}

impl CloudStore {
    /// Takes the steps that are due; returns the vehicles whose desired state has changed.
    pub(crate) async fn advance_waves(&self) -> CloudResult<ChangedVehicles> {
        let running: u64 = one!(self; "SELECT COUNT(*) FROM releases WHERE state = 'running'");
        if running == 0 {
            return Ok(Vec::new());
        }
        let mut change = self.change().await?;
        let mut has_changed = false;
        for release in newest_releases(&mut change.tx, ReleaseChoice::Part("", u64::MAX)).await? {
            if release.state != "running" || !release.is_wanted {
                continue;
            }
            let count = release.count(&mut change.tx, true).await?;
            let mut step = release.next(&count, now())?;
            if let WaveStep::Pause(reason) | WaveStep::Rollback(reason) = &mut step {
                *reason += &release.failure(&mut change.tx).await?;
            }
            has_changed |= change.take_step(&release, step).await?;
        }
        if !has_changed {
            return Ok(Vec::new());
        }
        let changed = change.refresh_all().await?;
        change.commit().await?;
        Ok(changed)
    }

    /// Pauses, resumes or aborts the waves of the newest release.
    pub(crate) async fn steer_waves(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        id: &str,
        state: WaveState,
    ) -> CloudResult<ChangedVehicles> {
        let author = author.into();
        let (mut change, actor) = (self.change().await?, author.name);
        change.expect(author, id).await?;
        let newest = change.newest_of(id).await?;
        let refused = match (&*newest.state, state) {
            (COMPLETE, _) => Some("is open to all its vehicles"),
            ("aborted", WaveState::Running | WaveState::Paused) => Some("was aborted"),
            _ => None,
        };
        if let Some(reason) = refused {
            let message = format!("release {} of `{id}` {reason}", newest.number);
            return Err(CloudError::usage(message, "deploy a release with waves"));
        }
        let (name, reason, action) = match state {
            WaveState::Running => ("running", String::new(), "resume waves"),
            WaveState::Paused => ("paused", format!("by {actor}"), "pause waves"),
            WaveState::Aborted => ("aborted", format!("by {actor}"), "abort waves"),
        };
        if name != newest.state {
            run!(change; "UPDATE releases SET state = $3, since = $4, reason = $5
                 WHERE deployment = $1 AND number = $2"; id, newest.number, name, now(), reason);
        }
        // Who resumes waves has seen the failures so far; those of other vehicles count.
        if state == WaveState::Running {
            run!(change; "UPDATE wave_members SET is_forgiven = 1
                 WHERE deployment = $1 AND number = $2 AND vehicle IN (SELECT vehicle FROM reported
                 WHERE deployment = $1 AND envelope = $3 AND state = $4)";
                id, newest.number, &newest.sha256, FAILED);
        }
        change.finish(1, actor, action, id).await
    }
}

impl StoreChange<'_> {
    pub(super) async fn newest(&mut self, id: &str) -> CloudResult<Option<Release>> {
        Ok(newest_releases(&mut self.tx, ReleaseChoice::Of(id)).await?.pop())
    }

    pub(super) async fn newest_of(&mut self, id: &str) -> CloudResult<Release> {
        self.newest(id).await?.ok_or_else(|| unknown(id))
    }

    /// Checks that a deployment has one of the versions that the change may replace.
    pub(super) async fn expect(&mut self, author: ChangeAuthor<'_>, id: &str) -> CloudResult<()> {
        let Some(versions) = author.versions else { return Ok(()) };
        match self.newest(id).await?.map(|release| release.version()) {
            Some(version) if !versions.contains(&version) => {
                let message = format!("deployment `{id}` has changed since: it is not as expected");
                let help = "get it again, and send the change with its new `ETag`";
                Err(CloudError::conflict(StatusCode::PRECONDITION_FAILED, message, help))
            }
            _ => Ok(()),
        }
    }

    pub(super) async fn restart_wave(&mut self, id: &str) -> CloudResult<()> {
        run!(self; "UPDATE releases SET since = $2 WHERE deployment = $1 AND state = 'running'";
            id, now());
        Ok(())
    }

    async fn take_step(&mut self, release: &Release, step: WaveStep) -> CloudResult<bool> {
        let Release { deployment, number, .. } = release;
        let action = match step {
            WaveStep::Wait => return Ok(false),
            WaveStep::Open(wave) => {
                let added = self.open_wave(deployment, *number, wave).await?;
                // One that waits for its first vehicle is open already.
                if wave == release.wave {
                    return Ok(added > 0);
                }
                format!("open wave {wave} of release {number}")
            }
            WaveStep::Complete => {
                self.complete(deployment, *number).await?;
                format!("open release {number} to all")
            }
            WaveStep::Pause(reason) => {
                run!(self; "UPDATE releases SET state = 'paused', since = $3, reason = $4
                     WHERE deployment = $1 AND number = $2 AND state = 'running'";
                    deployment, number, now(), &reason);
                format!("pause release {number}: wave {} {reason}", release.wave)
            }
            WaveStep::Rollback(reason) => {
                self.request_fallback(deployment, *number, &reason).await?;
                format!("roll back release {number}: wave {} {reason}", release.wave)
            }
        };
        self.note(WAVES, &action, deployment).await?;
        Ok(true)
    }

    /// Opens a wave of the newest release: adds as many vehicles as its plan has, and returns their
    /// number.
    pub(super) async fn open_wave(
        &mut self,
        id: &str,
        number: i64,
        wave: i64,
    ) -> CloudResult<usize> {
        let release = self.newest_of(id).await?;
        let (selector, share) = (&release.selector, release.share(wave)?);
        let vehicles: Vec<(String, TextMap, bool)> = rows!(self; "SELECT name, labels,
             (SELECT COUNT(*) FROM wave_members WHERE vehicle = name AND deployment = $1
             AND number = $2) FROM vehicles WHERE is_revoked = 0 AND epoch > 0"; id, number);
        let chosen = vehicles.iter().filter(|(_, labels, _)| selects(selector, labels));
        let (members, others): (Vec<_>, Vec<_>) = chosen.partition(|(.., is_member)| *is_member);
        let target = ((members.len() + others.len()) * share).div_ceil(100);
        // By a hash: another choice for each release, and the same one for each process.
        let order = |name: &str| <[u8; 32]>::from(Sha256::digest(format!("{id} {number} {name}")));
        let mut others: Vec<_> = others.iter().map(|(name, ..)| (order(name), name)).collect();
        others.sort_unstable();
        others.truncate(target.saturating_sub(members.len()));
        for (_, name) in &others {
            run!(self; "INSERT INTO wave_members (vehicle, deployment, number) VALUES ($1, $2, $3)";
                *name, id, number);
        }
        // A wave that waits for its first vehicle began when it was opened.
        run!(self;
            "UPDATE releases SET since = CASE WHEN wave = $3 THEN since ELSE $4 END, wave = $3
             WHERE deployment = $1 AND number = $2 AND state = 'running'"; id, number, wave, now());
        Ok(others.len())
    }

    /// Requests each vehicle with a release to run its fallback, and ends its waves.
    pub(super) async fn request_fallback(
        &mut self,
        id: &str,
        number: i64,
        reason: &str,
    ) -> CloudResult<()> {
        // Numbers are times: a request is new also for a vehicle that followed one of a deployment
        // of this id that was removed since, or that a restored backup does not have.
        run!(self;
            "UPDATE releases SET rollback_request =
             CASE WHEN rollback_request < $3 THEN $3 ELSE rollback_request + 1 END
             WHERE deployment = $1 AND number = $2"; id, number, now_ms());
        run!(self; "UPDATE releases SET state = 'aborted', since = $3, reason = $4
             WHERE deployment = $1 AND number = $2 AND state <> 'complete'";
            id, number, now(), reason);
        Ok(())
    }

    /// Commits a change of `found` deployments.
    pub(super) async fn finish(
        mut self,
        found: u64,
        actor: &str,
        action: &str,
        id: &str,
    ) -> CloudResult<ChangedVehicles> {
        if found == 0 {
            return Err(unknown(id));
        }
        self.note(actor, action, id).await?;
        let changed = self.refresh_all().await?;
        self.commit().await?;
        Ok(changed)
    }

    /// Opens a release to all its vehicles, and drops older ones.
    pub(super) async fn complete(&mut self, id: &str, number: i64) -> CloudResult<()> {
        run!(self; "UPDATE releases SET state = 'complete', plan = '', reason = ''
             WHERE deployment = $1 AND number = $2"; id, number);
        run!(self; "DELETE FROM releases WHERE deployment = $1 AND number < $2"; id, number);
        run!(self; "DELETE FROM wave_members WHERE deployment = $1"; id);
        Ok(())
    }
}

impl Release {
    /// Returns a digest of what people and waves want of the deployment: it changes with that, and
    /// not with what vehicles report.
    pub(super) fn version(&self) -> String {
        let Self { number, sha256, is_wanted, rollback_request, state, wave, .. } = self;
        let is_wanted = i64::from(*is_wanted);
        let wanted = serde_json::json!([number, sha256, is_wanted, rollback_request, state, wave]);
        gleaner_trust::sha256(wanted.to_string().as_bytes()).to_string().split_off(48)
    }

    fn plan(&self) -> CloudResult<WavePlan> {
        serde_json::from_str(&self.plan).map_err(|error| {
            let message =
                format!("the stored plan of the waves of `{}` is damaged", self.deployment);
            CloudError::usage(message, "deploy a higher release").because(error)
        })
    }

    /// Returns the share of the vehicles that a wave reaches, in percent.
    fn share(&self, wave: i64) -> CloudResult<usize> {
        let shares = self.plan()?.shares;
        let index = usize::try_from(wave).unwrap_or(0).saturating_sub(1);
        Ok(shares.get(index).copied().unwrap_or(100).into())
    }

    fn soak_end(&self) -> CloudResult<i64> {
        Ok(self.since.saturating_add(int(self.plan()?.soak_s)))
    }

    /// Counts its vehicles, or those of them that its waves have reached: of these, one that is
    /// silent does not count as running, as the release may be the reason.
    pub(super) async fn count(
        &self,
        tx: &mut AnyConnection,
        only_members: bool,
    ) -> CloudResult<VehicleCount> {
        let soak_end = if only_members { self.soak_end()? } else { 0 };
        // Grouped by labels, of which there are few: SQL cannot compare them with the selector.
        let groups: Vec<VehicleGroup> = rows!(&mut *tx;
            "SELECT labels,
             CASE WHEN reported.state = $6 THEN reported.state
                  WHEN seen < $3 AND replica NOT IN (SELECT id FROM replicas)
                  THEN CASE WHEN seen < $7 THEN 'away' ELSE 'late' END
                  ELSE COALESCE(reported.state, 'late') END AS standing,
             COALESCE(on_fallback, 0) AS on_fallback, COALESCE(is_forgiven, 0) AS is_forgiven,
             COUNT(*) AS vehicles FROM vehicles
             LEFT JOIN reported ON reported.vehicle = vehicles.name
             AND reported.deployment = $1 AND reported.envelope = $5
             LEFT JOIN wave_members ON wave_members.vehicle = vehicles.name
             AND wave_members.deployment = $1 AND wave_members.number = $2
             WHERE is_revoked = 0 AND epoch > 0 AND ($4 = 0 OR wave_members.vehicle IS NOT NULL)
             GROUP BY 1, 2, 3, 4";
            &self.deployment, self.number, soak_end, only_members, &self.sha256, FAILED,
            now() - AWAY_S);
        let mut count = VehicleCount::default();
        for VehicleGroup { labels, standing, on_fallback, is_forgiven, vehicles } in groups {
            if !selects(&self.selector, &labels) {
                continue;
            }
            count.vehicles += vehicles;
            match &*standing {
                FAILED => {
                    count.failed += vehicles;
                    count.on_fallback += if on_fallback { vehicles } else { 0 };
                    count.forgiven += if is_forgiven { vehicles } else { 0 };
                }
                RUNNING => count.running += vehicles,
                "away" => count.away += vehicles,
                _ => {}
            }
        }
        Ok(count)
    }

    /// Returns the first vehicle of its waves that has failed, or else is silent, with the reason,
    /// for an end of a sentence; empty without one.
    async fn failure(&self, tx: &mut AnyConnection) -> CloudResult<String> {
        let row: Option<(String, String)> = row!(&mut *tx;
            "SELECT name, COALESCE(reason, 'not connected since the soak time') FROM wave_members
             JOIN vehicles ON name = wave_members.vehicle
             LEFT JOIN reported ON reported.vehicle = name AND reported.deployment = $1
             AND envelope = $4 AND reported.state = $5
             WHERE wave_members.deployment = $1 AND wave_members.number = $2 AND is_revoked = 0
             AND CASE WHEN reason IS NOT NULL THEN is_forgiven = 0
                 ELSE seen < $3 AND replica NOT IN (SELECT id FROM replicas) END
             ORDER BY CASE WHEN reason IS NULL THEN 1 ELSE 0 END, name LIMIT 1";
            &self.deployment, self.number, self.soak_end()?, &self.sha256, FAILED);
        Ok(row.map(|(vehicle, reason)| format!(" ({vehicle}: {reason})")).unwrap_or_default())
    }

    /// Returns the progress of its waves, which have reached these vehicles, unless it is open to
    /// all.
    pub(super) fn progress(&self, count: &VehicleCount) -> CloudResult<Option<WaveProgress>> {
        let state = serde_json::from_value(self.state.as_str().into());
        let Ok(state) = state else { return Ok(None) };
        let plan = self.plan()?;
        Ok(Some(WaveProgress {
            wave: unsigned(self.wave),
            waves: plan.shares.len() as u64 + 1,
            plan,
            state,
            reason: self.reason.clone(),
            since: unsigned(self.since),
            vehicles: count.vehicles,
            running: count.running,
            failed: count.failed,
        }))
    }

    /// Returns the step that is due, at the time `now`, with these vehicles in its waves.
    fn next(&self, count: &VehicleCount, now: i64) -> CloudResult<WaveStep> {
        let plan = self.plan()?;
        let open_s = unsigned(now.saturating_sub(self.since));
        let VehicleCount { vehicles, running, failed, forgiven, away, .. } = *count;
        let share = |part: u64, percent: u8| part * 100 > vehicles * u64::from(percent);
        let new = failed - forgiven;
        if new > 0 && share(new, plan.failures) {
            let reason = format!("failed on {failed} of {vehicles}");
            return Ok(match plan.on_failure {
                OnFailure::Rollback if !self.fallback.is_empty() => WaveStep::Rollback(reason),
                _ => WaveStep::Pause(reason),
            });
        }
        if vehicles == 0 {
            // No vehicle has the labels yet.
            return Ok(WaveStep::Open(self.wave));
        }
        // A wave does not wait for vehicles that are switched off: they get the release later.
        let expected = match open_s > unsigned(AWAY_S) {
            true => vehicles - away,
            false => vehicles,
        };
        let has_succeeded = running > 0 && running * 100 >= expected * u64::from(plan.success);
        Ok(match () {
            () if has_succeeded && open_s >= plan.soak_s => {
                match (self.wave as usize) < plan.shares.len() {
                    true => WaveStep::Open(self.wave + 1),
                    false => WaveStep::Complete,
                }
            }
            () if !has_succeeded && open_s >= plan.deadline_s => {
                WaveStep::Pause(format!("ran on {running} of {vehicles} at its deadline"))
            }
            () => WaveStep::Wait,
        })
    }
}

pub(super) fn unknown(id: &str) -> CloudError {
    let message = format!("there is no deployment `{}`", excerpt(id));
    CloudError::missing(message, "list the deployments, and use one of their ids")
}
