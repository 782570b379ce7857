//! Metadata that a ring stores beside each sample, and its form in shared memory.

use crate::Endian;

use crate::transport::{Guid, SampleMeta};

pub const STORED_WORDS: usize = 12;

/// Metadata of a sample in a ring, and sums over all samples of its topic up to it. With the sums
/// of two samples, a reader knows what arrived between them.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct StoredMeta {
    pub sample: SampleMeta,
    /// Sum of the digests of all samples up to and including this one, modulo 2^32; 0 while digests
    /// are off.
    pub digests: u32,
    /// Number of samples refused before this one, because they were too large or had no slot.
    pub refused: u64,
}

impl StoredMeta {
    pub fn words(&self) -> [u64; STORED_WORDS] {
        let Self { sample, digests, refused } = *self;
        let [high, low] = [&sample.writer.0[..8], &sample.writer.0[8..]]
            .map(|half| u64::from_le_bytes(half.try_into().expect("a guid has 16 bytes")));
        let [second, third] = sample.options;
        let flags = u64::from(sample.endian == Endian::Big)
            | u64::from(second) << 8
            | u64::from(third) << 16
            | u64::from(sample.layout) << 24
            | u64::from(sample.is_latched) << 40;
        [
            sample.at_ns.cast_unsigned(),
            sample.publish_ns.cast_unsigned(),
            high,
            low,
            sample.seq,
            flags,
            digests.into(),
            refused,
            0,
            0,
            0,
            0,
        ]
    }

    /// Converts words back. Any words give some metadata.
    pub fn of_words(words: &[u64; STORED_WORDS]) -> Self {
        let [at, publish, high, low, seq, flags, digests, refused, ..] = *words;
        let mut guid = [0; 16];
        guid[..8].copy_from_slice(&high.to_le_bytes());
        guid[8..].copy_from_slice(&low.to_le_bytes());
        let sample = SampleMeta {
            at_ns: at.cast_signed(),
            publish_ns: publish.cast_signed(),
            writer: Guid(guid),
            seq,
            endian: if flags & 1 == 1 { Endian::Big } else { Endian::Little },
            options: [(flags >> 8) as u8, (flags >> 16) as u8],
            layout: (flags >> 24) as u16,
            is_latched: flags >> 40 & 1 == 1,
        };
        Self { sample, digests: digests as u32, refused }
    }

    /// Returns the sum of the digests before this sample, of which `cdr` are the bytes.
    pub fn digests_before(&self, cdr: &[u8]) -> u32 {
        self.digests.wrapping_sub(sample_digest(&self.sample, cdr))
    }
}

/// Sums over the samples of a topic, by the thread that fills its ring.
#[derive(Clone, Debug, Default)]
pub struct ArrivalSums {
    digests: Option<u32>,
    refused: u64,
}

impl ArrivalSums {
    /// Adds digests from now on: they cost a pass over the bytes of each sample.
    pub fn enable_digests(&mut self) {
        self.digests.get_or_insert(0);
    }

    /// Adds no further digests. The sum begins at 0 when they are enabled again.
    pub fn disable_digests(&mut self) {
        self.digests = None;
    }

    pub fn has_digests(&self) -> bool {
        self.digests.is_some()
    }

    /// Returns the sum of the digests so far; 0 while they are off.
    pub fn digests(&self) -> u32 {
        self.digests.unwrap_or(0)
    }

    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Adds a sample that is about to enter the ring.
    pub fn add(&mut self, sample: &SampleMeta, cdr: &[u8]) -> StoredMeta {
        if let Some(digests) = &mut self.digests {
            *digests = digests.wrapping_add(sample_digest(sample, cdr));
        }
        StoredMeta { sample: *sample, digests: self.digests(), refused: self.refused }
    }

    pub fn refuse(&mut self) {
        self.refused += 1;
    }
}

/// CRC-32 of a sample, plus its stamps: any changed byte changes it. A CRC of the stamps would cost
/// as much as that of a small sample.
fn sample_digest(meta: &SampleMeta, cdr: &[u8]) -> u32 {
    let fold = |stamp: i64| stamp as u32 ^ (stamp >> 32) as u32;
    let stamps =
        fold(meta.at_ns).wrapping_mul(3).wrapping_add(fold(meta.publish_ns).wrapping_mul(5));
    crc32fast::hash(cdr).wrapping_add(stamps)
}

/// Counters of a topic in the header of its memory.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct TopicCounters {
    /// Number of samples that were larger than a slot.
    pub too_big: u64,
    /// Number of samples lost before they reached this machine; `None` if unknown.
    pub lost: Option<u64>,
}

impl TopicCounters {
    pub fn words(&self) -> [u64; 8] {
        [self.too_big, self.lost.map_or(0, |lost| lost.saturating_add(1)), 0, 0, 0, 0, 0, 0]
    }

    pub fn of_words(words: &[u64; 8]) -> Self {
        Self { too_big: words[0], lost: words[1].checked_sub(1) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_give_back_what_was_stored() {
        let sample = SampleMeta {
            at_ns: -7,
            publish_ns: i64::MAX,
            writer: Guid(std::array::from_fn(|n| 100 + n as u8)),
            seq: u64::MAX,
            endian: Endian::Big,
            options: [3, 250],
            layout: 0xfff1,
            is_latched: true,
        };
        let stored = StoredMeta { sample, digests: u32::MAX, refused: 5 };
        assert_eq!(StoredMeta::of_words(&stored.words()), stored);
        for lost in [None, Some(0), Some(9)] {
            let counters = TopicCounters { too_big: 4, lost };
            assert_eq!(TopicCounters::of_words(&counters.words()), counters);
        }
    }

    #[test]
    fn sums_differ_by_what_arrived_between_two_samples() {
        let meta = |seq| SampleMeta::new(seq as i64, Guid::default(), seq);
        let (mut sums, mut later) = (ArrivalSums::default(), ArrivalSums::default());
        assert_eq!(sums.add(&meta(1), b"one").digests, 0, "digests are off");
        sums.enable_digests();
        later.enable_digests();
        let first = sums.add(&meta(2), b"two");
        sums.refuse();
        let second = sums.add(&meta(3), b"three");
        assert_eq!((first.refused, second.refused), (0, 1));
        let alone = later.add(&meta(3), b"three");
        assert_eq!(second.digests.wrapping_sub(first.digests), alone.digests);
        assert_ne!(later.add(&meta(3), b"thrEe").digests, alone.digests.wrapping_mul(2));
    }
}
