use std::io::{self, Read};

use serde::de::DeserializeOwned;

use super::block::{HEAD_LEN, Head, MAGIC, PAYLOAD_MAX, PREAMBLE_LEN, kind};
use super::decode::Decoder;
use super::entry::JournalEntry;
use super::error::{Damage, JournalError};
use super::header::{JournalEnd, JournalHeader};
use super::number::take;
use super::{INPUTS_MAX, VERSION};

/// Reads a journal block by block, and never holds more than one.
pub struct JournalReader<R: Read> {
    source: Source<R>,
    header: JournalHeader,
    decoder: Decoder,
    /// The payload of the block of wakes at hand.
    block: Vec<u8>,
    /// How much of it was read.
    read: usize,
    /// Wakes in it that were not.
    left: u64,
    /// Index of the next wake.
    wake: u64,
    at: Place,
    end: Option<JournalEnd>,
    unknown_blocks: u64,
    state: State,
}

/// A block, for messages.
#[derive(Clone, Copy, Default)]
struct Place {
    offset: u64,
    block: u64,
    wake: u64,
}

impl Place {
    fn damaged(self, why: Damage) -> JournalError {
        JournalError::Damaged { offset: self.offset, block: self.block, wake: self.wake, why }
    }
}

enum State {
    Reading,
    Ended,
    /// The bytes end within this journal's last block.
    CutOff {
        torn_bytes: u64,
    },
    /// Says the same whenever it is asked again; no place if reading itself failed.
    Failed(Option<(Place, Damage)>),
}

impl<R: Read> JournalReader<R> {
    /// Opens a journal: reads its header.
    ///
    /// # Errors
    ///
    /// [`JournalError`], if this is none, is of another version, or its header cannot be read.
    pub fn open(bytes: R) -> Result<JournalReader<R>, JournalError> {
        let mut source = Source { bytes, offset: 0, blocks: 0 };
        source.preamble()?;
        let at = Place { offset: source.offset, ..Place::default() };
        let (kind, payload) = match source.block().map_err(|stop| stop.into_error(at))? {
            Next::Block(kind, payload) => (kind, payload),
            Next::Nothing | Next::Torn(_) => {
                return Err(JournalError::NoHeader { bytes: source.offset });
            }
        };
        if kind != kind::HEADER {
            return Err(at.damaged(Damage::NotAHeader { kind }));
        }
        let header: JournalHeader = json(&payload).map_err(|why| at.damaged(why))?;
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
            state: State::Reading,
        })
    }

    /// What made the decisions.
    pub fn header(&self) -> &JournalHeader {
        &self.header
    }

    /// The next wake; `None` after the last one that is whole. Then [`end`](Self::end) and
    /// [`truncated`](Self::truncated) tell whether the writer came to its end.
    ///
    /// # Errors
    ///
    /// [`JournalError::Damaged`] or [`JournalError::Read`]; nothing is read behind either.
    #[allow(clippy::should_implement_trait)]
    pub fn next(&mut self) -> Result<Option<JournalEntry>, JournalError> {
        loop {
            match &self.state {
                State::Reading => {}
                State::Ended | State::CutOff { .. } => return Ok(None),
                State::Failed(Some((at, why))) => return Err(at.damaged(why.clone())),
                State::Failed(None) => {
                    return Err(JournalError::Read {
                        source: io::Error::other("an earlier read failed"),
                    });
                }
            }
            let step = if self.left > 0 {
                self.decode().map(Some)
            } else {
                self.open_block().map(|()| None)
            };
            match step {
                Ok(None) => {}
                Ok(entry) => return Ok(entry),
                Err(Stop::Damage(why)) => self.state = State::Failed(Some((self.at, why))),
                Err(Stop::Read(source)) => {
                    self.state = State::Failed(None);
                    return Err(JournalError::Read { source });
                }
            }
        }
    }

    /// What the writer said at its end; `None` before it was read, or if the journal is cut off.
    pub fn end(&self) -> Option<&JournalEnd> {
        self.end.as_ref()
    }

    /// Whether the journal has no end: its writer died. Known after the last wake.
    pub fn truncated(&self) -> bool {
        matches!(self.state, State::CutOff { .. })
    }

    /// Bytes of a last block that was not written whole; they were not read.
    pub fn torn_bytes(&self) -> u64 {
        if let State::CutOff { torn_bytes } = self.state { torn_bytes } else { 0 }
    }

    /// Whole blocks of a kind that only a newer gleaner knows; they were stepped over.
    pub fn unknown_blocks(&self) -> u64 {
        self.unknown_blocks
    }

    fn decode(&mut self) -> Result<JournalEntry, Stop> {
        let mut rest = &self.block[self.read..];
        let entry = self.decoder.decode(&mut rest).map_err(Damage::Wake)?;
        let unread = rest.len();
        self.read = self.block.len() - unread;
        self.left -= 1;
        self.wake += 1;
        if self.left == 0 && unread > 0 {
            return Err(Stop::Damage(Damage::AfterWakes));
        }
        Ok(entry)
    }

    fn open_block(&mut self) -> Result<(), Stop> {
        self.at = Place { offset: self.source.offset, block: self.source.blocks, wake: self.wake };
        match self.source.block()? {
            Next::Nothing => self.state = State::CutOff { torn_bytes: 0 },
            Next::Torn(torn_bytes) => self.state = State::CutOff { torn_bytes },
            Next::Block(kind::HEADER, _) => return Err(Stop::Damage(Damage::SecondHeader)),
            Next::Block(kind::WAKES, payload) => {
                let mut wakes = payload.as_slice();
                self.left = take(&mut wakes).ok_or(Damage::Wake(super::Malformed::Short))?;
                self.read = payload.len() - wakes.len();
                if self.left == 0 && !wakes.is_empty() {
                    return Err(Stop::Damage(Damage::AfterWakes));
                }
                self.block = payload;
                self.decoder.reset();
            }
            Next::Block(kind::END, payload) => {
                let end = json(&payload)?;
                if self.source.fill(&mut [0])? > 0 {
                    return Err(Stop::Damage(Damage::AfterEnd));
                }
                self.end = Some(end);
                self.state = State::Ended;
            }
            Next::Block(..) => self.unknown_blocks += 1,
        }
        Ok(())
    }
}

