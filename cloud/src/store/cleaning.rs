//! Removes what is not needed any more: clips, by people and by age and size, and revisions that no
//! release names.
//!
//! A clip is removed with a note of its files in one transaction: they are removed afterwards, also
//! if the program was killed in between.

use std::collections::BTreeSet;

use gleaner_fleet::clips::{ClipId, ClipState, ClipUsage};
use gleaner_trust::unverified_revision;

use super::{CloudStore, StoreChange, int};
use crate::error::{CloudError, CloudResult};

/// Actor of changes that the cloud makes by its rules.
const RULES: &str = "rules";
/// Number of clips that are removed in one transaction: others wait for it.
const CLIPS_AT_ONCE: i64 = 100;

typed! {
    struct StoredClipRow {
        seq: i64,
        name: String,
        vehicle: String,
        bytes: u64,
        disk: u64,
        part_time: i64,
    }
}

columns!(ClipUsage: stored, bytes, removed, removed_bytes, disk_bytes);

#[derive(Debug)]
pub(crate) struct RemovedClip {
    pub(crate) id: ClipId,
    /// True if a later announcement of the clip has a file, or a thumbnail.
    pub(crate) has_file: bool,
    pub(crate) has_thumbnail: bool,
}

impl CloudStore {
    pub(crate) async fn remove_clip(&self, actor: &str, id: &ClipId) -> CloudResult<()> {
        let clip = self.clip(id).await?;
        if clip.state != ClipState::Stored {
            let message = format!("the file of clip `{id}` is not in the cloud");
            return Err(CloudError::usage(message, "its vehicle deletes it by its own rules")
                .because(format!("its state is `{}`", clip.state.as_str())));
        }
        let mut change = self.change().await?;
        let stored: Option<StoredClipRow> = row!(change;
            "SELECT seq, name, vehicle, bytes, disk, part_time FROM clips
             WHERE vehicle = $1 AND name = $2 AND state = 'stored'"; id.vehicle(), id.name());
        let stored = stored.ok_or_else(|| {
            CloudError::missing(format!("clip `{id}` was removed"), "`gleaner clips` lists all")
        })?;
        change.remove_clips(&[stored]).await?;
        change.commit_noted(actor, "remove clip", &id.to_string()).await
    }

    /// Removes stored clips that are older, or have more bytes, than the rules permit, some at a
    /// time; returns whether there may be more.
    pub(crate) async fn expire_clips(&self) -> CloudResult<bool> {
        let policy = self.clip_policy().await?;
        if policy.keep_s == 0 && policy.keep_bytes == 0 {
            return Ok(false);
        }
        let before = self.age_now().saturating_sub(int(policy.keep_s));
        let mut change = self.change().await?;
        // Counted in the change: others may have removed some until it began.
        let mut kept: u64 = one!(change; "SELECT CAST(COALESCE(SUM(disk + bytes), 0) AS BIGINT)
             FROM clips WHERE state = 'stored'");
        let mut expired: Vec<StoredClipRow> = rows!(change;
            "SELECT seq, name, vehicle, bytes, disk, part_time
             FROM clips WHERE state = 'stored' ORDER BY part_time, seq LIMIT $1"; CLIPS_AT_ONCE);
        let is_needed = |clip: &StoredClipRow| {
            let is_old = policy.keep_s > 0 && clip.part_time <= before;
            let has_excess = policy.keep_bytes > 0 && kept > policy.keep_bytes;
            kept = kept.saturating_sub(clip.disk + clip.bytes);
            !is_old && !has_excess
        };
        expired.truncate(expired.iter().position(is_needed).unwrap_or(expired.len()));
        if expired.is_empty() {
            return Ok(false);
        }
        change.remove_clips(&expired).await?;
        let text = format!("{} of the oldest clips", expired.len());
        change.commit_noted(RULES, "remove clips", &text).await?;
        tracing::info!(clips = expired.len(), "deleted clips by retention policy");
        Ok(expired.len() as i64 == CLIPS_AT_ONCE)
    }

    /// Returns what is stored of clips, and what was removed.
    pub(crate) async fn clip_counts(&self) -> CloudResult<ClipUsage> {
        Ok(one!(self;
            "SELECT (SELECT COUNT(*) FROM clips WHERE state = 'stored') AS stored,
             (SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM clips WHERE state = 'stored')
             AS bytes, removed, removed_bytes, (SELECT CAST(COALESCE(SUM(disk), 0) AS BIGINT)
             FROM clip_vehicles) AS disk_bytes FROM clip_policy"))
    }

    /// Returns clips that were removed, and whose files may still be there.
    pub(crate) async fn removed_clips(&self) -> CloudResult<Vec<ClipId>> {
        let rows: Vec<(String, String)> = rows!(self; "SELECT name, vehicle
             FROM removed_clips ORDER BY vehicle, name LIMIT $1"; CLIPS_AT_ONCE);
        let id = |(name, vehicle): (String, String)| ClipId::new(name.parse().ok()?, &vehicle).ok();
        Ok(rows.into_iter().filter_map(id).collect())
    }

    /// Returns which files of a removed clip a later announcement of it has.
    pub(crate) async fn removed_clip(&self, id: ClipId) -> CloudResult<RemovedClip> {
        let row: Option<(u64, bool)> = row!(self; "SELECT parts, has_thumbnail
             FROM clips WHERE vehicle = $1 AND name = $2"; id.vehicle(), id.name());
        let (parts, has_thumbnail) = row.unwrap_or_default();
        Ok(RemovedClip { id, has_file: parts > 0, has_thumbnail })
    }

    /// Forgets a removed clip, as its files are removed.
    pub(crate) async fn forget_removed_clip(&self, id: &ClipId) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(change;
            "DELETE FROM removed_clips WHERE vehicle = $1 AND name = $2"; id.vehicle(), id.name());
        change.count_clip_bytes(id.vehicle()).await?;
        change.commit().await
    }

    /// Removes revisions that no release has named for `grace_s`; returns their number.
    pub(crate) async fn collect_revisions(&self, grace_s: i64) -> CloudResult<u64> {
        let mut change = self.change().await?;
        run!(change; "UPDATE revisions SET unused_since = CASE WHEN EXISTS (SELECT 1 FROM releases
             WHERE releases.revision = revisions.digest OR releases.fallback = revisions.digest)
             THEN 0 WHEN unused_since = 0 THEN $1 ELSE unused_since END"; self.age_now());
        let sql = "DELETE FROM revisions WHERE unused_since > 0 AND unused_since <= $1";
        let removed = run!(change; sql; self.age_now() - grace_s).rows_affected();
        if removed > 0 {
            change.note(RULES, "remove revisions", &format!("{removed} without a release")).await?;
        }
        change.commit().await?;
        Ok(removed)
    }

    /// Returns the digests of all files of the revisions; `None` if one cannot be read.
    pub(crate) async fn used_objects(&self) -> CloudResult<Option<BTreeSet<String>>> {
        let (mut used, mut last) = (BTreeSet::new(), String::new());
        loop {
            let rows: Vec<(String, String)> = rows!(self; "SELECT digest, envelope
                 FROM revisions WHERE digest > $1 ORDER BY digest LIMIT 50"; &last);
            let Some((digest, _)) = rows.last() else { return Ok(Some(used)) };
            last.clone_from(digest);
            for (digest, envelope) in rows {
                let Ok((revision, _)) = unverified_revision(envelope.as_bytes()) else {
                    tracing::error!(digest, "a stored revision is damaged: no files are removed");
                    return Ok(None);
                };
                used.extend(revision.files.iter().map(|file| file.sha256.to_string()));
            }
        }
    }
}

impl StoreChange<'_> {
    async fn remove_clips(&mut self, clips: &[StoredClipRow]) -> CloudResult<()> {
        for StoredClipRow { seq, name, vehicle, .. } in clips {
            self.forget_clip(*seq, vehicle, name).await?;
        }
        for vehicle in clips.iter().map(|clip| &clip.vehicle).collect::<BTreeSet<_>>() {
            self.count_clip_bytes(vehicle).await?;
        }
        let bytes: u64 = clips.iter().map(|clip| clip.bytes).sum();
        run!(self; "UPDATE clip_policy
             SET removed = removed + $1, removed_bytes = removed_bytes + $2"; clips.len(), bytes);
        Ok(())
    }

    /// Removes a clip, with a note of its files.
    pub(super) async fn forget_clip(
        &mut self,
        seq: i64,
        vehicle: &str,
        name: &str,
    ) -> CloudResult<()> {
        self.note_removed(vehicle, name, true).await?;
        run!(self; "DELETE FROM clip_words WHERE clip = $1"; seq);
        run!(self; "DELETE FROM clips WHERE seq = $1"; seq);
        Ok(())
    }
}
