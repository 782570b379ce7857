//! The index of chunks: files with many records of a stream, which follow one another. A stream has
//! its oldest records in chunks, and the newest in rows.
//!
//! The file of a chunk is noted before it is stored, and the note is removed by the transaction
//! that moves the records. Whatever is interrupted leaves a noted file, which is removed later.

use super::{CloudStore, StoreChange, int, now};
use crate::error::CloudResult;

const CHUNK_RECORDS: i64 = 8192;
/// Number of streams that are packed, and of files that are removed, at a time.
const AT_ONCE: i64 = 500;

typed! {
    #[derive(Debug, Clone, PartialEq, Eq)]
    pub(crate) struct KeptLine {
        pub(crate) arrival: i64,
        pub(crate) life: u64,
        pub(crate) seq: u64,
        pub(crate) line: String,
    }
}

typed! {
    #[derive(Debug, Clone, Default, PartialEq, Eq)]
    pub(crate) struct StoredChunk {
        pub(crate) first_arrival: i64,
        pub(crate) last_arrival: i64,
        pub(crate) first_seq: u64,
        pub(crate) last_seq: u64,
        /// Times of its records, in ns since 1970; 0 if none has one.
        pub(crate) first_time: i64,
        pub(crate) last_time: i64,
        /// The highest level of its records.
        pub(crate) level: i64,
        pub(crate) records: u64,
        /// Bytes of its lines, and of its file.
        pub(crate) bytes: u64,
        pub(crate) stored_bytes: u64,
        pub(crate) sha256: String,
    }
}

