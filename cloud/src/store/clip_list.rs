//! Clips, as people see and want them.

use gleaner_fleet::clips::{ClipFacts, ClipId, ClipState, FleetClip, UploadedClips};
use gleaner_fleet::people::ListPage;
use schemars::JsonSchema;
use serde::Deserialize;

use super::CloudStore;
use super::wants::next_wanted;
use crate::error::{CloudError, CloudResult};
use crate::request::PageLimit;

/// A choice of clips.
#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct ClipQuery {
    /// Name of the vehicle.
    pub(crate) vehicle: Option<String>,
    /// Name of a lambda.
    pub(crate) lambda: Option<String>,
    /// Label of a moment.
    pub(crate) label: Option<String>,
    /// Begin of the time, in ns since 1970: clips that end before are left out.
    pub(crate) from_ns: Option<i64>,
    /// End of the time, in ns since 1970: clips that begin after are left out.
    pub(crate) to_ns: Option<i64>,
    /// `next` of the page before.
    pub(crate) after: Option<u64>,
    /// Maximum number of clips in a page.
    #[serde(default)]
    #[schemars(with = "Option<u16>", range(min = 1, max = 500))]
    pub(crate) limit: PageLimit,
}

typed! {
    struct ClipRow {
        seq: i64,
        vehicle: String,
        name: String,
        facts: String,
        bytes: u64,
        has_thumbnail: bool,
        is_requested: bool,
        state: String,
        reason: String,
        received: u64,
    }
}

macro_rules! select {
    ($rest:literal) => {
        concat! { "SELECT seq, vehicle, name, facts, bytes, has_thumbnail,
is_requested, state, reason, received FROM clips ", $rest }
    };
}

impl CloudStore {
    /// Returns a page of clips, the last announced first.
    pub(crate) async fn clips(&self, query: &ClipQuery) -> CloudResult<ListPage<FleetClip>> {
        let text = |value: &Option<String>| value.clone().unwrap_or_default();
        let count = u64::from(query.limit);
        let rows: Vec<ClipRow> = rows!(self;
            select!("WHERE seq < $1 AND ($2 = '' OR vehicle = $2)
             AND ($3 = '' OR EXISTS (SELECT 1 FROM clip_words
                  WHERE kind = 'lambda' AND word = $3 AND clip = seq))
             AND ($4 = '' OR EXISTS (SELECT 1 FROM clip_words
                  WHERE kind = 'label' AND word = $4 AND clip = seq))
             AND to_ns >= $5 AND from_ns <= $6
             ORDER BY seq DESC LIMIT $7");
            query.after.unwrap_or(u64::MAX), text(&query.vehicle), text(&query.lambda),
            text(&query.label), query.from_ns.unwrap_or(i64::MIN),
            query.to_ns.unwrap_or(i64::MAX), count);
        let is_full = rows.len() as u64 == count;
        let next = rows.last().filter(|_| is_full).map(|row| row.seq.to_string());
        let upload = self.clip_policy().await?.upload;
        let items = rows.into_iter().map(|row| clip(row, upload)).collect::<CloudResult<_>>()?;
        Ok(ListPage { items, next })
    }

    pub(crate) async fn clip(&self, id: &ClipId) -> CloudResult<FleetClip> {
        let row: Option<ClipRow> = row!(self;
            select!("WHERE vehicle = $1 AND name = $2"); id.vehicle(), id.name());
        let missing =
            || CloudError::missing(format!("there is no clip `{id}`"), "`gleaner clips` lists all");
        clip(row.ok_or_else(missing)?, self.clip_policy().await?.upload)
    }

    /// Marks the file of a clip, which was as in `before`, as wanted by a person; returns the clip.
    /// `is_lost` states that a file which was stored is not there any more.
    pub(crate) async fn pull_clip(
        &self,
        actor: &str,
        before: FleetClip,
        is_lost: bool,
    ) -> CloudResult<FleetClip> {
        let id = &before.id;
        let refused = |reason: &str, help: &str| {
            Err(CloudError::usage(format!("clip `{id}` cannot be fetched"), help).because(reason))
        };
        match before.state {
            ClipState::Stored if !is_lost => return Ok(before),
            ClipState::Gone => return refused("its vehicle has deleted it", "choose another clip"),
            _ if self.clip_policy().await?.upload == UploadedClips::None => {
                let help = "change that: `gleaner clips policy on-demand`";
                return refused("this cloud is set to fetch no clips", help);
            }
            _ => {}
        }
        let is_revoked: bool = one!(self;
            "SELECT is_revoked FROM vehicles WHERE name = $1"; id.vehicle());
        if is_revoked {
            let help = "enrol the vehicle again, or choose another clip";
            return refused("its vehicle was revoked, and can send nothing", help);
        }
        let mut change = self.change().await?;
        // It may have been stored since: that is not undone.
        let changed = run!(change; "UPDATE clips SET is_requested = 1, failures = 0, state = CASE
             WHEN sha256 = '' THEN state ELSE 'vehicle' END, parts = CASE WHEN state = 'stored'
             THEN 0 ELSE parts END, received = CASE WHEN state = 'stored' THEN 0 ELSE received END
             WHERE vehicle = $1 AND name = $2 AND (is_requested = 0 OR state <> 'vehicle') AND
             state <> 'gone' AND (state <> 'stored' OR $3 = 1)"; id.vehicle(), id.name(), is_lost);
        if changed.rows_affected() > 0 {
            change.count_clip_bytes(id.vehicle()).await?;
            change.note(actor, "pull clip", &id.to_string()).await?;
            // The vehicle reads its orders again with each new number.
            run!(change; next_wanted!(" WHERE name = $1"); id.vehicle());
        }
        change.commit().await?;
        self.clip(id).await
    }
}

fn clip(row: ClipRow, upload: UploadedClips) -> CloudResult<FleetClip> {
    let damaged = |error: String| {
        let message = format!("the clip `{}` of `{}` is damaged", row.name, row.vehicle);
        CloudError::usage(message, "report this").because(error)
    };
    let facts: ClipFacts =
        serde_json::from_str(&row.facts).map_err(|error| damaged(error.to_string()))?;
    let id = ClipId::new(facts.name.clone(), &row.vehicle).map_err(damaged)?;
    let state = match &*row.state {
        "stored" => ClipState::Stored,
        "gone" => ClipState::Gone,
        "failed" => ClipState::Failed,
        _ if !upload.wants(row.is_requested) => ClipState::OnVehicle,
        _ if row.received > 0 => ClipState::Uploading,
        _ => ClipState::Wanted,
    };
    Ok(FleetClip {
        id,
        state,
        received: row.received.min(row.bytes),
        reason: Some(row.reason).filter(|it| !it.is_empty()),
        has_thumbnail: row.has_thumbnail,
        vehicle: row.vehicle,
        facts,
    })
}
