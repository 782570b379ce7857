//! Records in the order of their arrival.

use crate::error::CloudResult;
use crate::store::{KeptLine, RecordPage, StoredChunk};

use super::RecordArchive;
use super::files::ChunkContent;
use super::newest::{FoundLine, NewestFirst};

/// Maximum number of the newest records that are counted one by one: of more, all are sent.
const LAST_MAX: usize = 100_000;

impl RecordArchive {
    /// Returns records of two streams, which may be the same, that have arrived after `after` and
    /// have the number `from` or a later one: at most `most` rows, or those of a chunk of each.
    pub(crate) async fn record_page(
        &self,
        vehicle: &str,
        streams: [&str; 2],
        from: u64,
        after: i64,
        most: i64,
    ) -> CloudResult<RecordPage> {
        let mut position = after;
        loop {
            // The end first, and rows before chunks: what arrives meanwhile comes with the next
            // page, and what is moved meanwhile comes twice.
            let arrived = self.store.arrived(vehicle).await?;
            let part = (position, from);
            let mut lines = self.store.rows_after(vehicle, streams, part, most).await?;
            let last = lines.last().map(|(arrival, _)| *arrival);
            let is_full = lines.len() as i64 >= most;
            let mut until = last.filter(|_| is_full).unwrap_or(i64::MAX).min(arrived);
            let mut has_chunk = false;
            for stream in distinct(streams) {
                let Some((chunk, of_chunk)) = self.next_chunk((vehicle, stream), part).await?
                else {
                    continue;
                };
                has_chunk = true;
                until = until.min(chunk.last_arrival);
                let is_wanted = |it: &KeptLine| it.arrival > position && it.seq >= from;
                let of_chunk = of_chunk.into_iter().filter(is_wanted);
                lines.extend(of_chunk.map(|it| (it.arrival, it.line)));
            }
            if !has_chunk {
                let arrival = last.unwrap_or(position);
                return Ok(RecordPage { lines: texts(lines), arrival });
            }
            lines.retain(|(arrival, _)| *arrival <= until);
            lines.sort_by_key(|(arrival, _)| *arrival);
            lines.dedup_by_key(|(arrival, _)| *arrival);
            position = position.max(until);
            if !lines.is_empty() {
                return Ok(RecordPage { lines: texts(lines), arrival: position });
            }
        }
    }

    async fn next_chunk(
        &self,
        of: (&str, &str),
        part: (i64, u64),
    ) -> CloudResult<Option<(StoredChunk, Vec<KeptLine>)>> {
        loop {
            let Some(chunk) = self.store.chunk_after(of, part).await? else { return Ok(None) };
            match self.chunk_content(of, &chunk).await? {
                Some(ChunkContent::Lines(lines)) => return Ok(Some((chunk, lines))),
                Some(ChunkContent::Damaged(line)) => return Ok(Some((chunk, vec![line]))),
                None => {}
            }
        }
    }

    /// Returns the arrival before the `last` newest records of two streams, which may be the same;
    /// 0 if there are not more.
    pub(crate) async fn arrival_before(
        &self,
        vehicle: &str,
        streams: [&str; 2],
        last: usize,
    ) -> CloudResult<i64> {
        let kept = self.store.kept(vehicle, streams).await?;
        if kept <= last as u64 || last > LAST_MAX {
            return Ok(0);
        }
        let names = distinct(streams).into_iter().map(str::to_owned);
        let mut newest = NewestFirst::new(self, vehicle, names, (0, i64::MAX), last + 1);
        // Only the number counts.
        newest.longest = 0;
        while !newest.is_done() {
            let pick = |_: &str, found: &mut FoundLine| {
                found.line = String::new();
                true
            };
            newest.step(|_| false, pick).await?;
        }
        Ok(newest.found.get(last).map_or(0, |found| found.arrival))
    }
}

fn distinct(streams: [&str; 2]) -> Vec<&str> {
    match streams[0] == streams[1] {
        true => vec![streams[0]],
        false => streams.to_vec(),
    }
}

fn texts(lines: Vec<(i64, String)>) -> Vec<String> {
    lines.into_iter().map(|(_, line)| line).collect()
}
