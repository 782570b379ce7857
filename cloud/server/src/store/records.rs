//! Records of vehicles: each stored once, the newest kept.

use gleaner_fleet::{Ack, Cursor};
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::json;
use sqlx::AssertSqlSafe;

use super::vehicles::{ended, unknown};
use super::writer::VehicleWrite;
use super::{CloudStore, StoreChange, int, parts, placeholders, unsigned};
use crate::error::{CloudError, CloudResult};

/// Maximum number of streams of a vehicle: two, and one for each lambda that it ever had.
const STREAMS_MAX: i64 = 1000;
/// A stream that grows across a multiple of this, in bytes, is a reason to add up all streams of
/// its vehicle.
const SUM_STEP: i64 = 64 << 10;
/// Number of the oldest records that are looked at in one step of making room.
const STEP: i64 = 1000;

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

/// A batch to store, if the connection still counts.
struct AppendWrite {
    name: String,
    epoch: u64,
    batch: StreamBatch,
    retention: Retention,
}

/// Position and size of a stream.
struct StoredStream {
    cursor: Cursor,
    kept: i64,
    kept_bytes: i64,
}

impl VehicleWrite for AppendWrite {
    type Done = Ack;

    async fn apply(&self, change: &mut StoreChange<'_>) -> CloudResult<Ack> {
        let Self { name, epoch, batch, retention } = self;
        let Cursor { stream, life, next, .. } = &batch.cursor;
        let count = int(batch.lines.len() as u64);
        let arrived: Option<(i64,)> = row!(&mut *change.tx;
            "UPDATE vehicles SET arrived = arrived + $3
             WHERE name = $1 AND epoch = $2 AND is_revoked = 0 RETURNING arrived";
            name, int(*epoch), count);
        let (arrived,) = arrived.ok_or_else(ended)?;
        let stored = change.stored_stream(name, stream, *life).await?;
        let known = stored.cursor.next;
        // Those before the position were stored, and may have made room since.
        let arrivals = (arrived - count + 1..).zip(&batch.lines);
        let lines: Vec<_> =
            arrivals.filter(|(_, (seq, mark, _))| !mark.is_empty() || *seq >= known).collect();
        let (added, bytes) = change.insert_lines(name, &batch.cursor, &lines).await?;
        let (kept, kept_bytes) = (stored.kept + added, stored.kept_bytes + bytes);
        let cursor = moved(stored.cursor, &batch.cursor);
        change.set_stream(name, &cursor, (kept, kept_bytes)).await?;
        let excess = (kept - int(retention.records), kept_bytes - int(retention.bytes));
        change.make_room(name, stream, excess).await?;
        if stored.kept == 0 || kept_bytes / SUM_STEP > stored.kept_bytes / SUM_STEP {
            change.make_room_of_all(name, int(retention.vehicle_bytes)).await?;
        }
        Ok(Ack { stream: stream.clone(), life: *life, next: known.max(*next) })
    }
}

