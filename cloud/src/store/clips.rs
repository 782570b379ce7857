//! Clips that vehicles have announced, and the progress of their files.

use std::collections::BTreeSet;

use gleaner_base::{excerpt, visible};
use gleaner_fleet::clips::{
    CLIP_PART, ClipFacts, ClipId, ClipName, ClipOrders, ClipPolicy, ClipReport, GoneClip,
    THUMBNAIL_MAX, WantedClip,
};

use super::clip_quotas::{CLIP_MIN, ClipBounds};
use super::numbers::check_number;
use super::wants::next_wanted;
use super::{CloudStore, StoreChange, int};
use crate::error::{CloudError, CloudResult};

/// Number of clips of a vehicle that are wanted, and of thumbnails, in its orders.
const ORDERS_MAX: i64 = 64;
/// Number of uploads of another file than announced, after which a clip is not wanted any more.
const FAILURES_MAX: i64 = 3;
/// Time after which the parts of a file that its vehicle cannot read are forgotten, in s.
const UNREADABLE_S: u64 = 600;

/// The file of a clip, as it was announced and as far as it was received.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ClipProgress {
    pub(crate) id: ClipId,
    pub(crate) bytes: u64,
    pub(crate) sha256: String,
    /// Number of the next part, and of the bytes before it.
    pub(crate) part: u64,
    pub(crate) received: u64,
}

typed! {
    struct ProgressRow {
        bytes: u64,
        sha256: String,
        parts: u64,
        received: u64,
        is_requested: bool,
        state: String,
    }
}

typed! {
    #[derive(Debug, Clone, PartialEq, Eq)]
    pub(crate) struct StoredPart {
        pub(crate) sha256: String,
        pub(crate) bytes: u64,
    }
}

