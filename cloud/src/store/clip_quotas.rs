//! Bounds of clips: bytes on the disk of a vehicle and of all, and bytes that arrive in a day.
//!
//! The sum has what is on the disk: files as announced once some of them is stored, thumbnails,
//! entries, and files that are still to be removed. Each change of one of them makes the sum of its
//! vehicle again, so that no difference can add up.

use gleaner_fleet::clips::{ClipBudget, ClipId, ClipPolicy};

use super::{CloudStore, DAY_S, StoreChange, int, now, unsigned};
use crate::error::{CloudError, CloudResult};

/// Bytes that the entry of a clip takes on the disk beside its facts, with its words and indexes;
/// and bytes that a request counts as at least.
pub(super) const CLIP_MIN: u64 = 4 << 10;

#[derive(Debug, Clone, Copy)]
pub(crate) struct ClipBounds {
    /// Clips of a vehicle, with files or without.
    pub(crate) clips: u64,
    pub(crate) vehicle_bytes: u64,
    /// Bytes of all vehicles.
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

/// The bytes on the disk of a vehicle, and of all.
const USED: &str = "SELECT
    (SELECT COALESCE(MAX(disk), 0) FROM clip_vehicles WHERE vehicle = $1) AS own,
    (SELECT CAST(COALESCE(SUM(disk), 0) AS BIGINT) FROM clip_vehicles) AS total";

typed! {
    /// Bytes on the disk of clips of a vehicle, and of all vehicles.
    pub(super) struct UsedBytes {
        own: u64,
        total: u64,
    }
}

impl UsedBytes {
    pub(super) fn fits(&self, bytes: u64, bounds: ClipBounds) -> bool {
        self.excess(bytes, bounds).is_none()
    }

    /// Returns the reason why a further file of this length does not fit.
    fn excess(&self, bytes: u64, bounds: ClipBounds) -> Option<String> {
        let limits = [
            (self.own, bounds.vehicle_bytes, "of its vehicle"),
            (self.total, bounds.bytes, "of all vehicles"),
        ];
        let full = limits.into_iter().find(|(used, most, _)| used.saturating_add(bytes) > *most);
        full.map(|(used, most, of)| format!("clips {of} have {used} of {most} bytes already"))
    }
}

impl CloudStore {
    pub(super) async fn clip_usage(&self, vehicle: &str) -> CloudResult<UsedBytes> {
        Ok(one!(self; USED; vehicle))
    }

    /// Returns the budget of today.
    pub(super) async fn clip_budget(
        &self,
        vehicle: &str,
        policy: &ClipPolicy,
    ) -> CloudResult<ClipBudget> {
        let row: Option<(i64, i64)> = row!(self;
            "SELECT day, day_bytes FROM clip_vehicles WHERE vehicle = $1"; vehicle);
        let (day, arrived) = row.unwrap_or_default();
        let arrived = if day == today() { unsigned(arrived) } else { 0 };
        let bytes = policy.day_bytes;
        Ok(ClipBudget { day: unsigned(today()), bytes, is_spent: arrived >= bytes })
    }

    /// Fails if a file, or a thumbnail, of this length does not fit, or the day is used up. One
    /// that has begun has its place.
    pub(crate) async fn must_fit(
        &self,
        vehicle: &str,
        (file, bytes): (&str, Option<u64>),
        bounds: ClipBounds,
    ) -> CloudResult<()> {
        let mut full = None;
        if let Some(bytes) = bytes {
            full = self.clip_usage(vehicle).await?.excess(bytes, bounds);
        }
        let policy = self.clip_policy().await?;
        let budget = self.clip_budget(vehicle, &policy).await?;
        if budget.is_spent {
            full = Some(format!("the vehicle has sent its {} bytes of today", budget.bytes));
        }
        full.map_or(Ok(()), |reason| Err(no_room(file, reason)))
    }

    /// Counts bytes that have arrived of a request, whatever became of them.
    pub(crate) async fn clip_bytes_arrived(&self, vehicle: &str, bytes: u64) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(change;
            "INSERT INTO clip_vehicles (vehicle, day, day_bytes) VALUES ($1, $2, $3)
             ON CONFLICT (vehicle) DO UPDATE SET day = excluded.day, day_bytes =
             CASE WHEN clip_vehicles.day = excluded.day THEN clip_vehicles.day_bytes ELSE 0 END
             + excluded.day_bytes";
            vehicle, today(), int(bytes.max(CLIP_MIN)));
        change.commit().await
    }
}

impl StoreChange<'_> {
    /// Fails if a file that has begun in this change exceeds a bound: others have begun meanwhile.
    pub(super) async fn must_have_room(
        &mut self,
        id: &ClipId,
        bounds: ClipBounds,
    ) -> CloudResult<()> {
        let used: UsedBytes = one!(self; USED; id.vehicle());
        let excess = used.excess(0, bounds);
        excess.map_or(Ok(()), |reason| Err(no_room(&format!("clip `{}`", id.name()), reason)))
    }

    /// Counts the bytes of a vehicle on the disk again.
    pub(super) async fn count_clip_bytes(&mut self, vehicle: &str) -> CloudResult<()> {
        run!(self;
            "INSERT INTO clip_vehicles (vehicle, disk) VALUES ($1, CAST(
                 (SELECT COALESCE(SUM(disk + CASE WHEN parts > 0 THEN bytes ELSE 0 END), 0)
                  FROM clips WHERE vehicle = $1)
                 + (SELECT COALESCE(SUM(bytes), 0) FROM removed_clips WHERE vehicle = $1)
                 AS BIGINT))
             ON CONFLICT (vehicle) DO UPDATE SET disk = excluded.disk";
            vehicle);
        Ok(())
    }

    /// Notes the files of a clip that are to be removed, which count until they are: those of its
    /// recording or, if `is_whole`, all. The entry is changed afterwards.
    pub(super) async fn note_removed(
        &mut self,
        vehicle: &str,
        name: &str,
        is_whole: bool,
    ) -> CloudResult<()> {
        run!(self;
            "INSERT INTO removed_clips (vehicle, name, bytes)
             SELECT vehicle, name, received + CASE WHEN $3 = 1 THEN disk ELSE 0 END FROM clips
             WHERE vehicle = $1 AND name = $2 AND ($3 = 1 OR (parts > 0 AND state <> 'stored'))
             ON CONFLICT (vehicle, name) DO UPDATE SET
             bytes = removed_clips.bytes + excluded.bytes";
            vehicle, name, i64::from(is_whole));
        Ok(())
    }
}

fn no_room(file: &str, reason: String) -> CloudError {
    let help = "continue an unfinished upload, or wait until clips were removed";
    CloudError::busy(format!("there is no room for {file}"), help).because(reason)
}

fn today() -> i64 {
    now() / DAY_S
}
