//! Records of vehicles: each stored once, the newest kept.

use gleaner_fleet::Cursor;
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::json;

use super::vehicles::unknown;
use super::{CloudStore, int};
use crate::error::CloudResult;

/// Bounds of what is kept of each stream of each vehicle, and of all of them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Retention {
    pub(crate) records: u64,
    pub(crate) bytes: u64,
    /// Bound of all streams of a vehicle together.
    pub(crate) vehicle_bytes: u64,
}

impl Retention {
    /// The bounds of the program.
    pub(crate) const DEFAULT: Retention =
        Retention { records: 100_000, bytes: 64 << 20, vehicle_bytes: 512 << 20 };
}

/// Records of a stream that a vehicle has sent.
#[derive(Debug)]
pub(crate) struct StreamBatch {
    /// Number, mark and text of each line; the mark is empty for records.
    pub(crate) lines: Vec<(u64, String, String)>,
    /// The position after them.
    pub(crate) cursor: Cursor,
}

/// A part of stored records.
#[derive(Debug, Default)]
pub(crate) struct RecordPage {
    pub(crate) lines: Vec<String>,
    /// Number of the last arrival; the next page begins after it.
    pub(crate) arrival: i64,
}

impl CloudStore {
    /// Returns the arrival before the `last` newest records of two streams, which may be the same;
    /// 0 if there are not more.
    pub(crate) async fn arrival_before(
        &self,
        vehicle: &str,
        streams: [&str; 2],
        last: usize,
    ) -> CloudResult<i64> {
        let row: Option<(i64,)> = row!(&self.pool;
            "SELECT arrival FROM records WHERE vehicle = $1 AND stream IN ($2, $3)
             ORDER BY arrival DESC LIMIT 1 OFFSET $4";
            vehicle, streams[0], streams[1], int(last as u64));
        Ok(row.map_or(0, |(arrival,)| arrival))
    }

    /// Returns at most `most` records of two streams, which may be the same, that have arrived
    /// after `after` and have the number `from` or a later one.
    pub(crate) async fn page(
        &self,
        vehicle: &str,
        streams: [&str; 2],
        from: u64,
        after: i64,
        most: i64,
    ) -> CloudResult<RecordPage> {
        let rows: Vec<(i64, String)> = rows!(&self.pool;
            "SELECT arrival, line FROM records
             WHERE vehicle = $1 AND stream IN ($2, $3) AND arrival > $4 AND seq >= $5
             ORDER BY arrival LIMIT $6";
            vehicle, streams[0], streams[1], after, int(from), most);
        let arrival = rows.last().map_or(after, |(arrival, _)| *arrival);
        Ok(RecordPage { lines: rows.into_iter().map(|(_, line)| line).collect(), arrival })
    }

    /// Returns a line for each of two streams, which may be the same, of which records with the
    /// number `from` or a later one were removed to make room.
    ///
    /// # Errors
    ///
    /// An error if there is no such vehicle.
    pub(crate) async fn removed(
        &self,
        vehicle: &str,
        streams: [&str; 2],
        from: u64,
    ) -> CloudResult<Vec<String>> {
        let exists: Option<(String,)> =
            row!(&self.pool; "SELECT name FROM vehicles WHERE name = $1"; vehicle);
        exists.ok_or_else(|| unknown(vehicle))?;
        let rows: Vec<(String, i64, i64)> = rows!(&self.pool;
            "SELECT stream, removed, removed_to FROM streams
             WHERE vehicle = $1 AND stream IN ($2, $3) AND removed > 0 AND removed_to >= $4";
            vehicle, streams[0], streams[1], int(from));
        let line = |(stream, removed, to): (String, i64, i64)| {
            let record = json!({ "to": to, "reason": "Retention", "records": removed });
            let line = StreamLine {
                stream: name_in_lines(&stream).to_owned(),
                seq: 0,
                time_ns: 0,
                boot_ns: 0,
                boot: String::new(),
                kind: "gap".to_owned(),
                record,
            };
            serde_json::to_string(&line).unwrap_or_default()
        };
        Ok(rows.into_iter().map(line).collect())
    }
}

/// Returns the name of a stream in its lines: of a lambda's records, the id of its deployment.
pub(crate) fn name_in_lines(stream: &str) -> &str {
    stream.strip_prefix("lambdas/").unwrap_or(stream)
}
