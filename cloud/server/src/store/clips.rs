//! Clips that vehicles have announced, and the progress of their files.

use std::collections::BTreeSet;

use gleaner_base::{excerpt, visible};
use gleaner_fleet::clips::{
    ClipFacts, ClipId, ClipName, ClipOrders, ClipPolicy, ClipReport, GoneClip, WantedClip,
};

use super::numbers::check_number;
use super::vehicles::ended;
use super::wants::next_wanted;
use super::{CloudStore, DAY_S, StoreChange, int, now, unsigned};
use crate::error::{CloudError, CloudResult};

/// Number of clips of a vehicle that are wanted, and of thumbnails, in its orders.
const ORDERS_MAX: i64 = 64;
/// Number of uploads of another file than announced, after which a clip is not wanted any more.
const FAILURES_MAX: i64 = 3;

/// Bounds of what is kept of clips.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ClipBounds {
    /// Clips of a vehicle, with files or without.
    pub(crate) clips: u64,
    /// Bytes of the files of a vehicle.
    pub(crate) vehicle_bytes: u64,
    /// Bytes of all files.
    pub(crate) bytes: u64,
    /// Unfinished files of a vehicle.
    pub(crate) unfinished: u64,
    /// Time after which an unfinished file is removed, in s.
    pub(crate) unfinished_s: u64,
}

impl ClipBounds {
    pub(crate) const DEFAULT: ClipBounds = ClipBounds {
        clips: 20_000,
        vehicle_bytes: 64 << 30,
        bytes: 1 << 40,
        unfinished: 4,
        unfinished_s: 7 * 86_400,
    };
}

/// The file of a clip, as it was announced and as far as it was received.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ClipProgress {
    pub(crate) id: ClipId,
    pub(crate) bytes: u64,
    pub(crate) sha256: String,
    /// Number of the next part.
    pub(crate) part: u64,
}

/// Bytes of files.
struct UsedBytes {
    /// Those of a vehicle.
    own: u64,
    /// Those of all vehicles.
    all: u64,
}

impl UsedBytes {
    /// Returns the reason why a further file of this length does not fit.
    fn excess(&self, bytes: u64, bounds: ClipBounds) -> Option<String> {
        let limits = [
            (self.own, bounds.vehicle_bytes, "of its vehicle"),
            (self.all, bounds.bytes, "of all vehicles"),
        ];
        let full = limits.into_iter().find(|(used, most, _)| used.saturating_add(bytes) > *most);
        full.map(|(used, most, of)| format!("clips {of} have {used} of {most} bytes already"))
    }
}

impl CloudStore {
    /// Stores what a vehicle reports; returns the clips whose files the cloud must remove. A clip
    /// that was announced before stays as it is.
    pub(crate) async fn announce_clips(
        &self,
        vehicle: &str,
        report: &ClipReport,
        bounds: ClipBounds,
    ) -> CloudResult<Vec<ClipId>> {
        let mut dropped = Vec::new();
        let mut change = self.change().await?;
        change.must_count(vehicle).await?;
        for facts in &report.clips {
            change.add_clip(vehicle, facts).await?;
        }
        for gone in &report.gone {
            if change.lose_clip(vehicle, gone).await? {
                dropped.extend(ClipId::new(gone.name.clone(), vehicle));
            }
        }
        if let Some(position) = &report.cursor {
            run!(&mut *change.tx;
                "INSERT INTO clip_vehicles (vehicle, position) VALUES ($1, $2)
                 ON CONFLICT (vehicle) DO UPDATE SET position = excluded.position";
                vehicle, position);
        }
        dropped.extend(change.forget_clips(vehicle, bounds).await?);
        change.commit().await?;
        Ok(dropped)
    }

