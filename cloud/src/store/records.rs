//! Records of vehicles: each stored once, the newest kept.

use gleaner_fleet::Cursor;
use gleaner_protocol::vehicle_api::StreamLine;

use super::CloudStore;
use super::sql::json;
use super::vehicles::unknown;
use crate::error::CloudResult;

/// Bounds of what is kept of each stream of each vehicle, and of all of them. Of records in chunks,
/// the bytes are those of the files.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Retention {
    pub(crate) records: u64,
    pub(crate) bytes: u64,
    /// Bound of all streams of a vehicle together.
    pub(crate) vehicle_bytes: u64,
}

impl Retention {
    pub(crate) const DEFAULT: Retention =
        Retention { records: 1_000_000, bytes: 64 << 20, vehicle_bytes: 512 << 20 };
}

#[derive(Debug)]
pub(crate) struct StreamBatch {
    /// Number, mark and text of each line; the mark is empty for records.
    pub(crate) lines: Vec<(u64, String, String)>,
    pub(crate) cursor: Cursor,
}

#[derive(Debug, Default)]
pub(crate) struct RecordPage {
    pub(crate) lines: Vec<String>,
    /// Number of the last arrival; the next page begins after it.
    pub(crate) arrival: i64,
}

impl CloudStore {
    /// Fails if there is no such vehicle.
    pub(crate) async fn vehicle_exists(&self, vehicle: &str) -> CloudResult<()> {
        let exists: Option<String> =
            row!(self; "SELECT name FROM vehicles WHERE name = $1"; vehicle);
        exists.map(drop).ok_or_else(|| unknown(vehicle))
    }

    /// Returns the number of the last arrival of a vehicle: all up to it are visible.
    pub(crate) async fn arrived(&self, vehicle: &str) -> CloudResult<i64> {
        Ok(one!(self; "SELECT COALESCE(MAX(arrived), 0) FROM vehicles WHERE name = $1"; vehicle))
    }

    /// Returns the number of records of two streams, which may be the same, in rows and in chunks.
    pub(crate) async fn kept(&self, vehicle: &str, streams: [&str; 2]) -> CloudResult<u64> {
        Ok(one!(self;
            "SELECT CAST(COALESCE(SUM(kept), 0) AS BIGINT) FROM streams
             WHERE vehicle = $1 AND stream IN ($2, $3)"; vehicle, streams[0], streams[1]))
    }

    /// Returns the arrival of the oldest record of two streams, which may be the same, that has the
    /// number `from` or a later one; of a chunk, that of its first record.
    pub(crate) async fn oldest_arrival(
        &self,
        vehicle: &str,
        streams: [&str; 2],
        from: u64,
    ) -> CloudResult<Option<i64>> {
        Ok(one!(self;
            "SELECT MIN(first) FROM (SELECT MIN(first_arrival) AS first
             FROM chunks WHERE vehicle = $1 AND stream IN ($2, $3) AND last_seq >= $4
             UNION ALL SELECT MIN(arrival) AS first FROM records WHERE vehicle = $1
             AND stream IN ($2, $3) AND seq >= $4) AS ends"; vehicle, streams[0], streams[1], from))
    }

    /// Returns at most `most` rows of two streams, which may be the same, that have arrived after
    /// `after` and have the number `from` or a later one.
    pub(crate) async fn rows_after(
        &self,
        vehicle: &str,
        streams: [&str; 2],
        (after, from): (i64, u64),
        most: i64,
    ) -> CloudResult<Vec<(i64, String)>> {
        Ok(rows!(self; "SELECT arrival, line FROM records WHERE vehicle = $1 AND stream IN ($2, $3)
             AND arrival > $4 AND seq >= $5 ORDER BY arrival LIMIT $6";
            vehicle, streams[0], streams[1], after, from, most))
    }

    /// Returns a line for each of two streams, which may be the same, of which records with the
    /// number `from` or a later one were removed to make room.
    pub(crate) async fn removed(
        &self,
        vehicle: &str,
        streams: [&str; 2],
        from: u64,
    ) -> CloudResult<Vec<String>> {
        let rows: Vec<(String, i64, i64)> = rows!(self;
            "SELECT stream, removed, removed_to FROM streams WHERE vehicle = $1 AND stream IN ($2,
             $3) AND removed > 0 AND removed_to >= $4"; vehicle, streams[0], streams[1], from);
        let line = |(stream, removed, to): (String, i64, i64)| {
            let record = serde_json::json!({ "to": to, "reason": "Retention", "records": removed });
            line_of(&stream, "gap", record)
        };
        Ok(rows.into_iter().map(line).collect())
    }
}

/// Returns a line that the cloud itself makes.
pub(super) fn line_of(stream: &str, kind: &str, record: serde_json::Value) -> String {
    let (stream, kind) = (name_in_lines(stream).to_owned(), kind.to_owned());
    json(&StreamLine { stream, kind, record, ..StreamLine::default() })
}

/// Returns the name of a stream in its lines: of a lambda's records, the id of its deployment.
pub(crate) fn name_in_lines(stream: &str) -> &str {
    stream.strip_prefix("lambdas/").unwrap_or(stream)
}
