//! Unpacks messages that are packed one by one, as rosbag2 does with `compression_mode: message`.

use std::io;

use zstd::stream::raw::{Decoder, Operation};

/// First bytes of a zstd frame. No CDR begins so: its first byte is 0.
pub const ZSTD: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
/// Initial memory for a small message, in bytes.
const SMALL: usize = 4 << 10;

/// Unpacks messages into memory that is reused.
pub struct Inflate {
    allowed: u64,
    decoder: Option<Decoder<'static>>,
    bytes: Vec<u8>,
    len: usize,
}

impl Inflate {
    /// Creates an unpacker for messages of fewer than `allowed` bytes.
    pub fn new(allowed: u64) -> Self {
        Self { allowed, decoder: None, bytes: Vec::new(), len: 0 }
    }

    pub fn allowed(&self) -> u64 {
        self.allowed
    }

    /// Returns whether the last unpacked message is larger than allowed.
    pub fn is_full(&self) -> bool {
        self.len as u64 >= self.allowed
    }

    pub fn bytes(&self) -> &[u8] {
        &self.bytes[..self.len]
    }

    /// Unpacks the first `max_bytes` bytes of `packed`, or all if there are fewer.
    pub fn unpack(&mut self, mut packed: &[u8], max_bytes: usize) -> io::Result<()> {
        let max_bytes = max_bytes.min(usize::try_from(self.allowed).unwrap_or(usize::MAX));
        let decoder = match &mut self.decoder {
            Some(decoder) => {
                decoder.reinit()?;
                decoder
            }
            none => none.insert(Decoder::new()?),
        };
        self.len = 0;
        let mut is_whole = false;
        while self.len < max_bytes && !(is_whole && packed.is_empty()) {
            if self.len == self.bytes.len() {
                // Memory grows with the actual data: the size that a frame claims is ignored.
                let room = (self.len * 2).max(packed.len().saturating_mul(4)).max(SMALL);
                self.bytes.resize(room.min(max_bytes), 0);
            }
            let end = self.bytes.len().min(max_bytes);
            let status = decoder.run_on_buffers(packed, &mut self.bytes[self.len..end])?;
            packed = &packed[status.bytes_read..];
            self.len += status.bytes_written;
            is_whole = status.remaining == 0;
            if status.bytes_read == 0 && status.bytes_written == 0 && !is_whole {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_messages_are_unpacked_one_after_the_other() {
        let mut inflate = Inflate::new(1 << 30);
        for len in [0, 1, 5_000, 3, 200_000, 4_096] {
            let message: Vec<u8> = (0..len).map(|n| (n * 7 % 251) as u8).collect();
            let packed = zstd::encode_all(message.as_slice(), 1).unwrap();
            inflate.unpack(&packed, usize::MAX).unwrap();
            assert_eq!(inflate.bytes(), message);
        }
    }

    #[test]
    fn a_bomb_takes_no_more_memory_than_allowed() {
        let packed = zstd::encode_all(vec![0; 64 << 20].as_slice(), 1).unwrap();
        let mut inflate = Inflate::new(1 << 30);
        inflate.unpack(&packed, 100_000).unwrap();
        assert_eq!(inflate.bytes().len(), 100_000);
        assert!(inflate.bytes.capacity() <= 200_000, "{}", inflate.bytes.capacity());
    }

    #[test]
    fn a_truncated_or_invalid_frame_is_an_error() {
        let packed = zstd::encode_all(vec![7; 1000].as_slice(), 1).unwrap();
        let mut inflate = Inflate::new(1 << 30);
        for bad in [&packed[..packed.len() - 1], &packed[..6], &ZSTD, &[1, 2, 3, 4, 5, 6, 7, 8]] {
            assert!(inflate.unpack(bad, 1 << 20).is_err(), "{bad:?}");
        }
        inflate.unpack(&packed, 1 << 20).unwrap();
        assert_eq!(inflate.bytes(), [7; 1000]);
    }
}