    /// Returns everything that is wanted of the clips of a vehicle.
    pub(crate) async fn clip_orders(
        &self,
        vehicle: &str,
        bounds: ClipBounds,
    ) -> CloudResult<ClipOrders> {
        let row: Option<(String, i64, i64)> = row!(&self.pool;
            "SELECT position, day, day_bytes FROM clip_vehicles WHERE vehicle = $1"; vehicle);
        let (position, day, sent) = row.unwrap_or_default();
        let thumbnails: Vec<(String,)> = rows!(&self.pool;
            "SELECT name FROM clips WHERE vehicle = $1 AND thumbnail <> '' AND has_thumbnail = 0
             ORDER BY seq LIMIT $2";
            vehicle, ORDERS_MAX);
        let policy = self.clip_policy().await?;
        let is_used_up = day == today() && unsigned(sent) >= policy.day_bytes;
        let wanted = match is_used_up {
            true => Vec::new(),
            false => self.wanted_clips(vehicle, &policy, bounds).await?,
        };
        Ok(ClipOrders {
            cursor: (!position.is_empty()).then_some(position),
            thumbnails: thumbnails.into_iter().filter_map(|(it,)| it.parse().ok()).collect(),
            wanted,
        })
    }

    /// Returns the files that a vehicle should send, the most important first: what a person
    /// wants, then the highest score, then the oldest, which the vehicle would delete first.
    async fn wanted_clips(
        &self,
        vehicle: &str,
        policy: &ClipPolicy,
        bounds: ClipBounds,
    ) -> CloudResult<Vec<WantedClip>> {
        let unfinished = self.unfinished_clips(vehicle).await?;
        let may_begin = i64::from(unfinished < bounds.unfinished);
        let rows: Vec<(String, i64, String, i64)> = rows!(&self.pool;
            "SELECT name, bytes, sha256, parts FROM clips
             WHERE vehicle = $1 AND state = 'vehicle' AND sha256 <> '' AND bytes > 0
             AND $2 <> 'none' AND (is_requested = 1 OR $2 = 'all') AND (parts > 0 OR $3 = 1)
             ORDER BY is_requested DESC, score DESC, from_ns, seq LIMIT $4";
            vehicle, policy.upload.as_str(), may_begin, ORDERS_MAX);
        if rows.is_empty() {
            return Ok(Vec::new());
        }
        let usage = self.clip_usage(vehicle).await?;
        let wanted = rows.into_iter().filter_map(|(name, bytes, sha256, parts)| {
            let (name, bytes, part) = (name.parse().ok()?, unsigned(bytes), unsigned(parts));
            Some(WantedClip { name, bytes, sha256, part })
        });
        // Files that do not fit must not keep smaller ones from being sent.
        Ok(wanted.filter(|it| it.part > 0 || usage.excess(it.bytes, bounds).is_none()).collect())
    }

