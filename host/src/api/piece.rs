//! Bytes of a message or of a picture that stay where they are for as long as somebody has them.

use std::ops::Deref;
use std::sync::Arc;

use gleaner_buffers::Lease;
use gleaner_rules::clamps;
use gleaner_transport::SampleMeta;

use super::frame::Info;

/// Bytes that nobody changes, without a copy of their own.
#[derive(Clone)]
pub struct Piece {
    held: Held,
    start: usize,
    len: usize,
}

#[derive(Clone)]
enum Held {
    /// In a cell of the ring.
    Message(Lease<SampleMeta>),
    /// In a slot for decoded pictures.
    Decoded(Lease<Info>),
    /// In memory of its own. Twice boxed, since what is boxed once would have to be copied.
    Made(Arc<Box<[u8]>>),
}

impl Piece {
    /// All of a message.
    pub(super) fn of_message(lease: &Lease<SampleMeta>) -> Self {
        Self { len: lease.len(), start: 0, held: Held::Message(lease.clone()) }
    }

    /// All of a decoded picture.
    pub(super) fn of_decoded(lease: Lease<Info>) -> Self {
        Self { len: lease.len(), start: 0, held: Held::Decoded(lease) }
    }

    /// All of `bytes`.
    pub(super) fn made(bytes: Box<[u8]>) -> Self {
        Self { len: bytes.len(), start: 0, held: Held::Made(Arc::new(bytes)) }
    }

    /// `len` bytes of it from `offset`, clamped to what it has.
    pub(super) fn part(&self, offset: u64, len: usize) -> Self {
        let place = clamps::piece(self.len, offset, len);
        Self { held: self.held.clone(), start: self.start + place.start, len: place.len() }
    }
}

impl Deref for Piece {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        let whole: &[u8] = match &self.held {
            Held::Message(lease) => lease,
            Held::Decoded(lease) => lease,
            Held::Made(bytes) => bytes,
        };
        &whole[self.start..self.start + self.len]
    }
}

impl AsRef<[u8]> for Piece {
    fn as_ref(&self) -> &[u8] {
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_is_clamped_to_what_there_is() {
        let whole = Piece::made((0..10).collect());
        for (offset, len, expected) in [
            (0, 10, &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9][..]),
            (8, 5, &[8, 9]),
            (3, 0, &[]),
            (10, 1, &[]),
            (u64::MAX, 9, &[]),
        ] {
            assert_eq!(&*whole.part(offset, len), expected, "{len} from {offset}");
        }
    }

    #[test]
    fn a_part_of_a_part_counts_from_its_begin_and_outlives_the_whole() {
        let whole = Piece::made((0..10).collect());
        let part = whole.part(4, 4);
        drop(whole);
        let last = part.part(2, 100);
        drop(part);
        assert_eq!(*last, [6, 7]);
    }
}
