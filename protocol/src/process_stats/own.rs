//! Counts the memory of Gleaner's own code in a process that it shares with a lambda. The allocator
//! of that code counts here, so that the lambda is charged for the rest of the process only.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use crate::process_stats::Heartbeat;

/// Size from which the system's allocator maps each block by itself, and returns it to the system
/// when it is freed.
pub const LARGE_BYTES: usize = 128 << 10;

static LARGE: AtomicU64 = AtomicU64::new(0);
static SMALL: AtomicU64 = AtomicU64::new(0);
/// Peak of the small blocks: the allocator keeps the memory of freed ones.
static SMALL_PEAK: AtomicU64 = AtomicU64::new(0);

pub fn allocated(bytes: usize) {
    let size = block_bytes(bytes);
    if bytes >= LARGE_BYTES {
        LARGE.fetch_add(size, Relaxed);
        // Another thread of Gleaner may allocate during a wake, which must not count as the
        // lambda's memory.
        Heartbeat::publish_own();
        return;
    }
    let now = SMALL.fetch_add(size, Relaxed) + size;
    if now > SMALL_PEAK.load(Relaxed) {
        SMALL_PEAK.fetch_max(now, Relaxed);
    }
}

pub fn freed(bytes: usize) {
    let counter = if bytes >= LARGE_BYTES { &LARGE } else { &SMALL };
    counter.fetch_sub(block_bytes(bytes), Relaxed);
}

/// Returns the memory of Gleaner's own code, in bytes, as far as its allocator counts.
pub fn held() -> u64 {
    LARGE.load(Relaxed) + SMALL_PEAK.load(Relaxed)
}

/// Returns the size of a block with its header, in bytes.
fn block_bytes(bytes: usize) -> u64 {
    let step = if bytes >= LARGE_BYTES { 4096 } else { 16 };
    (bytes as u64 + 16).next_multiple_of(step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_blocks_count_while_they_live_and_small_ones_at_their_peak() {
        let before = held();
        allocated(1 << 20);
        assert_eq!(held() - before, (1 << 20) + 4096);
        freed(1 << 20);
        assert_eq!(held(), before);
        allocated(1000);
        assert_eq!(held() - before, 1016_u64.next_multiple_of(16));
        freed(1000);
        allocated(500);
        assert_eq!(held() - before, 1016_u64.next_multiple_of(16));
        freed(500);
    }
}
