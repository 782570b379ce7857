//! The two handles on a slot: a draft, which its owner writes, and a lease, which many read.
#![allow(unsafe_code)]

use std::{
    fmt,
    mem::ManuallyDrop,
    ops::{Deref, DerefMut},
    process, ptr, slice,
};

use crate::{
    HEADROOM,
    pool::{MAX_HOLDS, RingStamp, Seal, Slots},
    shared::HeldSample,
    sync::{Arc, Ordering},
};

/// A slot to fill, with one owner: the bytes are a `&mut [u8]` of exactly the requested length.
///
/// They still hold the slot's last sample: write all of them, or [`truncate`](Self::truncate).
/// Dropping the draft frees the slot.
pub struct Draft<M> {
    slots: Arc<Slots<M>>,
    index: u32,
    len: usize,
}

impl<M> Draft<M> {
    /// # Safety
    ///
    /// The slot is out of the free set, its count is 0, and there is no other draft of it: the
    /// caller owns it, and passes it on. `len <= slot_bytes`.
    pub(crate) unsafe fn new(slots: Arc<Slots<M>>, index: u32, len: usize) -> Self {
        let mut draft = Self { slots, index, len };
        draft.headroom_mut().fill(0);
        draft
    }

    pub(crate) fn is_of(&self, slots: &Arc<Slots<M>>) -> bool {
        Arc::ptr_eq(&self.slots, slots)
    }

    /// Truncates the draft to `len` bytes; does nothing if it is not longer.
    pub fn truncate(&mut self, len: usize) {
        self.len = self.len.min(len);
    }

    /// Returns the bytes in front of the sample; 0 in a new draft.
    pub fn headroom_mut(&mut self) -> &mut [u8; HEADROOM] {
        let payload = self.slots.payload(self.index);
        // SAFETY: the bytes before each payload belong to its slot, the slot to this draft, and the
        // draft is borrowed.
        unsafe { payload.sub(HEADROOM).cast().as_mut() }
    }

    /// Turns the draft into a lease on the sample.
    pub fn seal(self, meta: M) -> Lease<M> {
        let (slots, index) = self.sealed(None, meta);
        // SAFETY: `sealed` left one hold, which goes to the lease.
        unsafe { Lease::new(slots, index) }
    }

    /// Raises the count of the slot of the returned index to 1; the caller owns that hold.
    pub(crate) fn sealed(self, stamp: Option<RingStamp>, meta: M) -> (Arc<Slots<M>>, u32) {
        let draft = ManuallyDrop::new(self);
        let (index, len) = (draft.index, draft.len);
        // SAFETY: moves the field out of a draft that is never dropped.
        let slots = unsafe { ptr::read(&draft.slots) };
        let slot = slots.slot(index);
        slot.seal.with_mut(|seal| {
            // SAFETY: the count is 0 and the slot is this draft's, so no other thread accesses the
            // seal.
            unsafe { (*seal).write(Seal { len, stamp, meta }) };
        });
        // Release pairs with `pin`: a thread that sees the count above 0 sees the seal and the
        // bytes.
        slot.count.store(1, Ordering::Release);
        (slots, index)
    }
}

impl<M> Deref for Draft<M> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        let payload = self.slots.payload(self.index);
        // SAFETY: a slot holds `slot_bytes >= len` initialised bytes, and only this draft can write
        // to this one.
        unsafe { slice::from_raw_parts(payload.as_ptr(), self.len) }
    }
}

impl<M> DerefMut for Draft<M> {
    fn deref_mut(&mut self) -> &mut [u8] {
        let payload = self.slots.payload(self.index);
        // SAFETY: as in `deref`, and the draft is borrowed mutably.
        unsafe { slice::from_raw_parts_mut(payload.as_ptr(), self.len) }
    }
}

impl<M> Drop for Draft<M> {
    fn drop(&mut self) {
        self.slots.free.give(self.index);
    }
}

impl<M> fmt::Debug for Draft<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Draft").field("len", &self.len).finish_non_exhaustive()
    }
}

/// A read-only hold on a sealed sample, whose bytes do not change while it lives.
///
/// Clones are further holds; dropping the last one frees the slot. More than 2^31 holds at once,
/// which takes leaked leases, abort the process, as for `Arc`.
pub struct Lease<M>(Held<M>);

enum Held<M> {
    Slot(SlotHold<M>),
    Shared { sample: HeldSample, position: u64, meta: M },
}

impl<M> Lease<M> {
    /// # Safety
    ///
    /// The caller owns a hold on the slot, and passes it on.
    pub(crate) unsafe fn new(slots: Arc<Slots<M>>, index: u32) -> Self {
        Self(Held::Slot(SlotHold { slots, index }))
    }

    /// A lease on a sample in shared memory, at `position` of a ring.
    pub(crate) fn shared(sample: HeldSample, position: u64, meta: M) -> Self {
        Self(Held::Shared { sample, position, meta })
    }

    pub fn meta(&self) -> &M {
        match &self.0 {
            Held::Slot(hold) => &hold.seal().meta,
            Held::Shared { meta, .. } => meta,
        }
    }

    /// Returns the sample's position in the ring that published it; `None` without a ring.
    pub fn position(&self) -> Option<u64> {
        match &self.0 {
            Held::Slot(_) => self.stamp().map(|stamp| stamp.position),
            Held::Shared { position, .. } => Some(*position),
        }
    }

    /// The stamp of the ring over a pool that published the sample.
    pub(crate) fn stamp(&self) -> Option<RingStamp> {
        match &self.0 {
            Held::Slot(hold) => hold.seal().stamp,
            Held::Shared { .. } => None,
        }
    }

    /// Returns the [`HEADROOM`] bytes and the sample as one slice.
    pub fn with_headroom(&self) -> &[u8] {
        match &self.0 {
            Held::Slot(hold) => hold.with_headroom(),
            Held::Shared { sample, .. } => sample.with_headroom(),
        }
    }
}

impl<M> Deref for Lease<M> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.with_headroom()[HEADROOM..]
    }
}

impl<M: Clone> Clone for Lease<M> {
    fn clone(&self) -> Self {
        Self(match &self.0 {
            Held::Slot(hold) => Held::Slot(hold.clone()),
            Held::Shared { sample, position, meta } => {
                Held::Shared { sample: sample.clone(), position: *position, meta: meta.clone() }
            }
        })
    }
}

impl<M> fmt::Debug for Lease<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Lease")
            .field("len", &self.len())
            .field("position", &self.position())
            .finish_non_exhaustive()
    }
}

struct SlotHold<M> {
    slots: Arc<Slots<M>>,
    index: u32,
}

impl<M> SlotHold<M> {
    fn with_headroom(&self) -> &[u8] {
        // SAFETY: `self` owns a hold until it is dropped.
        unsafe { self.slots.with_headroom(self.index) }
    }

    fn seal(&self) -> &Seal<M> {
        // SAFETY: `self` owns a hold until it is dropped.
        unsafe { self.slots.seal(self.index) }
    }
}

impl<M> Clone for SlotHold<M> {
    fn clone(&self) -> Self {
        // Relaxed: the hold of `self` keeps the slot as it is, and its view of it is passed on.
        let before = self.slots.slot(self.index).count.fetch_add(1, Ordering::Relaxed);
        if before >= MAX_HOLDS {
            process::abort();
        }
        Self { slots: Arc::clone(&self.slots), index: self.index }
    }
}

impl<M> Drop for SlotHold<M> {
    fn drop(&mut self) {
        // SAFETY: it owns one hold, which ends here.
        unsafe { self.slots.release(self.index) }
    }
}
