//! Records of vehicles: each stored once, the newest kept.

use gleaner_fleet::{Ack, Cursor};
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::json;

use super::vehicles::{ended, unknown};
use super::{CloudStore, StoreChange, int, unsigned};
use crate::error::{CloudError, CloudResult};

/// Maximum number of streams of a vehicle: two, and one for each lambda that it ever had.
const STREAMS_MAX: i64 = 1000;
/// Number of the oldest records that are looked at in one step of making room.
const STEP: i64 = 1000;

/// Bounds of what is kept of each stream of each vehicle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Retention {
    pub(crate) records: u64,
    pub(crate) bytes: u64,
}

impl Retention {
    /// The bounds of the program.
    pub(crate) const DEFAULT: Retention = Retention { records: 100_000, bytes: 64 << 20 };
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
    /// Stores records and the position after them, if the connection still counts. Records that
    /// are stored already are skipped.
    pub(crate) async fn append(
        &self,
        name: &str,
        epoch: u64,
        batch: &StreamBatch,
        retention: Retention,
    ) -> CloudResult<Ack> {
        let Cursor { stream, life, next, .. } = &batch.cursor;
        let mut change = self.change().await?;
        let arrived: Option<(i64,)> = row!(&mut *change.tx;
            "UPDATE vehicles SET arrived = arrived + $3
             WHERE name = $1 AND epoch = $2 AND is_revoked = 0 RETURNING arrived";
            name, int(epoch), int(batch.lines.len() as u64));
        let (arrived,) = arrived.ok_or_else(ended)?;
        let known = change.stored_next(name, stream, *life).await?;
        let first = arrived - int(batch.lines.len() as u64);
        let (mut added, mut bytes) = (0, 0);
        for (arrival, (seq, mark, line)) in (first + 1..).zip(&batch.lines) {
            // Those before the position were stored, and may have made room since.
            if mark.is_empty() && *seq < known {
                continue;
            }
            let inserted = run!(&mut *change.tx;
                "INSERT INTO records (vehicle, stream, life, seq, mark, arrival, line, bytes)
                 VALUES ($1, $2, $3, $4, $5, $6, $7, $8)
                 ON CONFLICT (vehicle, stream, life, seq, mark) DO NOTHING";
                name, stream, int(*life), int(*seq), mark, arrival, line, int(line.len() as u64));
            if inserted.rows_affected() > 0 {
                added += 1;
                bytes += int(line.len() as u64);
            }
        }
        change.move_cursor(name, &batch.cursor, (added, bytes), *next > known).await?;
        change.make_room(name, stream, retention).await?;
        change.commit().await?;
        Ok(Ack { stream: stream.clone(), life: *life, next: known.max(*next) })
    }

    /// Returns the positions of all streams of a vehicle.
    pub(crate) async fn cursors(&self, name: &str) -> CloudResult<Vec<Cursor>> {
        let rows: Vec<(String, i64, i64, i64, String, i64)> = rows!(&self.pool;
            "SELECT stream, life, next, seq, boot, boot_ns FROM streams WHERE vehicle = $1
             ORDER BY stream";
            name);
        let cursor = |(stream, life, next, seq, boot, boot_ns)| Cursor {
            stream,
            life: unsigned(life),
            next: unsigned(next),
            seq: unsigned(seq),
            boot,
            boot_ns: unsigned(boot_ns),
        };
        Ok(rows.into_iter().map(cursor).collect())
    }

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

impl StoreChange<'_> {
    /// Returns the number of the next record of this life of a stream.
    async fn stored_next(&mut self, name: &str, stream: &str, life: u64) -> CloudResult<u64> {
        let row: Option<(i64, i64)> = row!(&mut *self.tx;
            "SELECT life, next FROM streams WHERE vehicle = $1 AND stream = $2";
            name, stream);
        if let Some((stored, next)) = row {
            return match unsigned(stored) {
                stored if stored == life => Ok(unsigned(next)),
                stored if stored < life => Ok(0),
                stored => {
                    let message = format!("stream `{stream}` has life {stored}; this is {life}");
                    Err(CloudError::usage(message, "begin the next life of the stream"))
                }
            };
        }
        let (streams,): (i64,) =
            one!(&mut *self.tx; "SELECT COUNT(*) FROM streams WHERE vehicle = $1"; name);
        if streams >= STREAMS_MAX {
            let message = format!("the vehicle has {streams} streams; no more are stored");
            return Err(CloudError::usage(message, "deploy under ids that were used before"));
        }
        Ok(0)
    }

    /// Stores the position after records, and counts those that were added.
    async fn move_cursor(
        &mut self,
        name: &str,
        cursor: &Cursor,
        (added, bytes): (i64, i64),
        moves: bool,
    ) -> CloudResult<()> {
        run!(&mut *self.tx;
            "INSERT INTO streams (vehicle, stream, life, next, seq, boot, boot_ns)
             VALUES ($1, $2, $3, 0, 0, '', 0) ON CONFLICT (vehicle, stream) DO NOTHING";
            name, &cursor.stream, int(cursor.life));
        run!(&mut *self.tx;
            "UPDATE streams SET kept = kept + $3, kept_bytes = kept_bytes + $4
             WHERE vehicle = $1 AND stream = $2";
            name, &cursor.stream, added, bytes);
        if moves {
            run!(&mut *self.tx;
                "UPDATE streams SET life = $3, next = $4 WHERE vehicle = $1 AND stream = $2";
                name, &cursor.stream, int(cursor.life), int(cursor.next));
        }
        // A batch of nothing but gaps leaves the last record as it was.
        if moves && !cursor.boot.is_empty() {
            run!(&mut *self.tx;
                "UPDATE streams SET seq = $3, boot = $4, boot_ns = $5
                 WHERE vehicle = $1 AND stream = $2";
                name, &cursor.stream, int(cursor.seq), &cursor.boot, int(cursor.boot_ns));
        }
        Ok(())
    }

    /// Removes the oldest records of a stream that are above the bounds, and counts them.
    async fn make_room(
        &mut self,
        name: &str,
        stream: &str,
        retention: Retention,
    ) -> CloudResult<()> {
        loop {
            let (kept, kept_bytes): (i64, i64) = one!(&mut *self.tx;
                "SELECT kept, kept_bytes FROM streams WHERE vehicle = $1 AND stream = $2";
                name, stream);
            let mut records = kept - int(retention.records);
            let mut bytes = kept_bytes - int(retention.bytes);
            if records <= 0 && bytes <= 0 {
                return Ok(());
            }
            let oldest: Vec<(i64, i64, i64)> = rows!(&mut *self.tx;
                "SELECT arrival, seq, bytes FROM records WHERE vehicle = $1 AND stream = $2
                 ORDER BY arrival LIMIT $3";
                name, stream, STEP);
            let (mut removed, mut removed_bytes, mut last) = (0, 0, (0, 0));
            for (arrival, seq, length) in oldest {
                if records <= 0 && bytes <= 0 {
                    break;
                }
                records -= 1;
                bytes -= length;
                removed += 1;
                removed_bytes += length;
                last = (arrival, seq);
            }
            if removed == 0 {
                return Ok(());
            }
            run!(&mut *self.tx;
                "DELETE FROM records WHERE vehicle = $1 AND stream = $2 AND arrival <= $3";
                name, stream, last.0);
            run!(&mut *self.tx;
                "UPDATE streams SET kept = kept - $3, kept_bytes = kept_bytes - $4,
                 removed = removed + $3, removed_to = $5
                 WHERE vehicle = $1 AND stream = $2";
                name, stream, removed, removed_bytes, last.1);
        }
    }
}
