//! Slots of one size, and the count on each.
//!
//! The count says who may do what. At 0 the slot is free, or one [`Draft`] owns it, and nobody else
//! looks at its bytes. Above 0 it is sealed, and nobody writes: each [`Lease`] holds 1, and the
//! ring that shows it holds 1. Only sealing raises the count from 0; whoever lowers it to 0 owns
//! the slot, and frees it or drafts it again.
#![allow(unsafe_code)]

use std::{fmt, mem::MaybeUninit, ptr::NonNull};

use crate::{
    Draft, Lease, PoolError, Refusal, Region,
    free::FreeSet,
    sync::{Arc, AtomicU32, AtomicU64, Ordering, UnsafeCell},
};

/// Spare bytes in front of every slot, so that an encapsulation header and the payload can be one
/// slice.
pub const HEADROOM: usize = 4;

/// Alignment of each payload: a cache line, and any vector type.
const LINE: usize = 64;

/// Far below the wrap of the count, far above what anyone holds: only leaked leases get here.
pub(crate) const MOST_HOLDS: u32 = u32::MAX / 2;

/// Slots of one size over one region. Clones are handles to the same slots.
///
/// `M` is what a sample carries besides its bytes: stamps, writer, encoding. Leases keep the pool
/// alive.
pub struct Pool<M>(Arc<Slots<M>>);

pub(crate) struct Slots<M> {
    /// First payload byte of slot 0; slot `i` starts `i * stride` later.
    first: NonNull<u8>,
    stride: usize,
    slot_bytes: usize,
    slots: Box<[Slot<M>]>,
    pub(crate) free: FreeSet,
    /// Rings built over this pool so far: the source of their identities.
    rings: AtomicU64,
    /// Keeps the memory behind `first`.
    _region: Box<dyn Region>,
}

pub(crate) struct Slot<M> {
    pub(crate) count: AtomicU32,
    /// Initialised when the count is above 0.
    pub(crate) seal: UnsafeCell<MaybeUninit<Seal<M>>>,
}

pub(crate) struct Seal<M> {
    pub(crate) len: usize,
    pub(crate) stamp: Option<Stamp>,
    pub(crate) meta: M,
}

/// Which ring published a sample, and as which. Rings share a pool, so a position alone could be a
/// stranger's.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct Stamp {
    pub(crate) ring: u64,
    pub(crate) position: u64,
}

// SAFETY: the bytes and the seal of a slot are written by the one owner of its draft, and read by
// others only after they saw its count above 0 (see the head of this file). `M` is moved in on one
// thread and shared from there.
unsafe impl<M: Send + Sync> Send for Slots<M> {}
// SAFETY: as above.
unsafe impl<M: Send + Sync> Sync for Slots<M> {}

impl<M> Slots<M> {
    pub(crate) fn slot(&self, index: u32) -> &Slot<M> {
        &self.slots[index as usize]
    }

    /// First payload byte of a slot; the headroom lies before it.
    pub(crate) fn payload(&self, index: u32) -> NonNull<u8> {
        assert!((index as usize) < self.slots.len());
        // SAFETY: `Pool::new` checked that the region holds `slots` strides after `first`, and
        // `index < slots`.
        unsafe { self.first.add(index as usize * self.stride) }
    }

    /// Gives up one hold; the last one frees the slot.
    ///
    /// # Safety
    ///
    /// The caller owns a hold on the slot, and loses it here.
    pub(crate) unsafe fn release(&self, index: u32) {
        // Release: what we read comes before any later write. Acquire, for the last one: what the
        // others read, too.
        if self.slot(index).count.fetch_sub(1, Ordering::AcqRel) == 1 {
            self.free.give(index);
        }
    }
}

impl<M: Copy + Send + Sync + 'static> Pool<M> {
    /// A pool of `slots` slots, each for samples of up to `slot_bytes` bytes, all free.
    ///
    /// # Errors
    ///
    /// [`PoolError::SlotCount`] for 0 or more than 2^31 - 1 slots, [`PoolError::TooLarge`] if their
    /// size overflows, [`PoolError::RegionTooSmall`] and [`PoolError::RegionUnaligned`] if they do
    /// not fit `region`.
    pub fn new(region: impl Region, slots: usize, slot_bytes: usize) -> Result<Self, PoolError> {
        let count = match u32::try_from(slots) {
            Ok(count @ 1..=0x7fff_ffff) => count,
            _ => return Err(PoolError::SlotCount { slots }),
        };
        let too_large = PoolError::TooLarge { slots, slot_bytes };
        let stride = stride(slot_bytes).ok_or(too_large)?;
        let needed = Self::bytes_needed(slots, slot_bytes).ok_or(too_large)?;
        let given = region.len();
        if given < needed {
            return Err(PoolError::RegionTooSmall { needed, given });
        }
        // Boxed before its address is taken: from here on it stays where it is.
        let region: Box<dyn Region> = Box::new(region);
        let address = region.base().as_ptr() as usize;
        if !address.is_multiple_of(LINE) {
            return Err(PoolError::RegionUnaligned { address });
        }
        let slot =
            |_| Slot { count: AtomicU32::new(0), seal: UnsafeCell::new(MaybeUninit::uninit()) };
        Ok(Self(Arc::new(Slots {
            // SAFETY: the region has at least `needed` bytes, which is `LINE` and then the strides.
            first: unsafe { region.base().add(LINE) },
            stride,
            slot_bytes,
            slots: (0..count).map(slot).collect(),
            free: FreeSet::full(count),
            rings: AtomicU64::new(0),
            _region: region,
        })))
    }

    /// Size in bytes of the region for such a pool; `None` if no region can be that large.
    ///
    /// Every payload starts at a multiple of 64, with its headroom in the padding before it.
    pub fn bytes_needed(slots: usize, slot_bytes: usize) -> Option<usize> {
        let bytes = stride(slot_bytes)?.checked_mul(slots)?.checked_add(LINE)?;
        (bytes <= isize::MAX as usize).then_some(bytes)
    }
}

