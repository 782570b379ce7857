//! The part of a lambda's journal that belongs to a clip.

use std::io;

use gleaner_protocol::journal::{Decoder, End, Header, Writer};

/// Most memory for one lambda's part. A wake takes some 60 bytes here, so that this is over a million of them.
const PART_BYTES: usize = 64 << 20;

/// Wakes of one lambda, each encoded by itself, in any order.
#[derive(Debug, Default)]
pub(super) struct Part {
    bytes: Vec<u8>,
    /// Number of the wake, and where its bytes begin and end.
    wakes: Vec<(u64, u32, u32)>,
    cut: u64,
}

impl Part {
    /// Adds a wake, if there is room for it.
    pub(super) fn push(&mut self, number: u64, encoded: &[u8]) {
        let begin = self.bytes.len();
        let taken = begin + encoded.len() + (self.wakes.len() + 1) * size_of::<(u64, u32, u32)>();
        let ends = (u32::try_from(begin), u32::try_from(begin + encoded.len()));
        match ends {
            (Ok(begin), Ok(end)) if taken <= PART_BYTES => {
                self.bytes.extend_from_slice(encoded);
                self.wakes.push((number, begin, end));
            }
            _ => self.cut += 1,
        }
    }

    /// How many wakes found no room.
    pub(super) fn cut(&self) -> u64 {
        self.cut
    }

    /// A journal of these wakes; `None` if there are none.
    pub(super) fn write(mut self, header: &Header) -> Option<io::Result<Vec<u8>>> {
        self.wakes.sort_unstable();
        let first = self.wakes.first()?.0;
        let header = Header { wakes_before: first, ..header.clone() };
        Some(self.journal(&header))
    }

    fn journal(&self, header: &Header) -> io::Result<Vec<u8>> {
        let mut decoder = Decoder::new(header.inputs.len());
        let mut writer = Writer::begin(Vec::new(), header)?;
        for (_, begin, end) in &self.wakes {
            decoder.reset();
            let mut encoded = &self.bytes[*begin as usize..*end as usize];
            writer.wake(&decoder.decode(&mut encoded).map_err(io::Error::other)?)?;
        }
        writer.finish(&End { wakes: self.wakes.len() as u64, samples: Vec::new(), drives: Vec::new() })
    }
}
