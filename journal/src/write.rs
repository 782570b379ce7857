//! Writes a journal, block by block.

use std::io::{self, Write};

use serde::Serialize;

use crate::block::{HEAD_LEN, Head, MAGIC, PAYLOAD_MAX, PREAMBLE_LEN, kind};
use crate::encode::Encoder;
use crate::entry::JournalEntry;
use crate::header::{JournalEnd, JournalHeader};
use crate::number::{NUMBER_MAX, put};
use crate::{ATTRIBUTES_MAX, INPUTS_MAX, TRIGGERS_MAX, VERSION};

/// Length at which a block of wakes is written: small enough that its checksum locates damage.
const CLOSE_AT: usize = 32 << 10;

/// Number of wakes at which a block is written, so that a writer that dies loses few. The end of a
/// block depends on its content only, so that the journals of equal runs are equal. Head and first
/// wake take some 60 of 4,000 bytes.
const CLOSE_AT_WAKES: u64 = 256;

/// Space before the wakes of a block, for the head and the count, which are known at its end.
const RESERVED: usize = HEAD_LEN + NUMBER_MAX;

/// Writes a journal.
///
/// Wakes are buffered in a block until it is full or [`flush`](Self::flush) is called. A writer
/// that is dropped without [`finish`](Self::finish) loses them, and leaves a truncated journal.
pub struct JournalWriter<W: Write> {
    out: W,
    encoder: Encoder,
    inputs: usize,
    /// The current block: [`RESERVED`], then its wakes.
    block: Vec<u8>,
    wakes: u64,
    blocks: u64,
    /// Set after a failed write: the last block may be torn, and later blocks would be unreadable.
    failed: bool,
}

impl<W: Write> JournalWriter<W> {
    /// Begins a journal: writes its header.
    ///
    /// # Errors
    ///
    /// Errors of `out`, and [`io::ErrorKind::InvalidInput`] for a header that readers refuse.
    pub fn begin(out: W, header: &JournalHeader) -> io::Result<JournalWriter<W>> {
        let inputs = header.inputs.len();
        if inputs > INPUTS_MAX || header.event_input.is_some_and(|event| event >= inputs) {
            return Err(refused(
                "a header has too many inputs, or lacks the one that wakes the lambda",
            ));
        }
        let mut block = Vec::with_capacity(RESERVED + 2 * CLOSE_AT);
        block.resize(RESERVED, 0);
        let encoder = Encoder::new(inputs);
        let mut writer =
            JournalWriter { out, encoder, inputs, block, wakes: 0, blocks: 0, failed: false };
        let mut bytes = [&MAGIC[..], &VERSION.to_le_bytes()].concat();
        bytes.resize(PREAMBLE_LEN, 0);
        writer.write_json(kind::HEADER, header, &bytes)?;
        Ok(writer)
    }

    /// Adds a wake.
    ///
    /// # Errors
    ///
    /// Errors of `out`; after one, every further call fails, since the last block may be torn.
    /// [`io::ErrorKind::InvalidInput`] for a wake that readers refuse: it is omitted, and further
    /// wakes may follow.
    pub fn wake(&mut self, entry: &JournalEntry) -> io::Result<()> {
        self.usable()?;
        self.fits(entry)?;
        let before = self.block.len();
        self.encoder.encode(entry, &mut self.block);
        let payload = self.block.len() - HEAD_LEN;
        if payload > PAYLOAD_MAX {
            self.block.truncate(before);
            self.write_wakes()?;
            return Err(refused("a wake is too large for a block of a journal"));
        }
        self.wakes += 1;
        if payload >= CLOSE_AT || self.wakes >= CLOSE_AT_WAKES {
            self.write_wakes()
        } else {
            Ok(())
        }
    }

    /// Adds a wake that is encoded already, without reference to another one, as
    /// [`Encoder::reset`] allows: as a block of its own. It is not checked.
    ///
    /// # Errors
    ///
    /// As for [`wake`](Self::wake).
    pub fn encoded_wake(&mut self, encoded: &[u8]) -> io::Result<()> {
        self.usable()?;
        if encoded.len() + NUMBER_MAX > PAYLOAD_MAX {
            return Err(refused("a wake is too large for a block of a journal"));
        }
        self.write_wakes()?;
        self.block.extend_from_slice(encoded);
        self.wakes = 1;
        self.write_wakes()
    }

    /// Writes buffered wakes, and flushes `out`.
    ///
    /// # Errors
    ///
    /// Errors of `out`; after one, every further call fails.
    pub fn flush(&mut self) -> io::Result<()> {
        self.usable()?;
        self.write_wakes()?;
        let flushed = self.out.flush();
        self.failed = flushed.is_err();
        flushed
    }

    /// Writes buffered wakes and the end, flushes, and returns `out`.
    ///
    /// # Errors
    ///
    /// Errors of `out`.
    pub fn finish(mut self, end: &JournalEnd) -> io::Result<W> {
        self.usable()?;
        self.write_wakes()?;
        self.write_json(kind::END, end, &[])?;
        self.out.flush()?;
        Ok(self.out)
    }

    #[cfg(test)]
    pub(crate) fn written(&self) -> &W {
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
            return Err(refused("a wake does not have the inputs of the header"));
        }
        if entry.triggers.len() > TRIGGERS_MAX {
            return Err(refused("a wake has too many triggers for a journal"));
        }
        for trigger in &entry.triggers {
            let long = || {
                serde_json::to_string(&trigger.attributes)
                    .map_or(true, |json| json.len() > ATTRIBUTES_MAX)
            };
            if !trigger.attributes.is_empty() && long() {
                return Err(refused("a trigger has attributes that are too long for a journal"));
            }
            if trigger.score.is_some_and(|score| !score.is_finite()) {
                return Err(refused("a trigger has a score that is not finite"));
            }
        }
        Ok(())
    }

    /// Writes the block of wakes, if it has any. The next block can be decoded without it.
    fn write_wakes(&mut self) -> io::Result<()> {
        self.encoder.reset();
        if self.wakes == 0 {
            return Ok(());
        }
        let mut count = Vec::with_capacity(NUMBER_MAX);
        put(self.wakes, &mut count);
        let payload = RESERVED - count.len();
        self.block[payload..RESERVED].copy_from_slice(&count);
        let head = self.head(kind::WAKES, &self.block[payload..]);
        self.block[payload - HEAD_LEN..payload].copy_from_slice(&head);
        let written = self.out.write_all(&self.block[payload - HEAD_LEN..]);
        self.block.truncate(RESERVED);
        self.wakes = 0;
        self.finish_block(written)
    }

    /// Writes `value` as a block of its own, after `before`, in one call.
    fn write_json(&mut self, kind: u8, value: &impl Serialize, before: &[u8]) -> io::Result<()> {
        let json = serde_json::to_vec(value)?;
        if json.len() > PAYLOAD_MAX {
            return Err(refused("the header or the end is too large for a block of a journal"));
        }
        let bytes = [before, &self.head(kind, &json), &json[..]].concat();
        let written = self.out.write_all(&bytes);
        self.finish_block(written)
    }

    fn head(&self, kind: u8, payload: &[u8]) -> [u8; HEAD_LEN] {
        let len = u32::try_from(payload.len()).expect("a payload is below its maximum");
        Head { kind, len, payload_crc: crc32fast::hash(payload) }.to_bytes(self.blocks)
    }

    fn finish_block(&mut self, written: io::Result<()>) -> io::Result<()> {
        self.blocks += 1;
        self.failed = written.is_err();
        written
    }
}

fn refused(why: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, why)
}
