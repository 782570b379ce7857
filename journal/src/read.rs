//! Reads a journal, and finds and locates damage in it.

use std::io::{self, Read};

use serde::de::DeserializeOwned;

use crate::block::{HEAD_LEN, Head, MAGIC, PAYLOAD_MAX, PREAMBLE_LEN, kind};
use crate::decode::Decoder;
use crate::entry::JournalEntry;
use crate::error::{Damage, JournalError};
use crate::header::{JournalEnd, JournalHeader};
use crate::number::take;
use crate::{INPUTS_MAX, MalformedWake, VERSION};

/// Reads a journal block by block, with one block in memory at a time.
pub struct JournalReader<R: Read> {
    source: BlockSource<R>,
    header: JournalHeader,
    decoder: Decoder,
    /// The payload of the current block of wakes.
    block: Vec<u8>,
    /// Number of its bytes that were decoded.
    read: usize,
    /// Number of its wakes that were not decoded yet.
    left: u64,
    /// Index of the next wake.
    wake: u64,
    at: BlockLocation,
    end: Option<JournalEnd>,
    unknown_blocks: u64,
    state: ReadState,
}

#[derive(Clone, Copy, Default)]
struct BlockLocation {
    offset: u64,
    block: u64,
    wake: u64,
}

impl BlockLocation {
    fn damaged(self, why: Damage) -> JournalError {
        JournalError::Damaged { offset: self.offset, block: self.block, wake: self.wake, why }
    }

    fn json<T: DeserializeOwned>(self, payload: &[u8]) -> Result<T, JournalError> {
        serde_json::from_slice(payload)
            .map_err(|error| self.damaged(Damage::Json(error.to_string())))
    }
}

enum ReadState {
    Reading,
    Ended,
    /// The journal has no end block: its bytes end after or within its last block.
    Truncated {
        torn_bytes: u64,
    },
    /// Every further call fails with the same damage; `None` if reading itself failed.
    Failed(Option<Damage>),
}

impl<R: Read> JournalReader<R> {
    /// Opens a journal: reads its header.
    ///
    /// # Errors
    ///
    /// [`JournalError`] if this is not a journal, has another version, or its header cannot be
    /// parsed.
    pub fn open(bytes: R) -> Result<JournalReader<R>, JournalError> {
        let mut source = BlockSource { bytes, offset: 0, blocks: 0 };
        source.preamble()?;
        let at = BlockLocation { offset: source.offset, ..BlockLocation::default() };
        let NextBlock::Block(kind, payload) = source.block(at)? else {
            return Err(JournalError::NoHeader { bytes: source.offset });
        };
        if kind != kind::HEADER {
            return Err(at.damaged(Damage::NotAHeader { kind }));
        }
        let header: JournalHeader = at.json(&payload)?;
        let inputs = header.inputs.len();
        if inputs > INPUTS_MAX {
            return Err(at.damaged(Damage::Inputs { found: inputs }));
        }
        if header.event_input.is_some_and(|event| event >= inputs) {
            return Err(at.damaged(Damage::EventInput));
        }
        Ok(JournalReader {
            source,
            header,
            decoder: Decoder::new(inputs),
            block: Vec::new(),
            read: 0,
            left: 0,
            wake: 0,
            at,
            end: None,
            unknown_blocks: 0,
            state: ReadState::Reading,
        })
    }

    pub fn header(&self) -> &JournalHeader {
        &self.header
    }

    /// Returns the next wake; `None` after the last complete one. Then [`end`](Self::end) and
    /// [`truncated`](Self::truncated) show whether the journal is complete.
    ///
    /// # Errors
    ///
    /// [`JournalError::Damaged`] or [`JournalError::Read`]; nothing is read after either.
    #[allow(clippy::should_implement_trait)]
    pub fn next(&mut self) -> Result<Option<JournalEntry>, JournalError> {
        loop {
            match &self.state {
                ReadState::Reading => {}
                ReadState::Ended | ReadState::Truncated { .. } => return Ok(None),
                ReadState::Failed(Some(why)) => return Err(self.at.damaged(why.clone())),
                ReadState::Failed(None) => {
                    return Err(JournalError::Read {
                        source: io::Error::other("an earlier read failed"),
                    });
                }
            }
            let step = match self.left {
                0 => self.open_block().map(|()| None),
                _ => self.decode().map(Some),
            };
            match step {
                Ok(None) => {}
                Ok(entry) => return Ok(entry),
                Err(error) => {
                    let JournalError::Damaged { why, .. } = &error else {
                        self.state = ReadState::Failed(None);
                        return Err(error);
                    };
                    self.state = ReadState::Failed(Some(why.clone()));
                }
            }
        }
    }

    /// Returns the end block; `None` before it was read, or if the journal is truncated.
    pub fn end(&self) -> Option<&JournalEnd> {
        self.end.as_ref()
    }

    /// Returns whether the journal has no end block, as its writer died. Known after the last wake.
    pub fn truncated(&self) -> bool {
        matches!(self.state, ReadState::Truncated { .. })
    }

    /// Returns the number of bytes of an incomplete last block, which were not decoded.
    pub fn torn_bytes(&self) -> u64 {
        if let ReadState::Truncated { torn_bytes } = self.state { torn_bytes } else { 0 }
    }

    /// Returns the number of skipped blocks, whose kind is known to newer versions only.
    pub fn unknown_blocks(&self) -> u64 {
        self.unknown_blocks
    }