    /// Returns the bytes of the files of a vehicle, and of all, those that are announced of
    /// unfinished ones.
    async fn clip_usage(&self, vehicle: &str) -> CloudResult<UsedBytes> {
        let (own, all): (i64, i64) = one!(&self.pool;
            "SELECT (SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM clips
                     WHERE vehicle = $1 AND parts > 0),
                    (SELECT CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM clips WHERE parts > 0)";
            vehicle);
        Ok(UsedBytes { own: unsigned(own), all: unsigned(all) })
    }

    /// Returns the number of files of a vehicle that have not come in full yet.
    async fn unfinished_clips(&self, vehicle: &str) -> CloudResult<u64> {
        let (unfinished,): (i64,) = one!(&self.pool;
            "SELECT COUNT(*) FROM clips
             WHERE vehicle = $1 AND state = 'vehicle' AND parts > 0";
            vehicle);
        Ok(unsigned(unfinished))
    }

    /// Returns the progress of a file that a vehicle may send now.
    ///
    /// # Errors
    ///
    /// An error if the file is not wanted, or does not fit.
    pub(crate) async fn clip_progress(
        &self,
        vehicle: &str,
        name: &ClipName,
        bounds: ClipBounds,
    ) -> CloudResult<ClipProgress> {
        let not_wanted = || {
            let message = format!("clip `{name}` is not wanted of this vehicle");
            CloudError::missing(message, "ask for the orders again: `POST /v1/clips`")
        };
        let row: Option<(i64, String, i64, i64, String)> = row!(&self.pool;
            "SELECT bytes, sha256, parts, is_requested, state FROM clips
             WHERE vehicle = $1 AND name = $2 AND sha256 <> ''";
            vehicle, name.as_str());
        let (bytes, sha256, parts, is_requested, state) = row.ok_or_else(not_wanted)?;
        let id = ClipId::new(name.clone(), vehicle).map_err(|_| not_wanted())?;
        let progress = ClipProgress { id, bytes: unsigned(bytes), sha256, part: unsigned(parts) };
        if state == "stored" {
            return Ok(progress);
        }
        let policy = self.clip_policy().await?;
        if !policy.upload.wants(is_requested != 0) || state != "vehicle" {
            return Err(not_wanted());
        }
        if progress.part == 0 {
            let unfinished = self.unfinished_clips(vehicle).await?;
            let usage = self.clip_usage(vehicle).await?;
            let mut full = usage.excess(progress.bytes, bounds);
            if unfinished >= bounds.unfinished {
                full = Some(format!("{unfinished} uploads of the vehicle are unfinished"));
            }
            if let Some(reason) = full {
                let message = format!("there is no room for clip `{name}`");
                let help = "continue an unfinished upload, or wait until clips were removed";
                return Err(CloudError::busy(message, help).because(reason));
            }
        }
        Ok(progress)
    }

    /// Notes that a part is durable, unless it was noted already or the vehicle does not count any
    /// more. With the last one, the file is stored.
    pub(crate) async fn clip_part_received(
        &self,
        progress: &ClipProgress,
        (length, sha256): (u64, &str),
        is_last: bool,
    ) -> CloudResult<()> {
        let ClipProgress { id, part, .. } = progress;
        let mut change = self.change().await?;
        change.must_count(id.vehicle()).await?;
        let stored = run!(&mut *change.tx;
            "UPDATE clips SET parts = parts + 1, part_time = $4, reason = '',
             state = CASE WHEN $5 = 1 THEN 'stored' ELSE state END
             WHERE vehicle = $1 AND name = $2 AND parts = $3 AND state = 'vehicle'";
            id.vehicle(), id.name(), int(*part), self.age_now(), i64::from(is_last));
        if stored.rows_affected() > 0 {
            run!(&mut *change.tx;
                "INSERT INTO clip_parts (clip, part, sha256)
                 SELECT seq, $3, $4 FROM clips WHERE vehicle = $1 AND name = $2
                 ON CONFLICT (clip, part) DO UPDATE SET sha256 = excluded.sha256";
                id.vehicle(), id.name(), int(*part), sha256);
            run!(&mut *change.tx;
                "INSERT INTO clip_vehicles (vehicle, day, day_bytes) VALUES ($1, $2, $3)
                 ON CONFLICT (vehicle) DO UPDATE SET day = excluded.day, day_bytes =
                 CASE WHEN clip_vehicles.day = excluded.day THEN clip_vehicles.day_bytes ELSE 0 END
                 + excluded.day_bytes";
                id.vehicle(), today(), int(length));
        }
        change.commit().await
    }

    /// Returns the SHA-256 of each part of a file that was acknowledged.
    pub(crate) async fn clip_parts(&self, id: &ClipId) -> CloudResult<Vec<String>> {
        let rows: Vec<(String,)> = rows!(&self.pool;
            "SELECT clip_parts.sha256 FROM clip_parts JOIN clips ON clips.seq = clip_parts.clip
             WHERE vehicle = $1 AND name = $2 AND part < parts ORDER BY part";
            id.vehicle(), id.name());
        Ok(rows.into_iter().map(|(sha256,)| sha256).collect())
    }

    /// Forgets the parts of a file, which was not the announced one or is not there; returns
    /// whether it was not complete.
    pub(crate) async fn clip_upload_failed(&self, id: &ClipId, reason: &str) -> CloudResult<bool> {
        let mut change = self.change().await?;
        let failed = run!(&mut *change.tx;
            "UPDATE clips SET parts = 0, failures = failures + 1, reason = $3,
             state = CASE WHEN failures + 1 >= $4 THEN 'failed' ELSE 'vehicle' END
             WHERE vehicle = $1 AND name = $2 AND state = 'vehicle'";
            id.vehicle(), id.name(), excerpt(reason), FAILURES_MAX);
        change.commit().await?;
        Ok(failed.rows_affected() > 0)
    }

    /// Returns the SHA-256 of the thumbnail that is wanted of a clip.
    pub(crate) async fn wanted_thumbnail(
        &self,
        vehicle: &str,
        name: &ClipName,
    ) -> CloudResult<Option<String>> {
        let row: Option<(String,)> = row!(&self.pool;
            "SELECT thumbnail FROM clips
             WHERE vehicle = $1 AND name = $2 AND thumbnail <> '' AND has_thumbnail = 0";
            vehicle, name.as_str());
        Ok(row.map(|(sha256,)| sha256))
    }

    /// Notes that the thumbnail of a clip is durable.
    pub(crate) async fn thumbnail_received(&self, id: &ClipId) -> CloudResult<()> {
        let mut change = self.change().await?;
        change.must_count(id.vehicle()).await?;
        run!(&mut *change.tx;
            "UPDATE clips SET has_thumbnail = 1 WHERE vehicle = $1 AND name = $2";
            id.vehicle(), id.name());
        change.commit().await
    }

    /// Forgets the announcement of a thumbnail that is no image.
    pub(crate) async fn thumbnail_refused(&self, id: &ClipId, sha256: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(&mut *change.tx;
            "UPDATE clips SET thumbnail = ''
             WHERE vehicle = $1 AND name = $2 AND thumbnail = $3 AND has_thumbnail = 0";
            id.vehicle(), id.name(), sha256);
        change.commit().await
    }

    /// Forgets the parts of files of which none came since `seconds`; returns these clips.
    pub(crate) async fn forget_unfinished_clips(&self, seconds: u64) -> CloudResult<Vec<ClipId>> {
        let before = self.age_now() - int(seconds);
        let mut change = self.change().await?;
        let rows: Vec<(String, String)> = rows!(&mut *change.tx;
            "UPDATE clips SET parts = 0
             WHERE state = 'vehicle' AND parts > 0 AND part_time <= $1 RETURNING name, vehicle";
            before);
        change.commit().await?;
        Ok(rows.into_iter().filter_map(clip_id).collect())
    }

    pub(crate) async fn clip_policy(&self) -> CloudResult<ClipPolicy> {
        let (upload, day_bytes, keep_s, keep_bytes): (String, i64, i64, i64) =
            one!(&self.pool; "SELECT upload, day_bytes, keep_s, keep_bytes FROM clip_policy");
        let upload = upload.parse().map_err(|error: String| {
            CloudError::usage("the rules for clips are damaged", "set them again").because(error)
        })?;
        let [day_bytes, keep_s, keep_bytes] = [day_bytes, keep_s, keep_bytes].map(unsigned);
        Ok(ClipPolicy { upload, day_bytes, keep_s, keep_bytes })
    }

    /// Changes the rules for uploads; returns the vehicles to wake.
    pub(crate) async fn set_clip_policy(
        &self,
        actor: &str,
        policy: &ClipPolicy,
    ) -> CloudResult<Vec<String>> {
        let mut change = self.change().await?;
        let ClipPolicy { upload, day_bytes, keep_s, keep_bytes } = policy;
        check_number("a bound of clips", *day_bytes.max(keep_s).max(keep_bytes))?;
        run!(&mut *change.tx;
            "UPDATE clip_policy SET upload = $1, day_bytes = $2, keep_s = $3, keep_bytes = $4";
            upload.as_str(), int(*day_bytes), int(*keep_s), int(*keep_bytes));
        let mut text = format!("{}, {day_bytes} bytes a day", upload.as_str());
        if *keep_s > 0 || *keep_bytes > 0 {
            text += &format!(", keep {keep_s} s and {keep_bytes} bytes");
        }
        change.note(actor, "set policy of clips", &text).await?;
        let vehicles: Vec<(String,)> = rows!(&mut *change.tx;
            concat!("UPDATE vehicles SET ", next_wanted!(),
                " WHERE is_revoked = 0 AND epoch > 0 RETURNING name"));
        change.commit().await?;
        Ok(vehicles.into_iter().map(|(name,)| name).collect())
    }
}

