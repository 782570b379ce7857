use std::io::{self, Write};

use serde::Serialize;

use super::block::{HEAD_LEN, Head, MAGIC, PAYLOAD_MAX, PREAMBLE_LEN, kind};
use super::encode::Encoder;
use super::entry::JournalEntry;
use super::header::{JournalEnd, JournalHeader};
use super::number::{NUMBER_MAX, put};
use super::{ATTRIBUTES_MAX, INPUTS_MAX, TRIGGERS_MAX, VERSION};

/// A block of wakes is written when it is as long: small enough that its checksum names a place.
const CLOSE_AT: usize = 32 << 10;

/// A block is written when it has as many wakes: a writer that dies loses fewer. Where a block ends
/// depends on what is in it and on nothing else, so that the journals of equal runs are equal. Of 4
/// KB, its head and its first wake take some 60 bytes.
const CLOSE_AT_WAKES: u64 = 256;

/// Room for what comes before the wakes of a block, and is known when it is full.
const ROOM: usize = HEAD_LEN + NUMBER_MAX;

/// Writes a journal.
///
/// Wakes wait in a block until it is full or [`flush`](Self::flush) is called. A writer that is
/// dropped without [`finish`](Self::finish) loses those, and leaves a journal that is cut off.
pub struct JournalWriter<W: Write> {
    out: W,
    encoder: Encoder,
    inputs: usize,
    /// The block at hand: [`ROOM`], then its wakes.
    block: Vec<u8>,
    wakes: u64,
    blocks: u64,
    /// A block may be torn: what is written behind it could never be read.
    failed: bool,
}

impl<W: Write> JournalWriter<W> {
    /// Begins a journal: writes its header.
    ///
    /// # Errors
    ///
    /// Those of `out`, and [`io::ErrorKind::InvalidInput`] for a header that no reader would take.
    pub fn begin(out: W, header: &JournalHeader) -> io::Result<JournalWriter<W>> {
        let inputs = header.inputs.len();
        if inputs > INPUTS_MAX || header.event_input.is_some_and(|event| event >= inputs) {
            return Err(refused(
                "a header names more inputs than there may be, or one that is not there",
            ));
        }
        let mut block = Vec::with_capacity(ROOM + 2 * CLOSE_AT);
        block.resize(ROOM, 0);
        let encoder = Encoder::new(inputs);
        let mut writer =
            JournalWriter { out, encoder, inputs, block, wakes: 0, blocks: 0, failed: false };
        let mut bytes = Vec::with_capacity(PREAMBLE_LEN);
        bytes.extend_from_slice(&MAGIC);
        bytes.extend_from_slice(&VERSION.to_le_bytes());
        bytes.resize(PREAMBLE_LEN, 0);
        writer.write_json(kind::HEADER, header, bytes)?;
        Ok(writer)
    }

    /// Adds a wake.
    ///
    /// # Errors
    ///
    /// Those of `out`; after one, every further call fails, since the last block may be torn.
    /// [`io::ErrorKind::InvalidInput`] for a wake that no reader would take: it is left out, and
    /// the next one may follow.
    pub fn wake(&mut self, entry: &JournalEntry) -> io::Result<()> {
        self.usable()?;
        self.fits(entry)?;
        let before = self.block.len();
        self.encoder.encode(entry, &mut self.block);
        let payload = self.block.len() - HEAD_LEN;
        if payload > PAYLOAD_MAX {
            self.block.truncate(before);
            self.write_wakes()?;
            return Err(refused("a wake is larger than a block of a journal"));
        }
        self.wakes += 1;
        if payload >= CLOSE_AT || self.wakes >= CLOSE_AT_WAKES {
            self.write_wakes()
        } else {
            Ok(())
        }
    }

    /// Writes the wakes that wait, and flushes `out`.
    ///
    /// # Errors
    ///
    /// Those of `out`; after one, every further call fails.
    pub fn flush(&mut self) -> io::Result<()> {
        self.usable()?;
        self.write_wakes()?;
        let flushed = self.out.flush();
        self.failed = flushed.is_err();
        flushed
    }

    /// Writes the wakes that wait and the end, flushes, and gives `out` back.
    ///
    /// # Errors
    ///
    /// Those of `out`.
    pub fn finish(mut self, end: &JournalEnd) -> io::Result<W> {
        self.usable()?;
        self.write_wakes()?;
        self.write_json(kind::END, end, Vec::new())?;
        self.out.flush()?;
        Ok(self.out)
    }

    /// What was written so far.
    #[cfg(test)]
    pub(super) fn written(&self) -> &W {
        &self.out
    }

    fn usable(&self) -> io::Result<()> {
        match self.failed {
            true => Err(io::Error::other("an earlier write of this journal failed")),
            false => Ok(()),
        }
    }

    fn fits(&self, entry: &JournalEntry) -> io::Result<()> {
        if entry.seen.len() != self.inputs {
            return Err(refused("a wake has not the inputs of the header"));
        }
        if entry.triggers.len() > TRIGGERS_MAX {
            return Err(refused("a wake has more triggers than a journal takes"));
        }
        for trigger in &entry.triggers {
            let long = || {
                serde_json::to_string(&trigger.attributes)
                    .map_or(true, |json| json.len() > ATTRIBUTES_MAX)
            };
            if !trigger.attributes.is_empty() && long() {
                return Err(refused("a trigger has longer attributes than a journal takes"));
            }
            if trigger.score.is_some_and(|score| !score.is_finite()) {
                return Err(refused("a trigger has a score that is not finite"));
            }
        }
        Ok(())
    }

    /// Closes the block of wakes, if it has any. The next one can be read without it.
    fn write_wakes(&mut self) -> io::Result<()> {
        self.encoder.reset();
        if self.wakes == 0 {
            return Ok(());
        }
        let mut count = Vec::with_capacity(NUMBER_MAX);
        put(self.wakes, &mut count);
        let payload = ROOM - count.len();
        self.block[payload..ROOM].copy_from_slice(&count);
        let head = self.head(kind::WAKES, &self.block[payload..]);
        self.block[payload - HEAD_LEN..payload].copy_from_slice(&head);
        let written = self.out.write_all(&self.block[payload - HEAD_LEN..]);
        self.block.truncate(ROOM);
        self.wakes = 0;
        self.note(written)
    }

    /// Writes `value` in a block of its own, behind `bytes`, all at once.
    fn write_json(
        &mut self,
        kind: u8,
        value: &impl Serialize,
        mut bytes: Vec<u8>,
    ) -> io::Result<()> {
        let json = serde_json::to_vec(value)?;
        if json.len() > PAYLOAD_MAX {
            return Err(refused("the header or the end is larger than a block of a journal"));
        }
        bytes.extend_from_slice(&self.head(kind, &json));
        bytes.extend_from_slice(&json);
        let written = self.out.write_all(&bytes);
        self.note(written)
    }

    fn head(&self, kind: u8, payload: &[u8]) -> [u8; HEAD_LEN] {
        let len = u32::try_from(payload.len()).expect("a payload is below its maximum");
        Head { kind, len, payload_crc: crc32fast::hash(payload) }.to_bytes(self.blocks)
    }

    fn note(&mut self, written: io::Result<()>) -> io::Result<()> {
        self.blocks += 1;
        self.failed = written.is_err();
        written
    }
}

fn refused(why: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, why)
}