    fn decode(&mut self) -> Result<JournalEntry, JournalError> {
        let mut rest = &self.block[self.read..];
        let decoded = self.decoder.decode(&mut rest);
        let entry = decoded.map_err(|why| self.at.damaged(Damage::Wake(why)))?;
        let unread = rest.len();
        self.read = self.block.len() - unread;
        self.left -= 1;
        self.wake += 1;
        if self.left == 0 && unread > 0 {
            return Err(self.at.damaged(Damage::AfterWakes));
        }
        Ok(entry)
    }

    fn open_block(&mut self) -> Result<(), JournalError> {
        let BlockSource { offset, blocks: block, .. } = self.source;
        let at = BlockLocation { offset, block, wake: self.wake };
        self.at = at;
        match self.source.block(at)? {
            NextBlock::Torn(torn_bytes) => self.state = ReadState::Truncated { torn_bytes },
            NextBlock::Block(kind::HEADER, _) => return Err(at.damaged(Damage::SecondHeader)),
            NextBlock::Block(kind::WAKES, payload) => {
                let mut wakes = payload.as_slice();
                let left = take(&mut wakes).ok_or(Damage::Wake(MalformedWake::Short));
                self.left = left.map_err(|why| at.damaged(why))?;
                self.read = payload.len() - wakes.len();
                if self.left == 0 && !wakes.is_empty() {
                    return Err(at.damaged(Damage::AfterWakes));
                }
                self.block = payload;
                self.decoder.reset();
            }
            NextBlock::Block(kind::END, payload) => {
                let end = at.json(&payload)?;
                if self.source.fill(&mut [0])? > 0 {
                    return Err(at.damaged(Damage::AfterEnd));
                }
                self.end = Some(end);
                self.state = ReadState::Ended;
            }
            NextBlock::Block(..) => self.unknown_blocks += 1,
        }
        Ok(())
    }
}

/// Splits the bytes of a journal into blocks.
struct BlockSource<R> {
    bytes: R,
    /// Number of bytes read.
    offset: u64,
    blocks: u64,
}

enum NextBlock {
    /// The bytes end before or within the next block, after this many bytes of the block.
    Torn(u64),
    /// A complete block: its kind and its payload.
    Block(u8, Vec<u8>),
}

impl<R: Read> BlockSource<R> {
    /// Reads as many bytes as there are, up to the length of `buffer`; returns their number.
    fn fill(&mut self, buffer: &mut [u8]) -> Result<usize, JournalError> {
        let mut filled = 0;
        while filled < buffer.len() {
            match self.bytes.read(&mut buffer[filled..]) {
                Ok(0) => break,
                Ok(n) => filled += n,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(source) => return Err(JournalError::Read { source }),
            }
        }
        self.offset += filled as u64;
        Ok(filled)
    }

    fn preamble(&mut self) -> Result<(), JournalError> {
        let mut preamble = [0; PREAMBLE_LEN];
        let filled = self.fill(&mut preamble)?;
        let compared = filled.min(MAGIC.len());
        if preamble[..compared] != MAGIC[..compared] {
            return Err(JournalError::NotAJournal);
        }
        if filled < PREAMBLE_LEN {
            return Err(JournalError::NoHeader { bytes: filled as u64 });
        }
        match u16::from_le_bytes([preamble[8], preamble[9]]) {
            VERSION => {}
            found => return Err(JournalError::Version { found }),
        }
        match preamble[10..].iter().all(|byte| *byte == 0) {
            true => Ok(()),
            false => Err(BlockLocation::default().damaged(Damage::Reserved)),
        }
    }

    /// Reads the block at `at`.
    fn block(&mut self, at: BlockLocation) -> Result<NextBlock, JournalError> {
        let mut head = [0; HEAD_LEN];
        let filled = self.fill(&mut head)?;
        if filled < HEAD_LEN {
            return Ok(NextBlock::Torn(filled as u64));
        }
        let Some(Head { kind, len, payload_crc }) = Head::from_bytes(&head, self.blocks) else {
            return self.zeros(&head, at);
        };
        if len as usize > PAYLOAD_MAX {
            return Err(at.damaged(Damage::TooLong { len }));
        }
        // Allocates as bytes arrive, not by the length in the head.
        let mut payload = Vec::new();
        let filled = (&mut self.bytes).take(len.into()).read_to_end(&mut payload);
        let filled = filled.map_err(|source| JournalError::Read { source })?;
        self.offset += filled as u64;
        if filled < len as usize {
            return Ok(NextBlock::Torn((HEAD_LEN + filled) as u64));
        }
        if crc32fast::hash(&payload) != payload_crc {
            return Err(at.damaged(Damage::Payload));
        }
        self.blocks += 1;
        Ok(NextBlock::Block(kind, payload))
    }

    /// Checks for zeros up to the end: after a loss of power, a file may have its new length, with
    /// zeros in place of data not yet written. Such a block is torn, not damaged.
    fn zeros(
        &mut self,
        head: &[u8; HEAD_LEN],
        at: BlockLocation,
    ) -> Result<NextBlock, JournalError> {
        let mut torn_bytes = HEAD_LEN as u64;
        let mut zeros = head.iter().all(|byte| *byte == 0);
        let mut buffer = [0; 4096];
        while zeros {
            let filled = self.fill(&mut buffer)?;
            if filled == 0 {
                return Ok(NextBlock::Torn(torn_bytes));
            }
            torn_bytes += filled as u64;
            zeros = buffer[..filled].iter().all(|byte| *byte == 0);
        }
        Err(at.damaged(Damage::Head))
    }
}