impl StoreChange<'_> {
    /// Fails unless the vehicle counts: it may have been cut off since its request came.
    async fn must_count(&mut self, vehicle: &str) -> CloudResult<()> {
        let row: Option<(String,)> = row!(&mut *self.tx;
            "SELECT name FROM vehicles WHERE name = $1 AND is_revoked = 0"; vehicle);
        row.map(drop).ok_or_else(ended)
    }

    async fn add_clip(&mut self, vehicle: &str, facts: &ClipFacts) -> CloudResult<()> {
        let (last,): (i64,) = one!(&mut *self.tx; "SELECT COALESCE(MAX(seq), 0) FROM clips");
        let (name, sha256) = (facts.name.as_str(), facts.sha256.as_deref().unwrap_or(""));
        let scores = facts.moments.iter().filter_map(|moment| moment.score);
        // A cast of a float stops at the bounds of the integer.
        let score = (scores.fold(0.0, f64::max) * 1e6) as i64;
        let text = serde_json::to_string(facts).unwrap_or_default();
        let inserted = run!(&mut *self.tx;
            "INSERT INTO clips (seq, vehicle, name, facts, from_ns, to_ns, bytes, sha256, thumbnail,
             score, state) VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11)
             ON CONFLICT (vehicle, name) DO NOTHING";
            last + 1, vehicle, name, text, facts.from_ns, facts.to_ns, int(facts.bytes), sha256,
            facts.thumbnail.as_deref().unwrap_or(""), score,
            if sha256.is_empty() { "gone" } else { "vehicle" });
        if inserted.rows_affected() == 0 {
            let (before,): (String,) = one!(&mut *self.tx;
                "SELECT sha256 FROM clips WHERE vehicle = $1 AND name = $2"; vehicle, name);
            if before != sha256 && !sha256.is_empty() {
                tracing::warn!(vehicle, clip = name, "a clip was announced again, as another file");
            }
            return Ok(());
        }
        let lambdas = facts.lambdas.iter().map(|it| ("lambda", &it.name));
        let labels = facts.moments.iter().map(|it| ("label", &it.label));
        // PostgreSQL stores no NUL. The facts have it, escaped.
        let words = lambdas.chain(labels).filter(|(_, word)| !word.contains('\0'));
        let words: BTreeSet<_> = words.collect();
        for (kind, word) in words {
            run!(&mut *self.tx;
                "INSERT INTO clip_words (kind, word, clip) VALUES ($1, $2, $3)";
                kind, word, last + 1);
        }
        Ok(())
    }

    /// Notes that a file is not on its vehicle any more; returns whether parts of it are stored.
    async fn lose_clip(&mut self, vehicle: &str, gone: &GoneClip) -> CloudResult<bool> {
        let (name, reason) = (gone.name.as_str(), visible(&excerpt(&gone.reason)));
        if gone.is_thumbnail {
            run!(&mut *self.tx;
                "UPDATE clips SET thumbnail = '' WHERE vehicle = $1 AND name = $2
                 AND has_thumbnail = 0";
                vehicle, name);
            return Ok(false);
        }
        let lost = run!(&mut *self.tx;
            "UPDATE clips SET state = 'gone', reason = $3, parts = 0
             WHERE vehicle = $1 AND name = $2 AND state IN ('vehicle', 'failed')";
            vehicle, name, reason);
        Ok(lost.rows_affected() > 0)
    }

    /// Forgets the oldest clips of a vehicle above the bound, but those whose files are stored;
    /// returns them.
    async fn forget_clips(
        &mut self,
        vehicle: &str,
        bounds: ClipBounds,
    ) -> CloudResult<Vec<ClipId>> {
        let (count,): (i64,) = one!(&mut *self.tx;
            "SELECT COUNT(*) FROM clips WHERE vehicle = $1 AND state <> 'stored'"; vehicle);
        let above = count - int(bounds.clips);
        if above <= 0 {
            return Ok(Vec::new());
        }
        let rows: Vec<(i64, String)> = rows!(&mut *self.tx;
            "SELECT seq, name FROM clips WHERE vehicle = $1 AND state <> 'stored'
             ORDER BY seq LIMIT $2";
            vehicle, above);
        for (seq, _) in &rows {
            run!(&mut *self.tx; "DELETE FROM clip_words WHERE clip = $1"; seq);
            run!(&mut *self.tx; "DELETE FROM clips WHERE seq = $1"; seq);
        }
        tracing::warn!(vehicle, clips = above, "the oldest clips of a vehicle were forgotten");
        Ok(rows.into_iter().filter_map(|(_, name)| clip_id((name, vehicle.to_owned()))).collect())
    }
}

pub(super) fn clip_id((name, vehicle): (String, String)) -> Option<ClipId> {
    ClipId::new(name.parse().ok()?, &vehicle).ok()
}

fn today() -> i64 {
    now() / DAY_S
}
