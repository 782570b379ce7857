//! Slots of one size, and a count for each.
//!
//! The count controls access. At 0 the slot is free, or one [`Draft`] owns it, and no other code
//! reads its bytes. Above 0 it is sealed and not written: each [`Lease`] holds 1, and the ring that
//! shows it holds 1. Only sealing raises the count from 0; the holder that lowers it to 0 owns the
//! slot, and frees it or drafts it again.
#![allow(unsafe_code)]

use std::{
    fmt,
    mem::{ManuallyDrop, MaybeUninit},
    ptr::NonNull,
    slice,
};

use crate::{
    Draft, DraftError, Lease, PoolError, Region,
    free::FreeSet,
    sync::{Arc, AtomicU32, AtomicU64, Ordering, UnsafeCell},
};

/// Spare bytes in front of every slot, so that an encapsulation header and the payload can be one
/// slice.
pub const HEADROOM: usize = 4;

/// Alignment of each payload: a cache line, and any vector type.
const LINE: usize = 64;

/// Far below the overflow of the count and far above real use: only leaked leases get here.
pub(crate) const MAX_HOLDS: u32 = u32::MAX / 2;

/// Slots of one size over one region. Clones are handles to the same slots.
///
/// `M` is the metadata of a sample: time stamps, writer, encoding. Leases keep the pool alive.
pub struct Pool<M>(Arc<Slots<M>>);

pub(crate) struct Slots<M> {
    /// First payload byte of slot 0; slot `i` starts `i * stride` later.
    first: NonNull<u8>,
    stride: usize,
    slot_bytes: usize,
    slots: Box<[Slot<M>]>,
    pub(crate) free: FreeSet,
    /// Number of rings built over this pool so far: the source of their identities.
    rings: AtomicU64,
    /// Owns the memory behind `first`.
    _region: Box<dyn Region>,
}

pub(crate) struct Slot<M> {
    pub(crate) count: AtomicU32,
    /// Initialised when the count is above 0.
    pub(crate) seal: UnsafeCell<MaybeUninit<Seal<M>>>,
}

pub(crate) struct Seal<M> {
    pub(crate) len: usize,
    pub(crate) stamp: Option<RingStamp>,
    pub(crate) meta: M,
}

/// The ring that published a sample, and the sample's position in it. Rings share a pool, so a
/// position alone could be that of another ring's sample.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct RingStamp {
    pub(crate) ring: u64,
    pub(crate) position: u64,
}

// SAFETY: the bytes and the seal of a slot are written by the one owner of its draft, and read by
// other threads only after they saw its count above 0 (see the module docs). `M` is moved in on one
// thread and shared from there.
unsafe impl<M: Send + Sync> Send for Slots<M> {}
// SAFETY: as above.
unsafe impl<M: Send + Sync> Sync for Slots<M> {}

impl<M> Slots<M> {
    pub(crate) fn slot(&self, index: u32) -> &Slot<M> {
        &self.slots[index as usize]
    }

    /// Returns the first payload byte of a slot; the headroom is before it.
    pub(crate) fn payload(&self, index: u32) -> NonNull<u8> {
        assert!((index as usize) < self.slots.len());
        // SAFETY: `Pool::new` checked that the region holds `slots` strides after `first`, and
        // `index < slots`.
        unsafe { self.first.add(index as usize * self.stride) }
    }

    /// Returns the seal of a slot.
    ///
    /// # Safety
    ///
    /// The caller owns a hold on the slot while it uses what is returned.
    pub(crate) unsafe fn seal(&self, index: u32) -> &Seal<M> {
        // SAFETY: the hold keeps the count above 0: the seal is initialised, visible since that
        // count was read, and not written to before the hold ends.
        self.slot(index).seal.with(|seal| unsafe { (*seal).assume_init_ref() })
    }

    /// Returns the [`HEADROOM`] bytes and the sample in a slot as one slice.
    ///
    /// # Safety
    ///
    /// The caller owns a hold on the slot while it uses what is returned.
    pub(crate) unsafe fn with_headroom(&self, index: u32) -> &[u8] {
        // SAFETY: the caller's promise.
        let len = unsafe { self.seal(index) }.len;
        let payload = self.payload(index);
        // SAFETY: the headroom and the `len` bytes after it are one initialised part of the region,
        // and the hold keeps writers away until it ends.
        unsafe { slice::from_raw_parts(payload.sub(HEADROOM).as_ptr(), HEADROOM + len) }
    }

    /// Releases one hold; the last one frees the slot.
    ///
    /// # Safety
    ///
    /// The caller owns a hold on the slot, and loses it here.
    pub(crate) unsafe fn release(&self, index: u32) {
        // Release: reads by this thread come before any later write. Acquire, for the last hold: so
        // do the reads of the other holders.
        if self.slot(index).count.fetch_sub(1, Ordering::AcqRel) == 1 {
            self.free.give(index);
        }
    }
}

impl<M: Copy + Send + Sync + 'static> Pool<M> {
    /// Creates a pool of `slots` free slots, each for samples of up to `slot_bytes` bytes.
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
        // Boxed before its address is taken: from here on it is not moved.
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

    /// Returns the size of the region for such a pool, in bytes; `None` if no region can be that
    /// large.
    ///
    /// Every payload starts at a multiple of 64, with its headroom in the padding before it.
    pub fn bytes_needed(slots: usize, slot_bytes: usize) -> Option<usize> {
        let bytes = stride(slot_bytes)?.checked_mul(slots)?.checked_add(LINE)?;
        (bytes <= isize::MAX as usize).then_some(bytes)
    }
}

