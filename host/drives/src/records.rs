//! Parses the MCAP records that a replay needs.
//!
//! The readers of the `mcap` crate are not used: its parser reserves any length that a string
//! claims, its indexed reader never checks a chunk's checksum, and neither returns a chunk's bytes.
//! Ten kinds of records are few enough to parse directly. Source: the MCAP specification, version
//! 0.

use super::damage::Damage;

/// First and last bytes of every MCAP file.
pub(super) const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Size of opcode and length, which precede every record.
pub(super) const HEAD: u64 = 9;
/// Bytes of a message record before the message's data.
pub(super) const MESSAGE_HEAD: usize = 22;
/// Footer record and closing magic.
pub(super) const FOOTER: u64 = HEAD + 20 + 8;

pub(super) mod op {
    pub(in super::super) const HEADER: u8 = 0x01;
    pub(in super::super) const FOOTER: u8 = 0x02;
    pub(in super::super) const SCHEMA: u8 = 0x03;
    pub(in super::super) const CHANNEL: u8 = 0x04;
    pub(in super::super) const MESSAGE: u8 = 0x05;
    pub(in super::super) const CHUNK: u8 = 0x06;
    pub(in super::super) const CHUNK_INDEX: u8 = 0x08;
    pub(in super::super) const ATTACHMENT: u8 = 0x09;
    pub(in super::super) const ATTACHMENT_INDEX: u8 = 0x0a;
    pub(in super::super) const STATISTICS: u8 = 0x0b;
    pub(in super::super) const METADATA: u8 = 0x0c;
    pub(in super::super) const METADATA_INDEX: u8 = 0x0d;
    pub(in super::super) const DATA_END: u8 = 0x0f;
}

/// Parses the opcode and body length of the record whose head is `bytes`.
pub(super) fn head(bytes: &[u8]) -> Option<(u8, u64)> {
    let (opcode, rest) = bytes.split_first()?;
    Some((*opcode, u64::from_le_bytes(*rest.first_chunk()?)))
}

pub(super) struct Records<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Records<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }
}

#[derive(Copy, Clone)]
pub(super) struct McapRecord<'a> {
    pub(super) opcode: u8,
    /// Offset of the body in the buffer.
    pub(super) at: usize,
    pub(super) body: &'a [u8],
}

impl<'a> Iterator for Records<'a> {
    type Item = Result<McapRecord<'a>, Damage>;

    #[inline]
    fn next(&mut self) -> Option<Self::Item> {
        let rest = self.bytes.get(self.at..).filter(|rest| !rest.is_empty())?;
        let record = head(rest).and_then(|(opcode, len)| {
            let start = self.at + HEAD as usize;
            let end = start.checked_add(usize::try_from(len).ok()?)?;
            Some(McapRecord { opcode, at: start, body: self.bytes.get(start..end)? })
        });
        // After a record that does not fit, no further one can be found.
        self.at = record.map_or(self.bytes.len(), |record| record.at + record.body.len());
        Some(record.ok_or(Damage::Malformed("a record is longer than the chunk it is in")))
    }
}

#[derive(Copy, Clone)]
pub(super) struct MessageHead {
    pub(super) channel: u16,
    pub(super) sequence: u32,
    pub(super) log_time: u64,
    pub(super) publish_time: u64,
}

impl MessageHead {
    #[inline]
    pub(super) fn parse(body: &[u8]) -> Option<Self> {
        let mut fields = Fields(body);
        Some(Self {
            channel: fields.u16()?,
            sequence: fields.u32()?,
            log_time: fields.u64()?,
            publish_time: fields.u64()?,
        })
    }

    #[cfg(feature = "bags")]
    pub(super) fn to_bytes(self) -> [u8; MESSAGE_HEAD] {
        let mut bytes = [0; MESSAGE_HEAD];
        bytes[..2].copy_from_slice(&self.channel.to_le_bytes());
        bytes[2..6].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[6..14].copy_from_slice(&self.log_time.to_le_bytes());
        bytes[14..].copy_from_slice(&self.publish_time.to_le_bytes());
        bytes
    }
}

pub(super) struct ChunkHead<'a> {
    pub(super) uncompressed: u64,
    pub(super) crc: u32,
    pub(super) compression: &'a str,
    pub(super) compressed: u64,
    /// Bytes before the compressed data.
    pub(super) len: usize,
}

impl<'a> ChunkHead<'a> {
    pub(super) fn parse(body: &'a [u8]) -> Option<Self> {
        let mut fields = Fields(body);
        // Start and end time: those of the messages are used.
        fields.u64()?;
        fields.u64()?;
        let (uncompressed, crc) = (fields.u64()?, fields.u32()?);
        let (compression, compressed) = (fields.text()?, fields.u64()?);
        let len = body.len() - fields.0.len();
        Some(Self { uncompressed, crc, compression, compressed, len })
    }
}

pub(super) struct McapSchema<'a> {
    pub(super) id: u16,
    pub(super) name: &'a str,
    pub(super) encoding: &'a str,
    pub(super) data: &'a [u8],
}

impl<'a> McapSchema<'a> {
    pub(super) fn parse(body: &'a [u8]) -> Option<Self> {
        let mut fields = Fields(body);
        Some(Self {
            id: fields.u16()?,
            name: fields.text()?,
            encoding: fields.text()?,
            data: fields.bytes()?,
        })
    }
}

pub(super) struct McapChannel<'a> {
    pub(super) id: u16,
    pub(super) schema: u16,
    pub(super) topic: &'a str,
    pub(super) encoding: &'a str,
    pub(super) metadata: Map<'a>,
}