impl CloudStore {
    /// Stores records and the position after them, if the connection still counts. Records that
    /// are stored already are skipped.
    pub(crate) async fn append(
        &self,
        name: &str,
        epoch: u64,
        batch: StreamBatch,
        retention: Retention,
    ) -> CloudResult<Ack> {
        self.write(AppendWrite { name: name.to_owned(), epoch, batch, retention }).await
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

/// Returns the position of a stream after a batch that ends at `next`.
fn moved(stored: Cursor, next: &Cursor) -> Cursor {
    if next.next <= stored.next {
        return stored;
    }
    // A batch of nothing but gaps leaves the last record as it was.
    match next.boot.is_empty() {
        true => Cursor { life: next.life, next: next.next, ..stored },
        false => next.clone(),
    }
}

impl StoreChange<'_> {
    /// Returns what is stored of a stream; nothing of an earlier life counts as its position.
    async fn stored_stream(
        &mut self,
        name: &str,
        stream: &str,
        life: u64,
    ) -> CloudResult<StoredStream> {
        let row: Option<(i64, i64, i64, String, i64, i64, i64)> = row!(&mut *self.tx;
            "SELECT life, next, seq, boot, boot_ns, kept, kept_bytes FROM streams
             WHERE vehicle = $1 AND stream = $2";
            name, stream);
        let mut cursor = Cursor { stream: stream.to_owned(), life, ..Cursor::default() };
        let Some((stored, next, seq, boot, boot_ns, kept, kept_bytes)) = row else {
            let (streams,): (i64,) =
                one!(&mut *self.tx; "SELECT COUNT(*) FROM streams WHERE vehicle = $1"; name);
            if streams >= STREAMS_MAX {
                let message = format!("the vehicle has {streams} streams; no more are stored");
                return Err(CloudError::usage(message, "deploy under ids that were used before"));
            }
            return Ok(StoredStream { cursor, kept: 0, kept_bytes: 0 });
        };
        let stored = unsigned(stored);
        if stored > life {
            let message = format!("stream `{stream}` has life {stored}; this is {life}");
            return Err(CloudError::usage(message, "begin the next life of the stream"));
        }
        (cursor.seq, cursor.boot, cursor.boot_ns) = (unsigned(seq), boot, unsigned(boot_ns));
        if stored == life {
            cursor.next = unsigned(next);
        }
        Ok(StoredStream { cursor, kept, kept_bytes })
    }

    /// Inserts lines with their arrivals; returns the number and the bytes of those that were not
    /// there already.
    async fn insert_lines(
        &mut self,
        name: &str,
        cursor: &Cursor,
        lines: &[(i64, &(u64, String, String))],
    ) -> CloudResult<(i64, i64)> {
        let (mut added, mut bytes) = (0, 0);
        for part in parts(lines) {
            let sql = format!(
                "INSERT INTO records (vehicle, stream, life, seq, mark, arrival, line, bytes)
                 VALUES {} ON CONFLICT (vehicle, stream, life, seq, mark) DO NOTHING
                 RETURNING bytes",
                placeholders(part.len(), 3, 5)
            );
            let mut query = sqlx::query_as::<_, (i64,)>(AssertSqlSafe(sql))
                .bind(name)
                .bind(&cursor.stream)
                .bind(int(cursor.life));
            for (arrival, (seq, mark, line)) in part {
                let length = int(line.len() as u64);
                query = query.bind(int(*seq)).bind(mark).bind(arrival).bind(line).bind(length);
            }
            let inserted: Vec<(i64,)> = query.fetch_all(&mut *self.tx).await?;
            added += int(inserted.len() as u64);
            bytes += inserted.iter().map(|(length,)| length).sum::<i64>();
        }
        Ok((added, bytes))
    }

    /// Stores the position of a stream, and what is kept of it.
    async fn set_stream(
        &mut self,
        name: &str,
        cursor: &Cursor,
        (kept, kept_bytes): (i64, i64),
    ) -> CloudResult<()> {
        run!(&mut *self.tx;
            "INSERT INTO streams (vehicle, stream, life, next, seq, boot, boot_ns, kept, kept_bytes)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9)
             ON CONFLICT (vehicle, stream) DO UPDATE SET life = excluded.life,
             next = excluded.next, seq = excluded.seq, boot = excluded.boot,
             boot_ns = excluded.boot_ns, kept = excluded.kept, kept_bytes = excluded.kept_bytes";
            name, &cursor.stream, int(cursor.life), int(cursor.next), int(cursor.seq),
            &cursor.boot, int(cursor.boot_ns), kept, kept_bytes);
        Ok(())
    }

    /// Removes records of the largest streams of a vehicle while all have more than `most` bytes.
    async fn make_room_of_all(&mut self, name: &str, most: i64) -> CloudResult<()> {
        // Each step removes the excess, or all of a stream.
        for _ in 0..STREAMS_MAX {
            let streams: Vec<(String, i64)> = rows!(&mut *self.tx;
                "SELECT stream, kept_bytes FROM streams WHERE vehicle = $1
                 ORDER BY kept_bytes DESC";
                name);
            let excess = streams.iter().map(|(_, bytes)| bytes).sum::<i64>() - most;
            let Some((stream, bytes)) = streams.first() else { break };
            if excess <= 0 {
                break;
            }
            self.make_room(name, stream, (0, excess.min(*bytes))).await?;
        }
        Ok(())
    }

    /// Removes the oldest of a stream, as many records and bytes as are too many, and counts them.
    async fn make_room(
        &mut self,
        name: &str,
        stream: &str,
        (mut records, mut bytes): (i64, i64),
    ) -> CloudResult<()> {
        loop {
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