/// Returns the bytes from one payload to the next: itself and the headroom of the next one, rounded
/// up to [`LINE`].
fn stride(slot_bytes: usize) -> Option<usize> {
    slot_bytes.checked_add(HEADROOM)?.checked_next_multiple_of(LINE)
}

impl<M> Pool<M> {
    /// Returns a free slot, with `len` bytes.
    ///
    /// # Errors
    ///
    /// [`DraftError::TooBig`] if `len` exceeds [`slot_bytes`](Self::slot_bytes);
    /// [`DraftError::NoSlot`] if none is free. A slot that is freed while other threads draft may
    /// be missed.
    pub fn draft(&self, len: usize) -> Result<Draft<M>, DraftError> {
        let max = self.0.slot_bytes;
        if len > max {
            return Err(DraftError::TooBig { len, max });
        }
        let index = self.0.free.take().ok_or(DraftError::NoSlot)?;
        // SAFETY: the slot was taken out of the free set, so this call owns it, and `len <=
        // slot_bytes`.
        Ok(unsafe { Draft::new(Arc::clone(&self.0), index, len) })
    }

    pub fn slots(&self) -> usize {
        self.0.slots.len()
    }

    /// Returns the bytes that a slot holds, without headroom.
    pub fn slot_bytes(&self) -> usize {
        self.0.slot_bytes
    }

    /// Returns the number of free slots: exact while no other thread uses the pool, otherwise
    /// outdated at once.
    pub fn free(&self) -> usize {
        self.0.free.count()
    }

    /// Returns an identity for a new ring over this pool.
    pub(crate) fn next_ring(&self) -> u64 {
        self.0.rings.fetch_add(1, Ordering::Relaxed)
    }

    pub(crate) fn owns(&self, draft: &Draft<M>) -> bool {
        draft.is_of(&self.0)
    }

    /// Returns a lease on a slot, if it is sealed and has `stamp`.
    ///
    /// If it returns `None`, then all accesses before the slot lost that stamp are visible to the
    /// caller.
    pub(crate) fn pin(&self, index: u32, stamp: RingStamp) -> Option<Lease<M>> {
        let _passed_on = ManuallyDrop::new(self.hold(index, stamp)?);
        // SAFETY: that hold is never dropped, and goes to the lease.
        Some(unsafe { Lease::new(Arc::clone(&self.0), index) })
    }

    /// Returns what `read` makes of the metadata and the bytes of a sample, as [`pin`](Self::pin)
    /// finds it.
    pub(crate) fn read<T>(
        &self,
        index: u32,
        stamp: RingStamp,
        read: impl FnOnce(&M, &[u8]) -> T,
    ) -> Option<T> {
        let hold = self.hold(index, stamp)?;
        // SAFETY: `hold` is dropped after the call.
        let (seal, bytes) = unsafe { (hold.slots.seal(index), hold.slots.with_headroom(index)) };
        Some(read(&seal.meta, &bytes[HEADROOM..]))
    }

    fn hold(&self, index: u32, stamp: RingStamp) -> Option<BorrowedHold<'_, M>> {
        let one_more = |count| (1..MAX_HOLDS).contains(&count).then_some(count + 1);
        let count = &self.0.slot(index).count;
        // Acquire on success pairs with `Draft::sealed`; on failure, with what brought the count to
        // 0: `release` or `reclaim`.
        count.fetch_update(Ordering::Acquire, Ordering::Acquire, one_more).ok()?;
        // The count was raised from above 0, and that hold is the one of `hold`.
        let hold = BorrowedHold { slots: &self.0, index };
        // SAFETY: `hold` is dropped after this.
        let found = unsafe { hold.slots.seal(index) }.stamp;
        // The slot may have been sealed again after the caller read its index. Then the hold is on
        // another sample, and is dropped here.
        (found == Some(stamp)).then_some(hold)
    }

    /// Releases a hold that [`Draft::sealed`] has left.
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
    /// The caller owns that hold, and loses it if a draft is returned. `len <= slot_bytes`.
    pub(crate) unsafe fn reclaim(&self, index: u32, len: usize) -> Option<Draft<M>> {
        let count = &self.0.slot(index).count;
        // Acquire pairs with `release`: reads of former holders come before writes of the draft's
        // owner. Release pairs with a `pin` that fails.
        count.compare_exchange(1, 0, Ordering::AcqRel, Ordering::Relaxed).ok()?;
        // SAFETY: the count is 0 and was lowered here, so this call owns the slot; the caller
        // checked `len`.
        Some(unsafe { Draft::new(Arc::clone(&self.0), index, len) })
    }
}

/// One hold on a slot, which ends while its pool is borrowed.
struct BorrowedHold<'a, M> {
    slots: &'a Slots<M>,
    index: u32,
}

impl<M> Drop for BorrowedHold<'_, M> {
    fn drop(&mut self) {
        // SAFETY: it owns one hold, which ends here.
        unsafe { self.slots.release(self.index) }
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

    // SAFETY: all but the first byte of a region that fulfils the same promises.
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
    fn an_unaligned_region_is_refused() {
        let region = Shifted(HeapRegion::zeroed(4096).unwrap());
        let address = region.base().as_ptr() as usize;
        let refused = Pool::<()>::new(region, 1, 1).unwrap_err();
        assert_eq!(refused, PoolError::RegionUnaligned { address });
    }
}
