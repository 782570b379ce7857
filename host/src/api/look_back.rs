//! The reach of a lambda into the samples of one topic, and the sums before the first of them.

use std::sync::atomic::{AtomicU64, Ordering};

use gleaner_buffers::Lease;
use gleaner_messages::transport::StoredMeta;

/// Value for a wake that looked at no sample.
const NONE: u64 = u64::MAX;

/// The oldest sample at which the lambda has looked in this wake. Only its thread writes it.
pub(super) struct LookBack(AtomicU64);

impl Default for LookBack {
    fn default() -> Self {
        Self(AtomicU64::new(NONE))
    }
}

impl LookBack {
    pub(super) fn reset(&self) {
        self.0.store(NONE, Ordering::Relaxed);
    }

    /// Position of the oldest sample that a call returned.
    pub(super) fn oldest(&self) -> Option<u64> {
        Some(self.0.load(Ordering::Relaxed)).filter(|position| *position != NONE)
    }

    /// Notes the oldest of the samples that a call returns.
    pub(super) fn at(&self, oldest: Option<&Lease<StoredMeta>>) {
        if let Some(position) = oldest.and_then(Lease::position) {
            self.at_position(position);
        }
    }

    pub(super) fn at_position(&self, position: u64) {
        if position < self.0.load(Ordering::Relaxed) {
            self.0.store(position, Ordering::Relaxed);
        }
    }
}

/// Sums over the samples before the first one of a ring: another process may have filled it before.
#[derive(Copy, Clone, Debug, Default)]
pub struct SumsBefore {
    /// Sum of their digests, modulo 2^32.
    pub digest: u32,
    pub refused: u64,
}
