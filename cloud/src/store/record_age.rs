//! Records that are too old. Rows have no time of the cloud: once a day, it notes the last arrival
//! of each vehicle, and all records up to a note are at least as old as it is. Days are those of
//! the clock by which records age.

use super::{CloudStore, DAY_S};
use crate::error::CloudResult;

/// Number of vehicles whose records are removed at a time.
const VEHICLES_AT_ONCE: i64 = 100;

impl CloudStore {
    /// Notes the last arrival of each vehicle, once a day, unless it is that of an earlier note.
    pub(crate) async fn note_arrivals(&self) -> CloudResult<()> {
        self.note_arrivals_on(self.age_now() / DAY_S).await
    }

    pub(crate) async fn note_arrivals_on(&self, day: i64) -> CloudResult<()> {
        let noted: Option<i64> =
            row!(self; "SELECT day FROM arrival_days WHERE day >= $1 LIMIT 1"; day);
        if noted.is_some() {
            return Ok(());
        }
        let mut change = self.change().await?;
        run!(change; "INSERT INTO arrival_days (vehicle, day, arrived) SELECT name,
             CAST($1 AS BIGINT), arrived FROM vehicles WHERE arrived > 0 AND NOT EXISTS (SELECT 1
             FROM arrival_days WHERE arrival_days.vehicle = vehicles.name AND
             arrival_days.arrived = vehicles.arrived) ON CONFLICT (vehicle, day) DO NOTHING"; day);
        change.commit().await
    }

    /// Removes records that arrived at least this many days ago, those of some vehicles; returns
    /// whether there may be more. A note of a day may be of its last minute, so that a day counts
    /// once it has been over for that long.
    pub(crate) async fn expire_records(&self, days: u32) -> CloudResult<bool> {
        let last = self.age_now() / DAY_S - i64::from(days) - 1;
        let old: Vec<(String, i64)> = rows!(self; "SELECT vehicle, MAX(arrived) FROM arrival_days
             WHERE day <= $1 GROUP BY vehicle ORDER BY vehicle LIMIT $2"; last, VEHICLES_AT_ONCE);
        for (vehicle, arrived) in &old {
            self.expire_vehicle(vehicle, *arrived, last).await?;
        }
        if !old.is_empty() {
            tracing::info!(vehicles = old.len(), days, "deleted records by age");
        }
        Ok(old.len() as i64 == VEHICLES_AT_ONCE)
    }

    /// Removes the records of a vehicle up to an arrival, and its notes up to a day. Of a chunk,
    /// all have to be old enough.
    async fn expire_vehicle(&self, vehicle: &str, arrived: i64, day: i64) -> CloudResult<()> {
        let mut change = self.change().await?;
        let streams: Vec<String> = rows!(change;
            "SELECT stream FROM streams WHERE vehicle = $1 AND kept > 0"; vehicle);
        for stream in &streams {
            while change.remove_oldest_chunk((vehicle, stream), arrived).await?.is_some() {}
            let (count, bytes): (i64, i64) = one!(change;
                "SELECT COUNT(*), CAST(COALESCE(SUM(bytes), 0) AS BIGINT) FROM records
                 WHERE vehicle = $1 AND stream = $2 AND arrival <= $3"; vehicle, stream, arrived);
            let seq: Option<i64> = row!(change;
                "SELECT seq FROM records WHERE vehicle = $1 AND stream = $2
                 AND arrival <= $3 ORDER BY arrival DESC LIMIT 1"; vehicle, stream, arrived);
            let Some(seq) = seq else { continue };
            change.remove_rows((vehicle, stream), arrived, (count, bytes, seq)).await?;
        }
        run!(change; "DELETE FROM arrival_days WHERE vehicle = $1 AND day <= $2"; vehicle, day);
        change.commit().await
    }
}
