//! Leases of streams that people read as records come, from all processes that serve the database.

use std::collections::{BTreeMap, BTreeSet};

use gleaner_fleet::{STATUS_STREAM, TAIL_S};

use super::{CloudStore, now};
use crate::error::CloudResult;

/// Time of a lease of a status, in s, which costs a whole report each second.
const STATUS_S: i64 = 30;

/// Streams of a vehicle that people read, and the end of their lease.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct VehicleTail {
    pub(crate) streams: BTreeSet<String>,
    /// Time in s since 1970.
    pub(crate) until: i64,
}

impl CloudStore {
    /// Extends the leases of these streams, each with its vehicle, and removes those that have
    /// ended. Returns the number of leases of all processes.
    pub(crate) async fn extend_live_streams(&self, read: &[(String, String)]) -> CloudResult<i64> {
        let mut change = self.change().await?;
        run!(change; "DELETE FROM tails WHERE until <= $1"; now());
        for (vehicle, stream) in read {
            let lease_s = if stream == STATUS_STREAM { STATUS_S } else { TAIL_S.into() };
            run!(change; "INSERT INTO tails (vehicle, stream, until) SELECT name, CAST($2 AS TEXT),
                 CAST($3 AS BIGINT) FROM vehicles WHERE name = $1 ON CONFLICT (vehicle, stream)
                 DO UPDATE SET until = excluded.until"; vehicle, stream, now() + lease_s);
        }
        let count = one!(change; "SELECT COUNT(*) FROM tails");
        change.commit().await?;
        Ok(count)
    }

    /// Returns the leases of vehicles that are connected to this process.
    pub(crate) async fn own_live_streams(&self) -> CloudResult<BTreeMap<String, VehicleTail>> {
        let rows: Vec<(String, String, i64)> = rows!(self; "SELECT tails.vehicle,
             tails.stream, tails.until FROM tails JOIN vehicles ON vehicles.name = tails.vehicle
             WHERE vehicles.replica = $1 AND tails.until > $2"; self.replica(), now());
        let mut live_streams: BTreeMap<String, VehicleTail> = BTreeMap::new();
        for (vehicle, stream, until) in rows {
            let tail = live_streams.entry(vehicle).or_default();
            tail.streams.insert(stream);
            tail.until = tail.until.max(until);
        }
        Ok(live_streams)
    }
}
