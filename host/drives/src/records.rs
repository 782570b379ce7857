//! Parses the MCAP records that a replay needs.
//!
//! The readers of the `mcap` crate are not used: its parser reserves any length that a string
//! claims, its indexed reader never checks a chunk's checksum, and neither returns a chunk's bytes.
//! Ten kinds of records are few enough to parse directly. Source: the MCAP specification, version
//! 0.

use crate::damage::Damage;

/// First and last bytes of every MCAP file.
pub const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Size of opcode and length, which precede every record.
pub const HEAD: u64 = 9;
/// Bytes of a message record before the message's data.
pub const MESSAGE_HEAD: usize = 22;
/// Footer record and closing magic.
pub const FOOTER: u64 = HEAD + 20 + 8;

pub mod op {
    pub const HEADER: u8 = 0x01;
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const CHUNK_INDEX: u8 = 0x08;
    pub const ATTACHMENT: u8 = 0x09;
    pub const ATTACHMENT_INDEX: u8 = 0x0a;
    pub const STATISTICS: u8 = 0x0b;
    pub const METADATA: u8 = 0x0c;
    pub const METADATA_INDEX: u8 = 0x0d;
    pub const DATA_END: u8 = 0x0f;
}

/// Parses the opcode and body length of the record whose head is `bytes`.
pub fn head(bytes: &[u8]) -> Option<(u8, u64)> {
    let (opcode, rest) = bytes.split_first()?;
    Some((*opcode, u64::from_le_bytes(*rest.first_chunk()?)))
}

pub struct Records<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Records<'a> {
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }
}

#[derive(Copy, Clone)]
pub struct McapRecord<'a> {
    pub opcode: u8,
    /// Offset of the body in the buffer.
    pub at: usize,
    pub body: &'a [u8],
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
pub struct MessageHead {
    pub channel: u16,
    pub sequence: u32,
    pub log_time: u64,
    pub publish_time: u64,
}

impl MessageHead {
    #[inline]
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut fields = Fields(body);
        Some(Self {
            channel: fields.u16()?,
            sequence: fields.u32()?,
            log_time: fields.u64()?,
            publish_time: fields.u64()?,
        })
    }

    #[cfg(feature = "bags")]
    pub fn to_bytes(self) -> [u8; MESSAGE_HEAD] {
        let mut bytes = [0; MESSAGE_HEAD];
        bytes[..2].copy_from_slice(&self.channel.to_le_bytes());
        bytes[2..6].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[6..14].copy_from_slice(&self.log_time.to_le_bytes());
        bytes[14..].copy_from_slice(&self.publish_time.to_le_bytes());
        bytes
    }
}

pub struct ChunkHead<'a> {
    pub uncompressed: u64,
    pub crc: u32,
    pub compression: &'a str,
    pub compressed: u64,
    /// Bytes before the compressed data.
    pub len: usize,
}

impl<'a> ChunkHead<'a> {
    pub fn parse(body: &'a [u8]) -> Option<Self> {
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

pub struct McapSchema<'a> {
    pub id: u16,
    pub name: &'a str,
    pub encoding: &'a str,
    pub data: &'a [u8],
}

impl<'a> McapSchema<'a> {
    pub fn parse(body: &'a [u8]) -> Option<Self> {
        let mut fields = Fields(body);
        Some(Self {
            id: fields.u16()?,
            name: fields.text()?,
            encoding: fields.text()?,
            data: fields.bytes()?,
        })
    }
}

pub struct McapChannel<'a> {
    pub id: u16,
    pub schema: u16,
    pub topic: &'a str,
    pub encoding: &'a str,
    pub metadata: Map<'a>,
}

impl<'a> McapChannel<'a> {
    pub fn parse(body: &'a [u8]) -> Option<Self> {
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
pub struct Map<'a>(Fields<'a>);

impl<'a> Map<'a> {
    /// Returns the value of the first pair with this key, if it is UTF-8.
    pub fn get(&self, key: &str) -> Option<&'a str> {
        let (_, value) = self.pairs().find(|(found, _)| *found == key.as_bytes())?;
        str::from_utf8(value).ok()
    }

    /// Returns key and value of each pair, in order.
    pub fn pairs(&self) -> impl Iterator<Item = (&'a [u8], &'a [u8])> + use<'a> {
        let mut rest = self.0;
        std::iter::from_fn(move || Some((rest.bytes()?, rest.bytes()?)))
    }
}

pub struct McapMetadata<'a> {
    pub name: &'a str,
    pub map: Map<'a>,
}

impl<'a> McapMetadata<'a> {
    pub fn parse(body: &'a [u8]) -> Option<Self> {
        let mut fields = Fields(body);
        Some(Self { name: fields.text()?, map: fields.map()? })
    }
}

pub struct McapAttachment<'a> {
    pub name: &'a str,
    pub media_type: &'a str,
    pub data: &'a [u8],
    /// Checksum of everything before it; 0 if the writer left it out.
    pub crc: u32,
    /// Bytes before the checksum; the data are the last of them.
    pub len: usize,
}

impl<'a> McapAttachment<'a> {
    pub fn parse(body: &'a [u8]) -> Option<Self> {
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
pub struct ChunkIndex {
    pub start_time: u64,
    pub end_time: u64,
    pub offset: u64,
    /// Length of the chunk record, including its head.
    pub len: u64,
    /// Length of the message index records after it.
    pub index_len: u64,
    /// The channels with messages in it; empty if the writer left them out.
    pub channels: Vec<u16>,
}

impl ChunkIndex {
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut fields = Fields(body);
        let (start_time, end_time) = (fields.u64()?, fields.u64()?);
        let (offset, len) = (fields.u64()?, fields.u64()?);
        let (entries, _) = fields.bytes()?.as_chunks::<10>();
        let channels = entries.iter().map(|e| u16::from_le_bytes([e[0], e[1]])).collect();
        let index_len = fields.u64()?;
        Some(Self { start_time, end_time, offset, len, index_len, channels })
    }
}

pub struct Statistics {
    pub channels: u32,
    pub chunks: u32,
    pub attachments: u32,
    pub metadata: u32,
    /// Messages per channel.
    pub messages: Vec<(u16, u64)>,
}

impl Statistics {
    pub fn parse(body: &[u8]) -> Option<Self> {
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
