//! Bytes of a message or a picture that stay in place while they are referenced.

use std::ops::Deref;
use std::sync::Arc;

use gleaner_buffers::Lease;
use gleaner_messages::transport::StoredMeta;
use gleaner_rules::clamps;

use super::images::Info;

/// A range of immutable bytes, shared with their owner without a copy.
#[derive(Clone)]
pub struct SharedBytes {
    owner: BytesOwner,
    start: usize,
    len: usize,
}

#[derive(Clone)]
enum BytesOwner {
    /// A slot of the ring.
    Message(Lease<StoredMeta>),
    /// A slot for decoded pictures.
    Decoded(Lease<Info>),
    /// Own memory. Boxed twice, since an `Arc<[u8]>` would need a copy.
    Owned(Arc<Box<[u8]>>),
}

impl SharedBytes {
    /// All bytes of a message.
    pub(super) fn of_message(lease: &Lease<StoredMeta>) -> Self {
        Self { len: lease.len(), start: 0, owner: BytesOwner::Message(lease.clone()) }
    }

    /// All bytes of a decoded picture.
    pub(super) fn of_decoded(lease: Lease<Info>) -> Self {
        Self { len: lease.len(), start: 0, owner: BytesOwner::Decoded(lease) }
    }

    pub(super) fn owned(bytes: Box<[u8]>) -> Self {
        Self { len: bytes.len(), start: 0, owner: BytesOwner::Owned(Arc::new(bytes)) }
    }

    /// Returns `len` bytes from `offset`, clamped to its length.
    pub(super) fn part(&self, offset: u64, len: usize) -> Self {
        let place = clamps::piece(self.len, offset, len);
        Self { owner: self.owner.clone(), start: self.start + place.start, len: place.len() }
    }
}

impl Deref for SharedBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        let whole: &[u8] = match &self.owner {
            BytesOwner::Message(lease) => lease,
            BytesOwner::Decoded(lease) => lease,
            BytesOwner::Owned(bytes) => bytes,
        };
        &whole[self.start..self.start + self.len]
    }
}

impl AsRef<[u8]> for SharedBytes {
    fn as_ref(&self) -> &[u8] {
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_is_clamped_to_the_length() {
        let whole = SharedBytes::owned((0..10).collect());
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
    fn a_part_of_a_part_is_relative_to_it_and_outlives_the_whole() {
        let whole = SharedBytes::owned((0..10).collect());
        let part = whole.part(4, 4);
        drop(whole);
        let last = part.part(2, 100);
        drop(part);
        assert_eq!(*last, [6, 7]);
    }
}