/// Why reading stops.
enum Stop {
    Damage(Damage),
    Read(io::Error),
}

impl Stop {
    fn into_error(self, at: Place) -> JournalError {
        match self {
            Stop::Damage(why) => at.damaged(why),
            Stop::Read(source) => JournalError::Read { source },
        }
    }
}

impl From<Damage> for Stop {
    fn from(why: Damage) -> Self {
        Stop::Damage(why)
    }
}

impl From<io::Error> for Stop {
    fn from(source: io::Error) -> Self {
        Stop::Read(source)
    }
}

fn json<T: DeserializeOwned>(payload: &[u8]) -> Result<T, Damage> {
    serde_json::from_slice(payload).map_err(|error| Damage::Json(error.to_string()))
}

/// The bytes of a journal, taken apart into blocks.
struct Source<R> {
    bytes: R,
    /// Bytes that were read.
    offset: u64,
    /// Blocks that were read.
    blocks: u64,
}

enum Next {
    /// The bytes end here.
    Nothing,
    /// They end within the next block, after so many bytes of it.
    Torn(u64),
    /// A whole block: its kind and its payload.
    Block(u8, Vec<u8>),
}

impl<R: Read> Source<R> {
    /// As many bytes as there are, up to the length of `buffer`.
    fn fill(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let mut filled = 0;
        while filled < buffer.len() {
            match self.bytes.read(&mut buffer[filled..]) {
                Ok(0) => break,
                Ok(n) => filled += n,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        self.offset += filled as u64;
        Ok(filled)
    }

    fn preamble(&mut self) -> Result<(), JournalError> {
        let mut preamble = [0; PREAMBLE_LEN];
        let filled = self.fill(&mut preamble).map_err(|source| JournalError::Read { source })?;
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
            false => Err(Place::default().damaged(Damage::Reserved)),
        }
    }

    fn block(&mut self) -> Result<Next, Stop> {
        let mut head = [0; HEAD_LEN];
        let filled = self.fill(&mut head)?;
        if filled < HEAD_LEN {
            return Ok(if filled == 0 { Next::Nothing } else { Next::Torn(filled as u64) });
        }
        let Some(Head { kind, len, payload_crc }) = Head::from_bytes(&head, self.blocks) else {
            return self.zeros(&head);
        };
        if len as usize > PAYLOAD_MAX {
            return Err(Stop::Damage(Damage::TooLong { len }));
        }
        // Grows with what is there, not with what the head claims.
        let mut payload = Vec::new();
        let filled = (&mut self.bytes).take(len.into()).read_to_end(&mut payload)?;
        self.offset += filled as u64;
        if filled < len as usize {
            return Ok(Next::Torn((HEAD_LEN + filled) as u64));
        }
        if crc32fast::hash(&payload) != payload_crc {
            return Err(Stop::Damage(Damage::Payload));
        }
        self.blocks += 1;
        Ok(Next::Block(kind, payload))
    }

    /// After a loss of power, a file may have its new length and zeros for what was not written
    /// yet: it is torn.
    fn zeros(&mut self, head: &[u8; HEAD_LEN]) -> Result<Next, Stop> {
        let mut torn_bytes = HEAD_LEN as u64;
        let mut zeros = head.iter().all(|byte| *byte == 0);
        let mut buffer = [0; 4096];
        while zeros {
            let filled = self.fill(&mut buffer)?;
            if filled == 0 {
                return Ok(Next::Torn(torn_bytes));
            }
            torn_bytes += filled as u64;
            zeros = buffer[..filled].iter().all(|byte| *byte == 0);
        }
        Err(Stop::Damage(Damage::Head))
    }
}