impl<'a> McapChannel<'a> {
    pub(super) fn parse(body: &'a [u8]) -> Option<Self> {
        let mut fields = Fields(body);
        let (id, schema) = (fields.u16()?, fields.u16()?);
        let (topic, encoding) = (fields.text()?, fields.text()?);
        // A channel that ends here has everything that a replay needs.
        let metadata = if fields.0.is_empty() { Map(Fields(&[])) } else { fields.map()? };
        Some(Self { id, schema, topic, encoding, metadata })
    }
}

/// A map of texts: its pairs are complete, but may not be UTF-8.
#[derive(Copy, Clone)]
pub(super) struct Map<'a>(Fields<'a>);

impl<'a> Map<'a> {
    /// Returns the value of the first pair with this key, if it is UTF-8.
    pub(super) fn get(&self, key: &str) -> Option<&'a str> {
        let (_, value) = self.pairs().find(|(found, _)| *found == key.as_bytes())?;
        str::from_utf8(value).ok()
    }

    /// Returns key and value of each pair, in order.
    pub(super) fn pairs(&self) -> impl Iterator<Item = (&'a [u8], &'a [u8])> + use<'a> {
        let mut rest = self.0;
        std::iter::from_fn(move || Some((rest.bytes()?, rest.bytes()?)))
    }
}

pub(super) struct McapMetadata<'a> {
    pub(super) name: &'a str,
    pub(super) map: Map<'a>,
}

impl<'a> McapMetadata<'a> {
    pub(super) fn parse(body: &'a [u8]) -> Option<Self> {
        let mut fields = Fields(body);
        Some(Self { name: fields.text()?, map: fields.map()? })
    }
}

pub(super) struct McapAttachment<'a> {
    pub(super) name: &'a str,
    pub(super) media_type: &'a str,
    pub(super) data: &'a [u8],
    /// Checksum of everything before it; 0 if the writer left it out.
    pub(super) crc: u32,
    /// Bytes before the checksum; the data are the last of them.
    pub(super) len: usize,
}

impl<'a> McapAttachment<'a> {
    pub(super) fn parse(body: &'a [u8]) -> Option<Self> {
        let mut fields = Fields(body);
        let (_log_time, _create_time) = (fields.u64()?, fields.u64()?);
        let (name, media_type) = (fields.text()?, fields.text()?);
        let len = usize::try_from(fields.u64()?).ok()?;
        let data = fields.take(len)?;
        let len = body.len() - fields.0.len();
        Some(Self { name, media_type, data, crc: fields.u32()?, len })
    }
}

/// Position and content of a chunk, from the summary.
pub(super) struct ChunkIndex {
    pub(super) start_time: u64,
    pub(super) end_time: u64,
    pub(super) offset: u64,
    /// Length of the chunk record, including its head.
    pub(super) len: u64,
    /// Length of the message index records after it.
    pub(super) index_len: u64,
    /// The channels with messages in it; empty if the writer left them out.
    pub(super) channels: Vec<u16>,
}

impl ChunkIndex {
    pub(super) fn parse(body: &[u8]) -> Option<Self> {
        let mut fields = Fields(body);
        let (start_time, end_time) = (fields.u64()?, fields.u64()?);
        let (offset, len) = (fields.u64()?, fields.u64()?);
        let (entries, _) = fields.bytes()?.as_chunks::<10>();
        let channels = entries.iter().map(|e| u16::from_le_bytes([e[0], e[1]])).collect();
        let index_len = fields.u64()?;
        Some(Self { start_time, end_time, offset, len, index_len, channels })
    }
}

pub(super) struct Statistics {
    pub(super) channels: u32,
    pub(super) chunks: u32,
    pub(super) attachments: u32,
    pub(super) metadata: u32,
    /// Messages per channel.
    pub(super) messages: Vec<(u16, u64)>,
}

impl Statistics {
    pub(super) fn parse(body: &[u8]) -> Option<Self> {
        let mut fields = Fields(body);
        let (_messages, _schemas) = (fields.u64()?, fields.u16()?);
        let (channels, attachments) = (fields.u32()?, fields.u32()?);
        let (metadata, chunks) = (fields.u32()?, fields.u32()?);
        let (_start, _end) = (fields.u64()?, fields.u64()?);
        let mut counts = Fields(fields.bytes()?);
        let mut messages = Vec::new();
        while let (Some(channel), Some(count)) = (counts.u16(), counts.u64()) {
            messages.push((channel, count));
        }
        Some(Self { channels, chunks, attachments, metadata, messages })
    }
}

/// The rest of a record's body.
#[derive(Copy, Clone)]
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    #[inline]
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (found, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*found)
    }

    fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    fn take(&mut self, len: usize) -> Option<&'a [u8]> {
        let (found, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(found)
    }

    /// Takes bytes that are preceded by their length.
    fn bytes(&mut self) -> Option<&'a [u8]> {
        let len = self.u32()? as usize;
        self.take(len)
    }

    /// Takes a map, whose pairs must fill it.
    fn map(&mut self) -> Option<Map<'a>> {
        let pairs = Fields(self.bytes()?);
        let mut rest = pairs;
        while !rest.0.is_empty() {
            rest.bytes()?;
            rest.bytes()?;
        }
        Some(Map(pairs))
    }

    fn text(&mut self) -> Option<&'a str> {
        str::from_utf8(self.bytes()?).ok()
    }
}
