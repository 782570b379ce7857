//! Why a pool or a ring cannot be built, and why a draft is refused. Written by hand: this crate
//! depends on std only.

use std::{error::Error, fmt};

/// A pool or a ring that cannot be built as asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoolError {
    /// A pool has 1 to 2^31 - 1 slots.
    SlotCount {
        /// Slots asked for.
        slots: usize,
    },
    /// Slots of this size and number do not fit the address space.
    TooLarge {
        /// Slots asked for.
        slots: usize,
        /// Bytes asked for in each.
        slot_bytes: usize,
    },
    /// The region is smaller than [`Pool::bytes_needed`](crate::Pool::bytes_needed).
    RegionTooSmall {
        /// Bytes that the slots need.
        needed: usize,
        /// Bytes that the region has.
        given: usize,
    },
    /// The region does not start at a multiple of 64.
    RegionUnaligned {
        /// Address at which it starts.
        address: usize,
    },
    /// The allocator has no such block.
    OutOfMemory {
        /// Bytes asked for.
        bytes: usize,
    },
    /// A ring shows at least one sample, and at most as many as its pool has slots.
    Depth {
        /// Depth asked for.
        depth: usize,
        /// Slots of the pool.
        slots: usize,
    },
}

impl fmt::Display for PoolError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::SlotCount { slots } => {
                write!(f, "a pool of {slots} slots; it must have 1 to 2147483647")
            }
            Self::TooLarge { slots, slot_bytes } => {
                write!(f, "{slots} slots of {slot_bytes} bytes exceed the address space")
            }
            Self::RegionTooSmall { needed, given } => {
                write!(f, "pool needs a region of {needed} bytes; it was given {given} bytes")
            }
            Self::RegionUnaligned { address } => {
                write!(f, "region starts at {address:#x}, which is no multiple of 64")
            }
            Self::OutOfMemory { bytes } => write!(f, "cannot allocate a region of {bytes} bytes"),
            Self::Depth { depth, slots } => {
                write!(
                    f,
                    "ring of depth {depth} over a pool of {slots} slots; depth must be 1 to {slots}"
                )
            }
        }
    }
}

impl Error for PoolError {}

/// Why there is no slot for a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// The sample is larger than a slot.
    TooBig {
        /// Bytes asked for.
        len: usize,
        /// Bytes in a slot.
        max: usize,
    },
    /// No slot is free and, for a ring, none of its samples is unpinned.
    NoSlot,
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::TooBig { len, max } => {
                write!(f, "sample of {len} bytes; a slot holds {max} bytes")
            }
            Self::NoSlot => write!(f, "every slot is in use"),
        }
    }
}

impl Error for Refusal {}
