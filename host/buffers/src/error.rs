//! Errors of building a pool or a ring, and of drafting a slot. Written by hand: this crate depends
//! on std only.

use std::{error::Error, fmt};

/// A pool or a ring that cannot be built as requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoolError {
    /// A pool has 1 to 2^31 - 1 slots.
    SlotCount { slots: usize },
    /// Slots of this size and number do not fit the address space.
    TooLarge { slots: usize, slot_bytes: usize },
    /// The region is smaller than [`Pool::bytes_needed`](crate::Pool::bytes_needed).
    RegionTooSmall { needed: usize, given: usize },
    /// The region does not start at a multiple of 64.
    RegionUnaligned { address: usize },
    /// The allocator returned no memory.
    OutOfMemory { bytes: usize },
    /// A ring shows at least one sample, and at most as many as its pool has slots.
    Depth { depth: usize, slots: usize },
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
                write!(f, "region starts at {address:#x}, which is not a multiple of 64")
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

/// Reasons why there is no slot for a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DraftError {
    /// The sample of `len` bytes is larger than a slot, which has `max` bytes.
    TooBig { len: usize, max: usize },
    /// No slot is free and, for a ring, none of its samples is unpinned.
    NoSlot,
}

impl fmt::Display for DraftError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::TooBig { len, max } => {
                write!(f, "sample of {len} bytes; a slot holds {max} bytes")
            }
            Self::NoSlot => write!(f, "every slot is in use"),
        }
    }
}

impl Error for DraftError {}
