//! The blocks of a journal: a head with checksums of itself and of the payload, then the payload.

/// First bytes of a journal. A transfer as text would change some of them, which distinguishes it
/// from other damage.
pub(crate) const MAGIC: [u8; 8] = *b"\x89GLJRN\r\n";

/// Magic, version, and six bytes that are 0.
pub(crate) const PREAMBLE_LEN: usize = 16;

/// Kind, length, checksum of the payload, checksum of the head.
pub(crate) const HEAD_LEN: usize = 13;

/// Longest payload. The header of a build with 10,000 files fits, and the largest wake that the
/// host allows.
pub(crate) const PAYLOAD_MAX: usize = 2 << 20;

/// Kinds of blocks. Readers skip blocks of other kinds, which newer writers may add.
pub(crate) mod kind {
    /// The header, as JSON: the first block only.
    pub(crate) const HEADER: u8 = 1;
    pub(crate) const WAKES: u8 = 2;
    /// The end, as JSON: the last block.
    pub(crate) const END: u8 = 3;
}

pub(crate) struct Head {
    pub(crate) kind: u8,
    pub(crate) len: u32,
    pub(crate) payload_crc: u32,
}

impl Head {
    pub(crate) fn to_bytes(&self, index: u64) -> [u8; HEAD_LEN] {
        let mut bytes = [0; HEAD_LEN];
        bytes[0] = self.kind;
        bytes[1..5].copy_from_slice(&self.len.to_le_bytes());
        bytes[5..9].copy_from_slice(&self.payload_crc.to_le_bytes());
        let crc = head_crc(&bytes, index);
        bytes[9..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Decodes the head of block number `index`; `None` if the checksum is wrong.
    pub(crate) fn from_bytes(bytes: &[u8; HEAD_LEN], index: u64) -> Option<Head> {
        let word = |at| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"));
        (word(9) == head_crc(bytes, index)).then(|| Head {
            kind: bytes[0],
            len: word(1),
            payload_crc: word(5),
        })
    }
}

/// Returns the checksum of a head. The head has its own, so that a flipped length is damage and
/// does not look like a truncated file. It covers the number of the block, so that a missing or
/// moved block is found.
fn head_crc(bytes: &[u8; HEAD_LEN], index: u64) -> u32 {
    let mut crc = crc32fast::Hasher::new();
    crc.update(&index.to_le_bytes());
    crc.update(&bytes[..9]);
    crc.finalize()
}
