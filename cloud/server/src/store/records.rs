//! Records of vehicles: each stored once, the newest kept.

use gleaner_fleet::{Ack, Cursor};
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::json;

use super::vehicles::{ended, unknown};
use super::{Change, Store, int, unsigned};
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
pub(crate) struct Batch {
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

impl Store {
    /// Stores records and the position after them, if the connection still counts. Records that
    /// are stored already are skipped.
    pub(crate) async fn append(
        &self,
        name: &str,
        epoch: u64,
        batch: &Batch,
        retention: Retention,
    ) -> CloudResult<Ack> {
        let Cursor { stream, life, next, .. } = &batch.cursor;
        let mut change = self.change().await?;
        let arrived: Option<(i64,)> = sqlx::query_as(
            "UPDATE vehicles SET arrived = arrived + $3
             WHERE name = $1 AND epoch = $2 AND is_revoked = 0 RETURNING arrived",
        )
        .bind(name)
        .bind(int(epoch))
        .bind(int(batch.lines.len() as u64))
        .fetch_optional(&mut *change.tx)
        .await?;
        let (arrived,) = arrived.ok_or_else(ended)?;
        let known = change.stored_next(name, stream, *life).await?;
        let first = arrived - int(batch.lines.len() as u64);
        let (mut added, mut bytes) = (0, 0);
        for (arrival, (seq, mark, line)) in (first + 1..).zip(&batch.lines) {
            // Those before the position were stored, and may have made room since.
            if mark.is_empty() && *seq < known {
                continue;
            }
            let row = sqlx::query(
                "INSERT INTO records (vehicle, stream, life, seq, mark, arrival, line, bytes)
                 VALUES ($1, $2, $3, $4, $5, $6, $7, $8)
                 ON CONFLICT (vehicle, stream, life, seq, mark) DO NOTHING",
            );
            let row = row.bind(name).bind(stream).bind(int(*life)).bind(int(*seq)).bind(mark);
            let row = row.bind(arrival).bind(line).bind(int(line.len() as u64));
            if row.execute(&mut *change.tx).await?.rows_affected() > 0 {
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
        let rows: Vec<(String, i64, i64, i64, String, i64)> = sqlx::query_as(
            "SELECT stream, life, next, seq, boot, boot_ns FROM streams WHERE vehicle = $1
             ORDER BY stream",
        )
        .bind(name)
        .fetch_all(&self.pool)
        .await?;
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
        let row: Option<(i64,)> = sqlx::query_as(
            "SELECT arrival FROM records WHERE vehicle = $1 AND stream IN ($2, $3)
             ORDER BY arrival DESC LIMIT 1 OFFSET $4",
        )
        .bind(vehicle)
        .bind(streams[0])
        .bind(streams[1])
        .bind(int(last as u64))
        .fetch_optional(&self.pool)
        .await?;
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
        let rows: Vec<(i64, String)> = sqlx::query_as(
            "SELECT arrival, line FROM records
             WHERE vehicle = $1 AND stream IN ($2, $3) AND arrival > $4 AND seq >= $5
             ORDER BY arrival LIMIT $6",
        )
        .bind(vehicle)
        .bind(streams[0])
        .bind(streams[1])
        .bind(after)
        .bind(int(from))
        .bind(most)
        .fetch_all(&self.pool)
        .await?;
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
        let exists: Option<(String,)> = sqlx::query_as("SELECT name FROM vehicles WHERE name = $1")
            .bind(vehicle)
            .fetch_optional(&self.pool)
            .await?;
        exists.ok_or_else(|| unknown(vehicle))?;
        let rows: Vec<(String, i64, i64)> = sqlx::query_as(
            "SELECT stream, removed, removed_to FROM streams
             WHERE vehicle = $1 AND stream IN ($2, $3) AND removed > 0 AND removed_to >= $4",
        )
        .bind(vehicle)
        .bind(streams[0])
        .bind(streams[1])
        .bind(int(from))
        .fetch_all(&self.pool)
        .await?;
        let line = |(stream, removed, to): (String, i64, i64)| {
            let record = json!({ "to": to, "reason": "Retention", "records": removed });
            let line = StreamLine {
                stream,
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

impl Change<'_> {
    /// Returns the number of the next record of this life of a stream.
    async fn stored_next(&mut self, name: &str, stream: &str, life: u64) -> CloudResult<u64> {
        let row: Option<(i64, i64)> =
            sqlx::query_as("SELECT life, next FROM streams WHERE vehicle = $1 AND stream = $2")
                .bind(name)
                .bind(stream)
                .fetch_optional(&mut *self.tx)
                .await?;
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
        let (streams,): (i64,) = sqlx::query_as("SELECT COUNT(*) FROM streams WHERE vehicle = $1")
            .bind(name)
            .fetch_one(&mut *self.tx)
            .await?;
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
        sqlx::query(
            "INSERT INTO streams (vehicle, stream, life, next, seq, boot, boot_ns)
             VALUES ($1, $2, $3, 0, 0, '', 0) ON CONFLICT (vehicle, stream) DO NOTHING",
        )
        .bind(name)
        .bind(&cursor.stream)
        .bind(int(cursor.life))
        .execute(&mut *self.tx)
        .await?;
        sqlx::query(
            "UPDATE streams SET kept = kept + $3, kept_bytes = kept_bytes + $4
             WHERE vehicle = $1 AND stream = $2",
        )
        .bind(name)
        .bind(&cursor.stream)
        .bind(added)
        .bind(bytes)
        .execute(&mut *self.tx)
        .await?;
        if moves {
            sqlx::query(
                "UPDATE streams SET life = $3, next = $4 WHERE vehicle = $1 AND stream = $2",
            )
            .bind(name)
            .bind(&cursor.stream)
            .bind(int(cursor.life))
            .bind(int(cursor.next))
            .execute(&mut *self.tx)
            .await?;
        }
        // A batch of nothing but gaps leaves the last record as it was.
        if moves && !cursor.boot.is_empty() {
            sqlx::query(
                "UPDATE streams SET seq = $3, boot = $4, boot_ns = $5
                 WHERE vehicle = $1 AND stream = $2",
            )
            .bind(name)
            .bind(&cursor.stream)
            .bind(int(cursor.seq))
            .bind(&cursor.boot)
            .bind(int(cursor.boot_ns))
            .execute(&mut *self.tx)
            .await?;
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
            let (kept, kept_bytes): (i64, i64) = sqlx::query_as(
                "SELECT kept, kept_bytes FROM streams WHERE vehicle = $1 AND stream = $2",
            )
            .bind(name)
            .bind(stream)
            .fetch_one(&mut *self.tx)
            .await?;
            let mut records = kept - int(retention.records);
            let mut bytes = kept_bytes - int(retention.bytes);
            if records <= 0 && bytes <= 0 {
                return Ok(());
            }
            let oldest: Vec<(i64, i64, i64)> = sqlx::query_as(
                "SELECT arrival, seq, bytes FROM records WHERE vehicle = $1 AND stream = $2
                 ORDER BY arrival LIMIT $3",
            )
            .bind(name)
            .bind(stream)
            .bind(STEP)
            .fetch_all(&mut *self.tx)
            .await?;
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
            sqlx::query("DELETE FROM records WHERE vehicle = $1 AND stream = $2 AND arrival <= $3")
                .bind(name)
                .bind(stream)
                .bind(last.0)
                .execute(&mut *self.tx)
                .await?;
            sqlx::query(
                "UPDATE streams SET kept = kept - $3, kept_bytes = kept_bytes - $4,
                     removed = removed + $3, removed_to = $5
                 WHERE vehicle = $1 AND stream = $2",
            )
            .bind(name)
            .bind(stream)
            .bind(removed)
            .bind(removed_bytes)
            .bind(last.1)
            .execute(&mut *self.tx)
            .await?;
        }
    }
}
