//! Memory of our own code in a process that it shares with a lambda. The allocator of our code
//! counts here, so that the lambda is charged for the rest of the process and for nothing else.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use crate::Pulse;

/// From this size on the system's allocator maps each block by itself, and returns it to the system
/// when it is freed.
pub const LARGE_BYTES: usize = 128 << 10;

static LARGE: AtomicU64 = AtomicU64::new(0);
static SMALL: AtomicU64 = AtomicU64::new(0);
/// The most that small blocks took: the allocator keeps what they leave.
static SMALL_MOST: AtomicU64 = AtomicU64::new(0);

/// Counts a block of `bytes` that was allocated.
pub fn allocated(bytes: usize) {
    let taken = taken(bytes);
    if bytes >= LARGE_BYTES {
        LARGE.fetch_add(taken, Relaxed);
        // A message that the network puts together may come in the middle of a wake, and must not
        // count as the lambda's.
        Pulse::tell_own();
        return;
    }
    let now = SMALL.fetch_add(taken, Relaxed) + taken;
    if now > SMALL_MOST.load(Relaxed) {
        SMALL_MOST.fetch_max(now, Relaxed);
    }
}

/// Counts a block of `bytes` that was freed.
pub fn freed(bytes: usize) {
    let counter = if bytes >= LARGE_BYTES { &LARGE } else { &SMALL };
    counter.fetch_sub(taken(bytes), Relaxed);
}

/// Memory that our own code has, in bytes, as far as its allocator counts.
pub fn held() -> u64 {
    LARGE.load(Relaxed) + SMALL_MOST.load(Relaxed)
}

/// Bytes that a block takes with its header.
fn taken(bytes: usize) -> u64 {
    let step = if bytes >= LARGE_BYTES { 4096 } else { 16 };
    (bytes as u64 + 16).next_multiple_of(step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_blocks_count_while_they_live_and_small_ones_at_their_most() {
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