typed! {
    /// A line, or its place, with its length.
    struct SizedLine {
        line: KeptLine,
        bytes: u64,
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct ChunkSizes {
    /// Bytes of lines in a chunk.
    pub(crate) chunk: i64,
    /// Bytes of the newest lines that stay in rows.
    pub(crate) rows: i64,
}

impl ChunkSizes {
    pub(crate) const DEFAULT: ChunkSizes = ChunkSizes { chunk: 1 << 20, rows: 256 << 10 };
}

macro_rules! select {
    ($rest:literal) => {
        concat! { "SELECT first_arrival, last_arrival, first_seq, last_seq,
first_time, last_time, level, records, bytes, stored_bytes, sha256 FROM chunks ", $rest }
    };
}

impl CloudStore {
    /// Returns streams, with their vehicles, that have enough records in rows for a chunk.
    pub(crate) async fn packable(&self, sizes: ChunkSizes) -> CloudResult<Vec<(String, String)>> {
        Ok(rows!(self; "SELECT vehicle, stream FROM streams WHERE kept_bytes - packed_bytes >= $1
             ORDER BY kept_bytes - packed_bytes DESC LIMIT $2"; sizes.chunk + sizes.rows, AT_ONCE))
    }

    /// Returns the oldest records of a stream in rows, enough for a chunk; none if there are not.
    pub(crate) async fn oldest_lines(
        &self,
        (vehicle, stream): (&str, &str),
        sizes: ChunkSizes,
    ) -> CloudResult<Vec<KeptLine>> {
        let bytes: Option<i64> = row!(self; "SELECT kept_bytes - packed_bytes
             FROM streams WHERE vehicle = $1 AND stream = $2"; vehicle, stream);
        let bytes = bytes.unwrap_or(0);
        if bytes < sizes.chunk + sizes.rows {
            return Ok(Vec::new());
        }
        let lengths: Vec<(i64, i64)> = rows!(self; "SELECT arrival, bytes FROM records
             WHERE vehicle = $1 AND stream = $2 ORDER BY arrival LIMIT $3";
            vehicle, stream, CHUNK_RECORDS);
        let (mut taken, mut last) = (0, None);
        for (arrival, length) in lengths {
            // One that is longer than a chunk has one of its own, also if too few stay in rows:
            // a stream that was never packed would take the place of others.
            let is_full = taken + length > sizes.chunk || bytes - taken - length < sizes.rows;
            if taken > 0 && is_full {
                break;
            }
            (taken, last) = (taken + length, Some(arrival));
        }
        let Some(last) = last else { return Ok(Vec::new()) };
        Ok(rows!(self;
            "SELECT arrival, life, seq, line FROM records WHERE vehicle = $1
             AND stream = $2 AND arrival <= $3 ORDER BY arrival"; vehicle, stream, last))
    }

    /// Notes the file of a chunk that is about to be stored.
    pub(crate) async fn note_chunk_file(&self, sha256: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(change; "INSERT INTO chunk_files (sha256, since) VALUES ($1, $2)"; sha256, now());
        change.commit().await
    }

    /// Replaces the records of a chunk, whose file is stored and noted, by its entry in the index.
    /// Returns false, and changes nothing, if they are not all in rows any more, or the file may
    /// have been removed.
    pub(crate) async fn pack(
        &self,
        (vehicle, stream): (&str, &str),
        chunk: &StoredChunk,
    ) -> CloudResult<bool> {
        let StoredChunk { first_arrival, last_arrival, records, bytes, stored_bytes, .. } = chunk;
        let mut change = self.change().await?;
        let noted = run!(change;
            "DELETE FROM chunk_files WHERE sha256 = $1 AND since > 0"; &chunk.sha256);
        let moved = run!(change; "DELETE FROM records WHERE vehicle = $1 AND stream = $2
             AND arrival >= $3 AND arrival <= $4"; vehicle, stream, first_arrival, last_arrival);
        if noted.rows_affected() != 1 || moved.rows_affected() != *records {
            return Ok(false);
        }
        run!(change; "INSERT INTO chunks (vehicle, stream, first_arrival, last_arrival, first_seq,
             last_seq, first_time, last_time, level, records, bytes, stored_bytes, sha256)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13)";
            vehicle, stream, first_arrival, last_arrival, chunk.first_seq, chunk.last_seq,
            chunk.first_time, chunk.last_time, chunk.level, records, bytes, stored_bytes,
            &chunk.sha256);
        run!(change; "UPDATE streams SET kept_bytes = kept_bytes - $3 + $4, packed = packed + $5,
             packed_bytes = packed_bytes + $4 WHERE vehicle = $1 AND stream = $2";
            vehicle, stream, bytes, stored_bytes, records);
        change.commit().await?;
        Ok(true)
    }

    /// Returns the oldest chunk of a stream with a record after the arrival `after`, and one with
    /// the number `from` or a later one.
    pub(crate) async fn chunk_after(
        &self,
        (vehicle, stream): (&str, &str),
        (after, from): (i64, u64),
    ) -> CloudResult<Option<StoredChunk>> {
        Ok(row!(self;
            select!("WHERE vehicle = $1 AND stream = $2 AND last_arrival > $3 AND last_seq >= $4
             ORDER BY last_arrival LIMIT 1"); vehicle, stream, after, from))
    }

    /// Returns the newest chunk of a stream with a record between two arrivals, without both.
    pub(crate) async fn chunk_before(
        &self,
        (vehicle, stream): (&str, &str),
        (after, before): (i64, i64),
    ) -> CloudResult<Option<StoredChunk>> {
        Ok(row!(self;
            select!("WHERE vehicle = $1 AND stream = $2 AND first_arrival < $3
             AND last_arrival > $4 ORDER BY last_arrival DESC LIMIT 1");
            vehicle, stream, before, after))
    }

    pub(crate) async fn has_chunk(
        &self,
        (vehicle, stream): (&str, &str),
        chunk: &StoredChunk,
    ) -> CloudResult<bool> {
        Ok(one!(self;
            "SELECT COUNT(*) FROM chunks WHERE vehicle = $1 AND stream = $2 AND last_arrival = $3
             AND sha256 = $4"; vehicle, stream, chunk.last_arrival, &chunk.sha256))
    }

    /// Returns at most `most` of the last rows of a stream between two arrivals, the newest first.
    /// Of lines with more than `longest` bytes, the text is left out; the length of each comes
    /// with it.
    pub(crate) async fn rows_before(
        &self,
        (vehicle, stream): (&str, &str),
        (after, before): (i64, i64),
        (most, longest): (i64, i64),
    ) -> CloudResult<Vec<(KeptLine, u64)>> {
        let rows: Vec<SizedLine> = rows!(self;
            "SELECT arrival, life, seq, CASE WHEN bytes > $5 THEN '' ELSE line END AS line, bytes
             FROM records WHERE vehicle = $1 AND stream = $2 AND arrival < $3 AND arrival > $6
             ORDER BY arrival DESC LIMIT $4"; vehicle, stream, before, most, longest, after);
        Ok(rows.into_iter().map(|row| (row.line, row.bytes)).collect())
    }

    /// Returns files of chunks that no chunk needs: those to remove, and those whose chunk was not
    /// made within `grace_s`, which then cannot be made any more.
    pub(crate) async fn unneeded_chunk_files(&self, grace_s: i64) -> CloudResult<Vec<String>> {
        let late = now() - grace_s;
        let select = "SELECT sha256 FROM chunk_files WHERE since <= $1 ORDER BY since LIMIT $2";
        let files: Vec<String> = rows!(self; select; late, AT_ONCE);
        if files.is_empty() {
            return Ok(Vec::new());
        }
        let mut change = self.change().await?;
        run!(change; "UPDATE chunk_files SET since = 0 WHERE since <= $1"; late);
        change.commit().await?;
        Ok(rows!(self; select; 0_i64, AT_ONCE))
    }

    pub(crate) async fn forget_chunk_files(&self, removed: &[String]) -> CloudResult<()> {
        let mut change = self.change().await?;
        change.run_in("DELETE FROM chunk_files WHERE sha256 IN ($1..)", removed, &[]).await?;
        change.commit().await
    }
}

impl StoreChange<'_> {
    /// Removes the oldest chunk of a stream that ends at the arrival `to` or before, and counts its
    /// records as removed. Returns their number, and the bytes of its file.
    pub(super) async fn remove_oldest_chunk(
        &mut self,
        (vehicle, stream): (&str, &str),
        to: i64,
    ) -> CloudResult<Option<(i64, i64)>> {
        let chunk: Option<StoredChunk> = row!(self;
            select!("WHERE vehicle = $1 AND stream = $2 AND last_arrival <= $3
             ORDER BY last_arrival LIMIT 1"); vehicle, stream, to);
        let Some(chunk) = chunk else { return Ok(None) };
        run!(self; "DELETE FROM chunks WHERE vehicle = $1 AND stream = $2 AND last_arrival = $3";
            vehicle, stream, chunk.last_arrival);
        run!(self; "INSERT INTO chunk_files (sha256, since) VALUES ($1, 0)"; &chunk.sha256);
        let (records, bytes) = (int(chunk.records), int(chunk.stored_bytes));
        run!(self; "UPDATE streams SET kept = kept - $3, kept_bytes = kept_bytes - $4,
             packed = packed - $3, packed_bytes = packed_bytes - $4,
             removed = removed + $3, removed_to = $5
             WHERE vehicle = $1 AND stream = $2"; vehicle, stream, records, bytes, chunk.last_seq);
        Ok(Some((records, bytes)))
    }
}
