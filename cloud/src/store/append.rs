//! Records that vehicles send, those of many vehicles by few statements.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use gleaner_fleet::{Ack, Cursor};

use super::counting::{GroupVehicles, counting};
use super::numbers::{check_life, check_number};
use super::records::{Retention, StreamBatch};
use super::sql::{SqlValue, list_parts};
use super::writer::{VehicleWrite, Waiting};
use super::{CloudStore, StoreChange, int};
use crate::counts::COUNTS;
use crate::error::{CloudError, CloudResult};

/// Maximum number of streams of a vehicle: two, and one for each lambda that it ever had.
const STREAMS_MAX: i64 = 1000;
/// A stream that grows across a multiple of this, in bytes, is a reason to add up all streams of
/// its vehicle.
const SUM_STEP: i64 = 64 << 10;
/// Number of the oldest records that are looked at in one step of making room.
const STEP: i64 = 1000;

/// A batch of records, stored only if the connection is still the newest of its vehicle.
pub(super) struct AppendWrite {
    epoch: u64,
    batch: StreamBatch,
    retention: Retention,
}

/// The stored state of the streams of a group, by vehicle.
#[derive(Default)]
struct StoredStreams(HashMap<String, VehicleStreams>);

#[derive(Default)]
struct VehicleStreams {
    known: HashMap<String, StoredStream>,
    /// Number of all streams, if one of the group is new.
    count: i64,
}

typed! {
    struct StoredStream {
        vehicle: String,
        cursor: Cursor,
        kept: i64,
        kept_bytes: i64,
    }
}

columns!(Cursor: stream, life, next, seq, boot, boot_ns);

impl VehicleWrite for AppendWrite {
    type Done = Ack;

    const TURN: u8 = 2;

    async fn apply(
        change: &mut StoreChange<'_>,
        vehicles: &mut GroupVehicles,
        appends: &mut [&mut Waiting<Self>],
    ) -> CloudResult<()> {
        let keys = appends.iter().map(|it| (&*it.vehicle, &*it.write.batch.cursor.stream));
        let mut streams = change.streams_of(&keys.collect::<Vec<_>>()).await?;
        let (mut lines, mut others, mut grown) = (Vec::new(), 0, BTreeMap::new());
        for waiting in appends.iter_mut() {
            let AppendWrite { epoch, batch, retention } = &waiting.write;
            let name = &waiting.vehicle;
            let Cursor { stream, life, next, .. } = &batch.cursor;
            let checked = counting(vehicles, name, int(*epoch))
                .and_then(|vehicle| Ok((vehicle, streams.begin(name, stream, *life)?)));
            let checked = checked.map_err(|error| waiting.result = Some(Err(error)));
            let Ok((vehicle, stored)) = checked else { continue };
            let known = stored.cursor.next;
            for (seq, mark, text) in &batch.lines {
                vehicle.arrived += 1;
                // Those before the position were stored, and may have made room since.
                if !mark.is_empty() || *seq >= known {
                    lines.push(values! {
                        name, stream, life, seq, mark, vehicle.arrived, text, text.len()
                    });
                    others += usize::from(mark.is_empty());
                }
            }
            stored.cursor = moved(std::mem::take(&mut stored.cursor), &batch.cursor);
            grown.insert((&**name, &**stream), *retention);
            let ack = Ack { stream: stream.clone(), life: *life, next: known.max(*next) };
            waiting.result = Some(Ok(ack));
        }
        let before = grown.keys().map(|key| streams.get(*key).map_or(0, |it| it.kept_bytes));
        let before: Vec<_> = before.collect();
        change.insert_lines(&lines, others, &mut streams).await?;
        let arrived: BTreeSet<_> = grown.keys().map(|(vehicle, _)| *vehicle).collect();
        let arrived =
            arrived.iter().filter_map(|it| Some(values! { *it, vehicles.get(*it)?.arrived }));
        change.upsert(("vehicles", "name", "arrived"), &arrived.collect::<Vec<_>>()).await?;
        let rows = grown.keys().filter_map(|key| {
            let StoredStream { vehicle, cursor, kept, kept_bytes } = streams.get(*key)?;
            let Cursor { stream, life, next, seq, boot, boot_ns } = cursor;
            Some(values! { vehicle, stream, life, next, seq, boot, boot_ns, kept, kept_bytes })
        });
        let others = "life, next, seq, boot, boot_ns, kept, kept_bytes";
        change.upsert(("streams", "vehicle, stream", others), &rows.collect::<Vec<_>>()).await?;
        change.make_room_where_due(&grown, &streams, &before).await
    }
}