/// Bytes from one payload to the next: itself and the headroom of the next one, rounded up to
/// [`LINE`].
fn stride(slot_bytes: usize) -> Option<usize> {
    slot_bytes.checked_add(HEADROOM)?.checked_next_multiple_of(LINE)
}

impl<M> Pool<M> {
    /// A free slot, cut to `len` bytes.
    ///
    /// # Errors
    ///
    /// [`Refusal::TooBig`] if `len` exceeds [`slot_bytes`](Self::slot_bytes); [`Refusal::NoSlot`]
    /// if none is free. A slot that is freed while others draft may be missed.
    pub fn draft(&self, len: usize) -> Result<Draft<M>, Refusal> {
        let max = self.0.slot_bytes;
        if len > max {
            return Err(Refusal::TooBig { len, max });
        }
        let index = self.0.free.take().ok_or(Refusal::NoSlot)?;
        // SAFETY: out of the free set, the slot is ours alone, and `len <= slot_bytes`.
        Ok(unsafe { Draft::new(Arc::clone(&self.0), index, len) })
    }

    /// Number of slots.
    pub fn slots(&self) -> usize {
        self.0.slots.len()
    }

    /// Bytes that a slot holds, headroom not included.
    pub fn slot_bytes(&self) -> usize {
        self.0.slot_bytes
    }

    /// Slots that nobody holds: exact while nothing else uses the pool, else out of date at once.
    pub fn free(&self) -> usize {
        self.0.free.count()
    }

    /// An identity for a new ring over this pool.
    pub(crate) fn next_ring(&self) -> u64 {
        self.0.rings.fetch_add(1, Ordering::Relaxed)
    }

    pub(crate) fn made(&self, draft: &Draft<M>) -> bool {
        draft.is_of(&self.0)
    }

    /// A lease on a slot, if it is sealed and carries `stamp`.
    ///
    /// If this answers `None`, then all that was done before the slot lost that stamp is visible to
    /// the caller.
    pub(crate) fn pin(&self, index: u32, stamp: Stamp) -> Option<Lease<M>> {
        let one_more = |count| (1..MOST_HOLDS).contains(&count).then_some(count + 1);
        let count = &self.0.slot(index).count;
        // Acquire on success pairs with `Draft::sealed`; on failure, with what brought the count to
        // 0: `release` or `reclaim`.
        count.fetch_update(Ordering::Acquire, Ordering::Acquire, one_more).ok()?;
        // SAFETY: we have just raised the count from above 0, and hand that hold over.
        let lease = unsafe { Lease::new(Arc::clone(&self.0), index) };
        // The slot may have been sealed anew since the caller learnt its index. Then we held a
        // stranger's sample for a moment, and drop it here.
        (lease.stamp() == Some(stamp)).then_some(lease)
    }

    /// Gives up a hold that [`Draft::into_hold`] has left.
    ///
    /// # Safety
    ///
    /// The caller owns that hold, and loses it here.
    pub(crate) unsafe fn release(&self, index: u32) {
        // SAFETY: the caller's promise.
        unsafe { self.0.release(index) }
    }

    /// Turns a hold into a draft of `len` bytes, if it is the only hold on its slot.
    ///
    /// # Safety
    ///
    /// The caller owns that hold, and loses it if a draft comes back. `len <= slot_bytes`.
    pub(crate) unsafe fn reclaim(&self, index: u32, len: usize) -> Option<Draft<M>> {
        let count = &self.0.slot(index).count;
        // Acquire pairs with `release`: what former holders read comes before what the draft's
        // owner writes. Release pairs with a `pin` that fails.
        count.compare_exchange(1, 0, Ordering::AcqRel, Ordering::Relaxed).ok()?;
        // SAFETY: the count is 0 and we brought it there, so the slot is ours alone; the caller
        // checked `len`.
        Some(unsafe { Draft::new(Arc::clone(&self.0), index, len) })
    }
}

impl<M> Clone for Pool<M> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<M> fmt::Debug for Pool<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Pool")
            .field("slots", &self.slots())
            .field("slot_bytes", &self.slot_bytes())
            .field("free", &self.free())
            .finish()
    }
}

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;
    use crate::HeapRegion;

    struct Shifted(HeapRegion);

    // SAFETY: all but the first byte of a region that keeps the same promises.
    unsafe impl Region for Shifted {
        fn base(&self) -> NonNull<u8> {
            // SAFETY: the test's region has more than one byte.
            unsafe { self.0.base().add(1) }
        }

        fn len(&self) -> usize {
            self.0.len() - 1
        }
    }

    #[test]
    fn a_region_that_starts_off_a_line_is_refused() {
        let region = Shifted(HeapRegion::zeroed(4096).unwrap());
        let address = region.base().as_ptr() as usize;
        let refused = Pool::<()>::new(region, 1, 1).unwrap_err();
        assert_eq!(refused, PoolError::RegionUnaligned { address });
    }
}