impl CloudStore {
    /// Stores what a vehicle reports. A clip that was announced before stays as it is. Files that
    /// do not count any more are noted, and removed with the next look.
    pub(crate) async fn announce_clips(
        &self,
        vehicle: &str,
        report: &ClipReport,
        bounds: ClipBounds,
    ) -> CloudResult<()> {
        let mut change = self.change().await?;
        change.must_count(vehicle).await?;
        for facts in &report.clips {
            change.add_clip(vehicle, facts).await?;
        }
        for GoneClip { name, is_thumbnail, reason } in &report.gone {
            change.lose_clip(vehicle, name, reason, *is_thumbnail).await?;
        }
        if let Some(position) = &report.cursor {
            run!(change; "INSERT INTO clip_vehicles (vehicle, position) VALUES ($1, $2) ON
                 CONFLICT (vehicle) DO UPDATE SET position = excluded.position"; vehicle, position);
        }
        change.forget_clips(vehicle, bounds).await?;
        change.count_clip_bytes(vehicle).await?;
        change.commit().await
    }

    /// Returns everything that is wanted of the clips of a vehicle.
    pub(crate) async fn clip_orders(
        &self,
        vehicle: &str,
        bounds: ClipBounds,
    ) -> CloudResult<ClipOrders> {
        let position: Option<String> = row!(self;
            "SELECT position FROM clip_vehicles WHERE vehicle = $1"; vehicle);
        let policy = self.clip_policy().await?;
        let budget = self.clip_budget(vehicle, &policy).await?;
        let unreadable: Vec<String> = rows!(self; "SELECT name FROM clips
             WHERE vehicle = $1 AND state = 'failed' AND sha256 = ''
             ORDER BY is_requested DESC, seq LIMIT $2"; vehicle, ORDERS_MAX);
        let parsed = |names: &[String]| names.iter().filter_map(|it| it.parse().ok()).collect();
        let mut orders = ClipOrders {
            cursor: position.filter(|it| !it.is_empty()),
            unreadable: parsed(&unreadable),
            budget: Some(budget),
            ..ClipOrders::default()
        };
        if !budget.is_spent {
            let names: Vec<String> = rows!(self; "SELECT name FROM clips WHERE vehicle = $1 AND
                 thumbnail <> '' AND has_thumbnail = 0 ORDER BY seq LIMIT $2"; vehicle, ORDERS_MAX);
            if !names.is_empty() && self.clip_usage(vehicle).await?.fits(THUMBNAIL_MAX, bounds) {
                orders.thumbnails = parsed(&names);
            }
            orders.wanted = self.wanted_clips(vehicle, &policy, bounds).await?;
        }
        Ok(orders)
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
        let rows: Vec<(String, u64, String, u64)> = rows!(self; "SELECT name, bytes,
             sha256, received FROM clips WHERE vehicle = $1 AND state = 'vehicle' AND sha256 <> ''
             AND bytes > 0 AND $2 <> 'none' AND (is_requested = 1 OR $2 = 'all') AND (parts > 0
             OR $3 = 1) ORDER BY is_requested DESC, score DESC, from_ns, seq LIMIT $4";
            vehicle, policy.upload.as_str(), unfinished < bounds.unfinished, ORDERS_MAX);
        if rows.is_empty() {
            return Ok(Vec::new());
        }
        let usage = self.clip_usage(vehicle).await?;
        let wanted = rows.into_iter().filter_map(|(name, bytes, sha256, from)| {
            let (name, part) = (name.parse().ok()?, from / CLIP_PART);
            Some(WantedClip { name, bytes, sha256, part, from: Some(from) })
        });
        // Files that do not fit must not keep smaller ones from being sent.
        let fits = |it: &WantedClip| it.from > Some(0) || usage.fits(it.bytes, bounds);
        Ok(wanted.filter(fits).collect())
    }

    /// Returns the number of files of a vehicle that have not come in full yet, also of those that
    /// it cannot read now.
    async fn unfinished_clips(&self, vehicle: &str) -> CloudResult<u64> {
        Ok(one!(self; "SELECT COUNT(*) FROM clips
             WHERE vehicle = $1 AND state IN ('vehicle', 'failed') AND parts > 0"; vehicle))
    }

    /// Returns the progress of a file that a vehicle may send now.
    /// Fails if the file is not wanted, or does not fit.
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
        let row: Option<ProgressRow> = row!(self;
            "SELECT bytes, sha256, parts, received, is_requested, state
             FROM clips WHERE vehicle = $1 AND name = $2 AND sha256 <> ''"; vehicle, name.as_str());
        let row = row.ok_or_else(not_wanted)?;
        let ProgressRow { bytes, sha256, parts, received, is_requested, state } = row;
        let id = ClipId::new(name.clone(), vehicle).map_err(|_| not_wanted())?;
        let progress = ClipProgress { id, bytes, sha256, part: parts, received };
        if state == "stored" {
            return Ok(progress);
        }
        let policy = self.clip_policy().await?;
        if !policy.upload.wants(is_requested) || state != "vehicle" {
            return Err(not_wanted());
        }
        let is_new = progress.part == 0;
        if is_new {
            let unfinished = self.unfinished_clips(vehicle).await?;
            if unfinished >= bounds.unfinished {
                let message = format!("there is no room for clip `{name}`");
                let reason = format!("{unfinished} uploads of the vehicle are unfinished");
                return Err(CloudError::busy(message, "continue one of them").because(reason));
            }
        }
        let file = format!("clip `{name}`");
        self.must_fit(vehicle, (&file, is_new.then_some(progress.bytes)), bounds).await?;
        Ok(progress)
    }

    /// Notes that a part is durable, unless it was noted already or the vehicle does not count any
    /// more. With the last one, the file is stored.
    /// Fails also if the file does not fit any more, as others have begun meanwhile.
    pub(crate) async fn clip_part_received(
        &self,
        progress: &ClipProgress,
        (length, sha256): (u64, &str),
        is_last: bool,
        bounds: ClipBounds,
    ) -> CloudResult<()> {
        let ClipProgress { id, part, .. } = progress;
        let mut change = self.change().await?;
        change.must_count(id.vehicle()).await?;
        let stored = run!(change; "UPDATE clips SET parts = parts + 1, received = received + $6,
             part_time = $4, reason = '', state = CASE WHEN $5 = 1 THEN 'stored' ELSE state END
             WHERE vehicle = $1 AND name = $2 AND parts = $3 AND state = 'vehicle'";
            id.vehicle(), id.name(), part, self.age_now(), is_last, length);
        if stored.rows_affected() > 0 {
            run!(change; "INSERT INTO clip_parts (clip, part, sha256, bytes) SELECT seq, $3, $4, $5
                 FROM clips WHERE vehicle = $1 AND name = $2 ON CONFLICT (clip, part)
                 DO UPDATE SET sha256 = excluded.sha256, bytes = excluded.bytes";
                id.vehicle(), id.name(), part, sha256, length);
        }
        if *part == 0 {
            change.count_clip_bytes(id.vehicle()).await?;
            change.must_have_room(id, bounds).await?;
        }
        change.commit().await
    }

    pub(crate) async fn clip_parts(&self, id: &ClipId) -> CloudResult<Vec<StoredPart>> {
        Ok(rows!(self; "SELECT clip_parts.sha256, clip_parts.bytes
             FROM clip_parts JOIN clips ON clips.seq = clip_parts.clip
             WHERE vehicle = $1 AND name = $2 AND part < parts ORDER BY part";
            id.vehicle(), id.name()))
    }

    /// Forgets the parts of a file, which was not the announced one or is not there; returns
    /// whether it was not complete.
    pub(crate) async fn clip_upload_failed(&self, id: &ClipId, reason: &str) -> CloudResult<bool> {
        let mut change = self.change().await?;
        change.note_removed(id.vehicle(), id.name(), false).await?;
        let failed = run!(change; "UPDATE clips SET parts = 0, received = 0,
             failures = failures + 1, reason = $3, state = CASE WHEN failures + 1 >= $4
             THEN 'failed' ELSE 'vehicle' END WHERE vehicle = $1 AND name = $2
             AND state = 'vehicle'"; id.vehicle(), id.name(), excerpt(reason), FAILURES_MAX);
        if failed.rows_affected() == 0 {
            return Ok(false);
        }
        change.count_clip_bytes(id.vehicle()).await?;
        change.commit().await?;
        Ok(true)
    }

    /// Returns the SHA-256 of the thumbnail that is wanted of a clip.
    pub(crate) async fn wanted_thumbnail(
        &self,
        vehicle: &str,
        name: &ClipName,
    ) -> CloudResult<Option<String>> {
        Ok(row!(self;
            "SELECT thumbnail FROM clips WHERE vehicle = $1
             AND name = $2 AND thumbnail <> '' AND has_thumbnail = 0"; vehicle, name.as_str()))
    }

    pub(crate) async fn thumbnail_received(&self, id: &ClipId, bytes: u64) -> CloudResult<()> {
        let mut change = self.change().await?;
        change.must_count(id.vehicle()).await?;
        run!(change; "UPDATE clips SET has_thumbnail = 1, disk = disk + $3 WHERE vehicle = $1
             AND name = $2 AND has_thumbnail = 0"; id.vehicle(), id.name(), bytes);
        change.count_clip_bytes(id.vehicle()).await?;
        change.commit().await
    }

    /// Forgets the announcement of a thumbnail that is no image.
    pub(crate) async fn thumbnail_refused(&self, id: &ClipId, sha256: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(change; "UPDATE clips SET thumbnail = '' WHERE vehicle = $1 AND name = $2
             AND thumbnail = $3 AND has_thumbnail = 0"; id.vehicle(), id.name(), sha256);
        change.commit().await
    }

    /// Forgets the parts of files of which none came since `seconds`. Those that cannot be read
    /// go much earlier: as they count, others could not begin.
    pub(crate) async fn forget_unfinished_clips(&self, seconds: u64) -> CloudResult<()> {
        let [before, unreadable] = [seconds, UNREADABLE_S].map(|it| self.age_now() - int(it));
        let mut change = self.change().await?;
        let rows: Vec<(String, String)> = rows!(change; "SELECT name, vehicle FROM clips
             WHERE state IN ('vehicle', 'failed') AND parts > 0
             AND part_time <= CASE WHEN state = 'failed' THEN $2 ELSE $1 END"; before, unreadable);
        for (name, vehicle) in &rows {
            change.note_removed(vehicle, name, false).await?;
            run!(change; "UPDATE clips
                 SET parts = 0, received = 0 WHERE vehicle = $1 AND name = $2"; vehicle, name);
            change.count_clip_bytes(vehicle).await?;
        }
        change.commit().await
    }

    pub(crate) async fn clip_policy(&self) -> CloudResult<ClipPolicy> {
        let (upload, day_bytes, keep_s, keep_bytes): (String, u64, u64, u64) =
            one!(self; "SELECT upload, day_bytes, keep_s, keep_bytes FROM clip_policy");
        let upload = upload.parse().map_err(|error: String| {
            CloudError::usage("the rules for clips are damaged", "set them again").because(error)
        })?;
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
        run!(change; "UPDATE clip_policy SET upload = $1, day_bytes = $2,
             keep_s = $3, keep_bytes = $4"; upload.as_str(), day_bytes, keep_s, keep_bytes);
        let mut text = format!("{}, {day_bytes} bytes a day", upload.as_str());
        if *keep_s > 0 || *keep_bytes > 0 {
            text += &format!(", keep {keep_s} s and {keep_bytes} bytes");
        }
        change.note(actor, "set policy of clips", &text).await?;
        let connected = next_wanted!(" WHERE is_revoked = 0 AND epoch > 0 RETURNING name");
        let vehicles = rows!(change; connected);
        change.commit().await?;
        Ok(vehicles)
    }
}

impl StoreChange<'_> {
    async fn add_clip(&mut self, vehicle: &str, facts: &ClipFacts) -> CloudResult<()> {
        let last: i64 = one!(self; "SELECT COALESCE(MAX(seq), 0) FROM clips");
        let (name, sha256) = (facts.name.as_str(), facts.sha256.as_deref().unwrap_or(""));
        let scores = facts.moments.iter().filter_map(|moment| moment.score);
        // A cast of a float stops at the bounds of the integer.
        let score = (scores.fold(0.0, f64::max) * 1e6) as i64;
        let text = serde_json::to_string(facts).unwrap_or_default();
        let reason = facts.unreadable.as_ref().map_or_else(String::new, |cause| {
            format!("the vehicle cannot read it: {}", visible(&excerpt(cause)))
        });
        let state = match (sha256.is_empty(), reason.is_empty()) {
            (true, true) => "gone",
            (true, false) => "failed",
            (false, _) => "vehicle",
        };
        let inserted = run!(self; "INSERT INTO clips (seq, vehicle, name, facts, from_ns,
             to_ns, bytes, sha256, thumbnail, score, state, reason, disk) VALUES ($1, $2, $3,
             $4, $5, $6, $7, $8, $9, $10, $11, $12, $13) ON CONFLICT (vehicle, name) DO NOTHING";
            last + 1, vehicle, name, &text, facts.from_ns, facts.to_ns, facts.bytes, sha256,
            facts.thumbnail.as_deref().unwrap_or(""), score, state, &reason,
            CLIP_MIN + text.len() as u64);
        if inserted.rows_affected() == 0 {
            return self.change_clip(vehicle, facts, (state, &reason), &text).await;
        }
        let lambdas = facts.lambdas.iter().map(|it| ("lambda", &it.name));
        let labels = facts.moments.iter().map(|it| ("label", &it.label));
        // PostgreSQL stores no NUL. The facts have it, escaped.
        let words = lambdas.chain(labels).filter(|(_, word)| !word.contains('\0'));
        let words: BTreeSet<_> = words.collect();
        for (kind, word) in words {
            run!(self; "INSERT INTO clip_words (kind, word, clip) VALUES ($1, $2, $3)";
                kind, word, last + 1);
        }
        Ok(())
    }

    /// Changes a clip that is announced again, if its vehicle has deleted it, cannot read it any
    /// more, or can again.
    async fn change_clip(
        &mut self,
        vehicle: &str,
        facts: &ClipFacts,
        (state, reason): (&str, &str),
        text: &str,
    ) -> CloudResult<()> {
        let (name, sha256) = (facts.name.as_str(), facts.sha256.as_deref().unwrap_or(""));
        if state == "gone" {
            let reason = "the vehicle has deleted the file";
            return self.lose_clip(vehicle, &facts.name, reason, false).await;
        }
        if state == "failed" {
            run!(self; "UPDATE clips SET sha256 = '', state = 'failed', reason = $3
                 WHERE vehicle = $1 AND name = $2 AND state IN ('vehicle', 'failed')";
                vehicle, name, reason);
            return Ok(());
        }
        let (sha256_before, bytes, text_before): (String, u64, String) = one!(self; "SELECT sha256,
             bytes, facts FROM clips WHERE vehicle = $1 AND name = $2"; vehicle, name);
        if sha256_before.is_empty() && bytes != facts.bytes {
            self.note_removed(vehicle, name, false).await?;
        }
        // It goes on where it was: all of the file is compared at its end.
        let is_read = run!(self; "UPDATE clips SET sha256 = $3, state = 'vehicle',
             reason = '', facts = $4, bytes = $5, thumbnail = CASE WHEN has_thumbnail = 1
             THEN thumbnail ELSE $6 END, failures = 0, parts = CASE WHEN bytes = $5 THEN parts
             ELSE 0 END, received = CASE WHEN bytes = $5 THEN received ELSE 0 END, disk = disk + $7
             WHERE vehicle = $1 AND name = $2 AND sha256 = '' AND state = 'failed'";
            vehicle, name, sha256, text, facts.bytes, facts.thumbnail.as_deref().unwrap_or(""),
            text.len() as i64 - text_before.len() as i64);
        if is_read.rows_affected() == 0 && sha256_before != sha256 {
            tracing::warn!(vehicle, clip = name, "a clip was announced again with other content");
        }
        Ok(())
    }

    /// Notes that a file is not on its vehicle any more.
    async fn lose_clip(
        &mut self,
        vehicle: &str,
        name: &ClipName,
        reason: &str,
        is_thumbnail: bool,
    ) -> CloudResult<()> {
        let (name, reason) = (name.as_str(), visible(&excerpt(reason)));
        if is_thumbnail {
            run!(self; "UPDATE clips SET thumbnail = ''
                 WHERE vehicle = $1 AND name = $2 AND has_thumbnail = 0"; vehicle, name);
            return Ok(());
        }
        self.note_removed(vehicle, name, false).await?;
        run!(self; "UPDATE clips SET state = 'gone', reason = $3, parts = 0, received = 0 WHERE
             vehicle = $1 AND name = $2 AND state IN ('vehicle', 'failed')"; vehicle, name, reason);
        Ok(())
    }

    /// Forgets the oldest clips of a vehicle above the bound, but those whose files are stored.
    async fn forget_clips(&mut self, vehicle: &str, bounds: ClipBounds) -> CloudResult<()> {
        let count: i64 = one!(self;
            "SELECT COUNT(*) FROM clips WHERE vehicle = $1 AND state <> 'stored'"; vehicle);
        let above = count - int(bounds.clips);
        if above <= 0 {
            return Ok(());
        }
        let rows: Vec<(i64, String)> = rows!(self; "SELECT seq, name FROM clips
             WHERE vehicle = $1 AND state <> 'stored' ORDER BY seq LIMIT $2"; vehicle, above);
        for (seq, name) in &rows {
            self.forget_clip(*seq, vehicle, name).await?;
        }
        tracing::warn!(
            vehicle,
            clips = above,
            "deleted the oldest clips: the vehicle has too many"
        );
        Ok(())
    }
}