type StreamKey<'a> = (&'a str, &'a str);

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
        check_number("`next` of a batch of records", batch.cursor.next)?;
        // Streams that end at 0 are those that the vehicle has not begun again since a revocation.
        if batch.cursor.next == 0 {
            return Err(CloudError::usage("a batch of records ends at 0", "send its records"));
        }
        let records = batch.lines.len() as u64;
        let ack = self.write(name, AppendWrite { epoch, batch, retention }).await?;
        COUNTS.records.add(records);
        Ok(ack)
    }
}

impl StoredStreams {
    fn get(&self, (vehicle, stream): StreamKey<'_>) -> Option<&StoredStream> {
        self.0.get(vehicle)?.known.get(stream)
    }

    fn get_mut(&mut self, (vehicle, stream): StreamKey<'_>) -> Option<&mut StoredStream> {
        self.0.get_mut(vehicle)?.known.get_mut(stream)
    }

    /// Returns a stream that gets records of a life; the position of an earlier one does not count.
    /// Fails if the life has ended or is too large, or the vehicle has too many streams.
    fn begin(&mut self, vehicle: &str, stream: &str, life: u64) -> CloudResult<&mut StoredStream> {
        let VehicleStreams { known, count } = self.0.entry(vehicle.to_owned()).or_default();
        let last = known.get(stream).map(|it| it.cursor.life);
        check_life(stream, last, life)?;
        let is_new = last.is_none();
        if is_new && *count >= STREAMS_MAX {
            let message = format!("the vehicle has {count} streams; no more are stored");
            return Err(CloudError::usage(message, "deploy under ids that were used before"));
        }
        *count += i64::from(is_new);
        let stored = known.entry(stream.to_owned()).or_insert_with(|| {
            let cursor = Cursor { stream: stream.to_owned(), life, ..Cursor::default() };
            StoredStream { vehicle: vehicle.to_owned(), cursor, kept: 0, kept_bytes: 0 }
        });
        if stored.cursor.life > life {
            let known = stored.cursor.life;
            let message = format!("stream `{stream}` has life {known}; this is {life}");
            return Err(CloudError::usage(message, "begin the next life of the stream"));
        }
        if stored.cursor.life < life {
            // Records of the life before have nothing to do with it.
            stored.cursor = Cursor { stream: stream.to_owned(), life, ..Cursor::default() };
        }
        Ok(stored)
    }
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
    pub(super) async fn cursors_of(
        &mut self,
        vehicles: &[&String],
    ) -> CloudResult<HashMap<String, Vec<Cursor>>> {
        let mut cursors = HashMap::<_, Vec<_>>::new();
        let rows: Vec<StoredStream> = rows_in!(self;
            "SELECT vehicle, stream, life, next, seq, boot, boot_ns, kept, kept_bytes
             FROM streams WHERE vehicle IN ($1..) ORDER BY stream"; vehicles);
        for StoredStream { vehicle, cursor, .. } in rows {
            cursors.entry(vehicle).or_default().push(cursor);
        }
        Ok(cursors)
    }

    async fn streams_of(&mut self, keys: &[StreamKey<'_>]) -> CloudResult<StoredStreams> {
        let mut streams = StoredStreams::default();
        let keys_of: Vec<_> = keys.iter().map(|key| values! { key.0, key.1 }).collect();
        for part in list_parts(&keys_of) {
            let sql = "SELECT vehicle, stream, life, next, seq, boot, boot_ns, kept, kept_bytes
                       FROM streams WHERE (vehicle, stream) IN (VALUES ())";
            let rows: Vec<StoredStream> = self.with_values(sql, &part).await?;
            for stored in rows {
                let known = &mut streams.0.entry(stored.vehicle.clone()).or_default().known;
                known.insert(stored.cursor.stream.clone(), stored);
            }
        }
        // Vehicles with a stream that is new.
        let new = keys.iter().filter(|key| streams.get(**key).is_none());
        let names: BTreeSet<_> = new.map(|(vehicle, _)| *vehicle).collect();
        let names: Vec<_> = names.into_iter().collect();
        let counts: Vec<(String, i64)> = rows_in!(self; "SELECT vehicle, COUNT(*)
             FROM streams WHERE vehicle IN ($1..) AND next > 0 GROUP BY vehicle"; &names);
        for (vehicle, count) in counts {
            streams.0.entry(vehicle).or_default().count = count;
        }
        Ok(streams)
    }

    /// Inserts lines with their arrivals, of which `others` have no mark, and adds those that were
    /// not there already to their streams.
    /// Fails if a record has the number of another one: it would be acknowledged and lost. No
    /// vehicle sends it, as records before the position are left out.
    async fn insert_lines(
        &mut self,
        lines: &[[SqlValue<'_>; 8]],
        mut others: usize,
        streams: &mut StoredStreams,
    ) -> CloudResult<()> {
        let inserted: Vec<(String, String, String, i64)> = self
            .insert(
                "INSERT INTO records (vehicle, stream, life, seq, mark, arrival, line, bytes)
                 VALUES () ON CONFLICT (vehicle, stream, life, seq, mark) DO NOTHING
                 RETURNING vehicle, stream, mark, bytes",
                lines,
            )
            .await?;
        for (vehicle, stream, mark, bytes) in inserted {
            others -= usize::from(mark.is_empty());
            if let Some(stored) = streams.get_mut((&vehicle, &stream)) {
                stored.kept += 1;
                stored.kept_bytes += bytes;
            }
        }
        if others > 0 {
            // Alone in its group, it is refused alone.
            let message = "a record has the number of another one that is stored";
            let help = "revoke the vehicle, and enrol it again: then its streams begin again";
            return Err(CloudError::usage(message, help));
        }
        Ok(())
    }

    /// Removes the oldest records of streams, and of vehicles, that have too many. `before` are the
    /// bytes of each stream so far.
    async fn make_room_where_due(
        &mut self,
        grown: &BTreeMap<StreamKey<'_>, Retention>,
        streams: &StoredStreams,
        before: &[i64],
    ) -> CloudResult<()> {
        let mut to_sum = BTreeMap::new();
        for ((key, retention), before) in grown.iter().zip(before) {
            let Some(stored) = streams.get(*key) else { continue };
            let records = stored.kept - int(retention.records);
            let bytes = stored.kept_bytes - int(retention.bytes);
            self.make_room(key.0, key.1, (records, bytes)).await?;
            if *before == 0 || stored.kept_bytes / SUM_STEP > before / SUM_STEP {
                to_sum.insert(key.0, int(retention.vehicle_bytes));
            }
        }
        let names: Vec<_> = to_sum.keys().copied().collect();
        let sums: Vec<(String, i64)> = rows_in!(self; "SELECT vehicle, CAST(SUM(kept_bytes)
             AS BIGINT) FROM streams WHERE vehicle IN ($1..) GROUP BY vehicle"; &names);
        for (vehicle, bytes) in sums {
            let most = to_sum.get(&*vehicle).copied().unwrap_or(i64::MAX);
            if bytes > most {
                self.make_room_of_all(&vehicle, most).await?;
            }
        }
        Ok(())
    }

    /// Removes records of the largest streams of a vehicle while all have more than `most` bytes.
    async fn make_room_of_all(&mut self, name: &str, most: i64) -> CloudResult<()> {
        // Each step removes the excess, or all of a stream.
        for _ in 0..STREAMS_MAX {
            let streams: Vec<(String, i64)> = rows!(self; "SELECT stream, kept_bytes
                 FROM streams WHERE vehicle = $1 ORDER BY kept_bytes DESC"; name);
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
        while records > 0 || bytes > 0 {
            // The oldest are in chunks, of which each goes as a whole.
            if let Some(chunk) = self.remove_oldest_chunk((name, stream), i64::MAX).await? {
                (records, bytes) = (records - chunk.0, bytes - chunk.1);
                continue;
            }
            let oldest: Vec<(i64, i64, i64)> = rows!(self; "SELECT arrival, seq, bytes FROM records
                 WHERE vehicle = $1 AND stream = $2 ORDER BY arrival LIMIT $3"; name, stream, STEP);
            let (mut removed, mut removed_bytes, mut last) = (0, 0, None);
            for (arrival, seq, length) in oldest {
                if records - removed <= 0 && bytes - removed_bytes <= 0 {
                    break;
                }
                (removed, removed_bytes) = (removed + 1, removed_bytes + length);
                last = Some((arrival, seq));
            }
            let Some((to, seq)) = last else { return Ok(()) };
            self.remove_rows((name, stream), to, (removed, removed_bytes, seq)).await?;
            (records, bytes) = (records - removed, bytes - removed_bytes);
        }
        Ok(())
    }

    /// Removes the rows of a stream up to an arrival, and counts them: their number, their bytes,
    /// and the number of the last record.
    pub(super) async fn remove_rows(
        &mut self,
        (vehicle, stream): StreamKey<'_>,
        to: i64,
        (records, bytes, seq): (i64, i64, i64),
    ) -> CloudResult<()> {
        run!(self; "DELETE FROM records WHERE vehicle = $1 AND stream = $2 AND arrival <= $3";
            vehicle, stream, to);
        run!(self; "UPDATE streams SET kept = kept - $3, kept_bytes = kept_bytes - $4,
             removed = removed + $3, removed_to = $5 WHERE vehicle = $1 AND stream = $2";
            vehicle, stream, records, bytes, seq);
        Ok(())
    }
}
