//! Removes what is not needed any more: clips, by people and by age and size, and revisions that no
//! release names.
//!
//! A clip is removed with a note of its files in one transaction: they are removed afterwards, also
//! if the program was killed in between.

use std::collections::BTreeSet;

use gleaner_fleet::clips::{ClipId, ClipState, ClipUsage};
use gleaner_trust::unverified_revision;

use super::{CloudStore, StoreChange, int, unsigned};
use crate::error::{CloudError, CloudResult};
use crate::sqlx;

/// Actor of changes that the cloud makes by its rules.
const RULES: &str = "rules";
/// Number of clips that are removed in one transaction: others wait for it.
const CLIPS_AT_ONCE: i64 = 100;

/// A clip that is stored: its number, name, vehicle and bytes.
type StoredRow = (i64, String, String, i64);

/// Files of clips whose rows were removed.
#[derive(Debug)]
pub(crate) struct RemovedClip {
    pub(crate) id: ClipId,
    /// True if a later announcement of the clip has a file, or a thumbnail.
    pub(crate) has_file: bool,
    pub(crate) has_thumbnail: bool,
}

impl CloudStore {
    /// Removes a clip whose file is stored.
    pub(crate) async fn remove_clip(&self, actor: &str, id: &ClipId) -> CloudResult<()> {
        let clip = self.clip(id).await?;
        if clip.state != ClipState::Stored {
            let message = format!("the file of clip `{id}` is not in the cloud");
            return Err(CloudError::usage(message, "its vehicle deletes it by its own rules")
                .because(format!("its state is `{}`", clip.state.as_str())));
        }
        let mut change = self.change().await?;
        let row: Option<(i64, i64)> = row!(&mut *change.tx;
            "SELECT seq, bytes FROM clips
             WHERE vehicle = $1 AND name = $2 AND state = 'stored'";
            id.vehicle(), id.name());
        let (seq, bytes) = row.ok_or_else(|| {
            CloudError::missing(format!("clip `{id}` was removed"), "`gleaner clips` lists all")
        })?;
        let (name, vehicle) = (id.name().to_owned(), id.vehicle().to_owned());
        change.remove_clips(&[(seq, name, vehicle, bytes)]).await?;
        change.note(actor, "remove clip", &id.to_string()).await?;
        change.commit().await
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
        let (kept,): (i64,) = one!(&mut *change.tx;
            "SELECT CAST(COALESCE(SUM(disk + bytes), 0) AS BIGINT) FROM clips
             WHERE state = 'stored'");
        let mut kept = unsigned(kept);
        let oldest: Vec<(i64, String, String, i64, i64, i64)> = rows!(&mut *change.tx;
            "SELECT seq, name, vehicle, bytes, disk, part_time FROM clips
             WHERE state = 'stored' ORDER BY part_time, seq LIMIT $1";
            CLIPS_AT_ONCE);
        let mut expired: Vec<StoredRow> = Vec::new();
        for (seq, name, vehicle, bytes, disk, time) in oldest {
            let is_old = policy.keep_s > 0 && time <= before;
            let has_excess = policy.keep_bytes > 0 && kept > policy.keep_bytes;
            if !is_old && !has_excess {
                break;
            }
            kept = kept.saturating_sub(unsigned(disk + bytes));
            expired.push((seq, name, vehicle, bytes));
        }
        if expired.is_empty() {
            return Ok(false);
        }
        change.remove_clips(&expired).await?;
        let text = format!("{} of the oldest clips", expired.len());
        change.note(RULES, "remove clips", &text).await?;
        change.commit().await?;
        tracing::info!(clips = expired.len(), "the oldest clips were removed by the rules");
        Ok(expired.len() as i64 == CLIPS_AT_ONCE)
    }

    /// Returns what is stored of clips, and what was removed.
    pub(crate) async fn clip_counts(&self) -> CloudResult<ClipUsage> {
        let (stored, bytes, removed, removed_bytes, disk): (i64, i64, i64, i64, i64) = one!(
            &self.pool;
            "SELECT (SELECT COUNT(*) FROM clips WHERE state = 'stored'),
             (SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM clips WHERE state = 'stored'),
             removed, removed_bytes,
             (SELECT CAST(COALESCE(SUM(disk), 0) AS BIGINT) FROM clip_vehicles) FROM clip_policy");
        let [stored, bytes, removed, removed_bytes, disk_bytes] =
            [stored, bytes, removed, removed_bytes, disk].map(unsigned);
        Ok(ClipUsage { stored, bytes, removed, removed_bytes, disk_bytes })
    }

    /// Returns clips that were removed, and whose files may still be there.
    pub(crate) async fn removed_clips(&self) -> CloudResult<Vec<ClipId>> {
        let rows: Vec<(String, String)> = rows!(&self.pool;
            "SELECT name, vehicle FROM removed_clips ORDER BY vehicle, name LIMIT $1";
            CLIPS_AT_ONCE);
        Ok(rows.into_iter().filter_map(clip_id).collect())
    }

    /// Returns which files of a removed clip a later announcement of it has.
    pub(crate) async fn removed_clip(&self, id: ClipId) -> CloudResult<RemovedClip> {
        let row: Option<(i64, i64)> = row!(&self.pool;
            "SELECT parts, has_thumbnail FROM clips WHERE vehicle = $1 AND name = $2";
            id.vehicle(), id.name());
        let (parts, has_thumbnail) = row.unwrap_or_default();
        Ok(RemovedClip { id, has_file: parts > 0, has_thumbnail: has_thumbnail != 0 })
    }

    /// Forgets a removed clip, as its files are removed.
    pub(crate) async fn forget_removed_clip(&self, id: &ClipId) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(&mut *change.tx; "DELETE FROM removed_clips WHERE vehicle = $1 AND name = $2";
            id.vehicle(), id.name());
        change.count_clip_bytes(id.vehicle()).await?;
        change.commit().await
    }

    /// Removes revisions that no release has named for `grace_s`; returns their number.
    pub(crate) async fn collect_revisions(&self, grace_s: i64) -> CloudResult<u64> {
        const UNUSED: &str = "NOT EXISTS (SELECT 1 FROM releases
            WHERE releases.revision = revisions.digest OR releases.fallback = revisions.digest)";
        let mut change = self.change().await?;
        let sql = format!("UPDATE revisions SET unused_since = 0 WHERE NOT ({UNUSED})");
        sqlx::query(sqlx::AssertSqlSafe(sql)).execute(&mut *change.tx).await?;
        let sql =
            format!("UPDATE revisions SET unused_since = $1 WHERE unused_since = 0 AND {UNUSED}");
        sqlx::query(sqlx::AssertSqlSafe(sql)).bind(self.age_now()).execute(&mut *change.tx).await?;
        let sql = "DELETE FROM revisions WHERE unused_since > 0 AND unused_since <= $1";
        let removed = run!(&mut *change.tx; sql; self.age_now() - grace_s).rows_affected();
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
            let rows: Vec<(String, String)> = rows!(&self.pool;
                "SELECT digest, envelope FROM revisions WHERE digest > $1 ORDER BY digest LIMIT 50";
                &last);
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
    async fn remove_clips(&mut self, rows: &[StoredRow]) -> CloudResult<()> {
        for (seq, name, vehicle, _) in rows {
            self.note_removed(vehicle, name, true).await?;
            run!(&mut *self.tx; "DELETE FROM clip_words WHERE clip = $1"; seq);
            run!(&mut *self.tx; "DELETE FROM clips WHERE seq = $1"; seq);
        }
        let vehicles: BTreeSet<_> = rows.iter().map(|(_, _, vehicle, _)| vehicle).collect();
        for vehicle in vehicles {
            self.count_clip_bytes(vehicle).await?;
        }
        let (removed, bytes) = (rows.len() as i64, rows.iter().map(|row| row.3).sum::<i64>());
        run!(&mut *self.tx;
            "UPDATE clip_policy SET removed = removed + $1, removed_bytes = removed_bytes + $2";
            removed, bytes);
        Ok(())
    }
}

fn clip_id((name, vehicle): (String, String)) -> Option<ClipId> {
    ClipId::new(name.parse().ok()?, &vehicle).ok()
}
