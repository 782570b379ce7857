//! The layout of a topic's region, and access to its words and slots.
#![allow(unsafe_code)]

use std::ptr::NonNull;

use crate::sync::AtomicU64;
use crate::{HEADROOM, HeapRegion, PoolError, Region};

/// Words of meta data that a sample carries beside its bytes.
#[cfg(not(loom))]
pub const META_WORDS: usize = 12;
/// One of them in a model, whose orders grow with each word.
#[cfg(loom)]
pub const META_WORDS: usize = 1;

pub(super) const COUNTER_WORDS: usize = 8;

/// Alignment of each payload: a cache line, and any vector type.
const LINE: usize = 64;

/// Smallest page of the supported platforms.
const PAGE: usize = 4096;

/// Sizes of a topic's region.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SharedLayout {
    /// Samples that the topic shows at most.
    pub depth: u32,
    pub slots: u32,
    /// Bytes of the largest sample.
    pub slot_bytes: u64,
}

impl SharedLayout {
    /// Size of the region in bytes; `None` if a number is 0 or no region can be that large.
    pub fn bytes_needed(&self) -> Option<usize> {
        // A place has 32 bits for the length of a sample.
        let is_small = self.slot_bytes <= u64::from(u32::MAX);
        if self.depth == 0 || self.slots <= self.depth || self.slots > 0x7fff_ffff || !is_small {
            return None;
        }
        let slots = self.stride()?.checked_mul(self.slots as usize)?.checked_add(LINE)?;
        let bytes = self.slots_at()?.checked_add(slots)?;
        (bytes <= isize::MAX as usize).then_some(bytes)
    }

    /// Bytes from the start of the region to the end of slot `slots - 1`, or to the end of the
    /// region if it has fewer.
    pub fn bytes_of_first(&self, slots: u32) -> usize {
        let all = self.bytes_needed().unwrap_or(0);
        let part = |slots| self.slots_at()?.checked_add(self.stride()?.checked_mul(slots)?);
        part(slots as usize).and_then(|bytes| bytes.checked_add(LINE)).unwrap_or(all).min(all)
    }

    /// Offset of the first slot's line.
    fn slots_at(&self) -> Option<usize> {
        let places = size_of::<PlaceWords>().checked_mul(self.places())?;
        size_of::<HeaderWords>().checked_add(places)?.checked_next_multiple_of(PAGE)
    }

    fn stride(&self) -> Option<usize> {
        let bytes = usize::try_from(self.slot_bytes).ok()?;
        bytes.checked_add(HEADROOM)?.checked_next_multiple_of(LINE)
    }

    /// Places: one more than are shown, so that the newest sample is shown before the oldest
    /// leaves.
    pub(super) fn places(&self) -> usize {
        self.depth as usize + 1
    }
}

#[repr(C, align(64))]
pub(super) struct HeaderWords {
    /// Number of samples published.
    pub(super) head: AtomicU64,
    /// Counters of the writer, such as samples that were lost upstream.
    pub(super) counters: [AtomicU64; COUNTER_WORDS],
}

/// One of the newest samples.
#[repr(C, align(64))]
pub(super) struct PlaceWords {
    /// Position + 1 while the sample is shown, else 0.
    pub(super) seq: AtomicU64,
    /// Slot in the upper 32 bits, length in bytes in the lower 32.
    pub(super) slot: AtomicU64,
    pub(super) meta: [AtomicU64; META_WORDS],
}

/// Memory that is mapped for reading only.
///
/// # Safety
///
/// For as long as the value lives, wherever it is moved: both methods give the same answer each
/// time, and the `len` bytes from `base` are initialised and valid for reads from any thread.
/// Another process may write them.
#[expect(clippy::len_without_is_empty, reason = "a reader asks only whether it is large enough")]
pub unsafe trait ReadRegion: Send + Sync + 'static {
    /// Its first byte.
    fn base(&self) -> NonNull<u8>;
    /// Its size in bytes.
    fn len(&self) -> usize;
}

/// Memory of a topic for its one writer.
pub struct WriterMemory(pub(super) SharedMemory);

/// Memory of a topic for readers; clones are the same mapping.
#[derive(Clone)]
pub struct ReaderMemory(pub(super) crate::sync::Arc<SharedMemory>);

impl WriterMemory {
    /// Returns the memory of a writer; `None` if the region is too small, not aligned to a page, or
    /// the layout impossible.
    pub fn new(region: impl Region, layout: SharedLayout) -> Option<Self> {
        let region = Box::new(region);
        let (base, len) = (region.base(), region.len());
        SharedMemory::over(region, base, len, layout).map(Self)
    }
}

impl ReaderMemory {
    pub fn new(region: impl ReadRegion, layout: SharedLayout) -> Option<Self> {
        let region = Box::new(region);
        let (base, len) = (region.base(), region.len());
        let memory = SharedMemory::over(region, base, len, layout)?;
        Some(Self(crate::sync::Arc::new(memory)))
    }
}

/// Returns memory of a writer and of readers in the same process, over the heap.
///
/// # Errors
///
/// [`PoolError::OutOfMemory`] if the allocator refuses, or the layout is impossible.
pub fn in_process(layout: SharedLayout) -> Result<(WriterMemory, ReaderMemory), PoolError> {
    let bytes = layout.bytes_needed().unwrap_or(usize::MAX);
    let region = crate::sync::Arc::new(HeapRegion::zeroed(bytes)?);
    let (base, len) = (region.base(), region.len());
    let refused = PoolError::OutOfMemory { bytes };
    let over = || SharedMemory::over(Box::new(region.clone()), base, len, layout).ok_or(refused);
    let (writing, reading) = (over()?, over()?);
    #[cfg(loom)]
    let reading = SharedMemory { model: crate::sync::Arc::clone(&writing.model), ..reading };
    Ok((WriterMemory(writing), ReaderMemory(crate::sync::Arc::new(reading))))
}

pub(super) struct SharedMemory {
    layout: SharedLayout,
    stride: usize,
    #[cfg_attr(loom, allow(dead_code))]
    base: NonNull<u8>,
    first: NonNull<u8>,
    #[cfg(loom)]
    model: crate::sync::Arc<ModelMemory>,
    _region: Box<dyn std::any::Any + Send + Sync>,
}

/// Content of the region, for loom, whose atomics have no place in raw memory.
#[cfg(loom)]
struct ModelMemory {
    header: HeaderWords,
    places: Box<[PlaceWords]>,
    /// Reports the accesses to each slot.
    accesses: Box<[crate::sync::UnsafeCell<()>]>,
}

// SAFETY: `base` and `first` point into the region, which is Send and Sync; words are atomics, and
// access to payloads follows the rules of the module.
unsafe impl Send for SharedMemory {}
// SAFETY: as above.
unsafe impl Sync for SharedMemory {}

impl SharedMemory {
    fn over(
        region: Box<dyn std::any::Any + Send + Sync>,
        base: NonNull<u8>,
        len: usize,
        layout: SharedLayout,
    ) -> Option<Self> {
        let needed = layout.bytes_needed()?;
        if len < needed || !(base.as_ptr() as usize).is_multiple_of(PAGE) {
            return None;
        }
        Some(Self {
            stride: layout.stride()?,
            // SAFETY: the region has `needed` bytes, which include the first slot's line.
            first: unsafe { base.add(layout.slots_at()? + LINE) },
            layout,
            base,
            #[cfg(loom)]
            model: crate::sync::Arc::new(ModelMemory::new(&layout)),
            _region: region,
        })
    }

    pub(super) fn layout(&self) -> &SharedLayout {
        &self.layout
    }

    #[cfg(not(loom))]
    pub(super) fn header(&self) -> &HeaderWords {
        // SAFETY: the region begins with a header, is aligned to a page, and consists of
        // initialised bytes; the header's fields are atomics.
        unsafe { self.base.cast().as_ref() }
    }

    #[cfg(loom)]
    pub(super) fn header(&self) -> &HeaderWords {
        &self.model.header
    }

    #[cfg(not(loom))]
    pub(super) fn place(&self, position: u64) -> &PlaceWords {
        let index = (position % self.layout.places() as u64) as usize;
        // SAFETY: `places` of them follow the header, `index` is below that, and their fields are
        // atomics.
        unsafe { self.base.add(size_of::<HeaderWords>()).cast::<PlaceWords>().add(index).as_ref() }
    }

    #[cfg(loom)]
    pub(super) fn place(&self, position: u64) -> &PlaceWords {
        &self.model.places[(position % self.layout.places() as u64) as usize]
    }

    /// First payload byte of a slot below `slots`; the headroom lies before it.
    pub(super) fn payload(&self, slot: u32) -> NonNull<u8> {
        assert!(slot < self.layout.slots);
        // SAFETY: `over` checked that `slots` strides follow `first`.
        unsafe { self.first.add(slot as usize * self.stride) }
    }

    /// Reports to the model that a slot is read now.
    pub(super) fn reads(&self, slot: u32) {
        #[cfg(loom)]
        self.model.accesses[slot as usize].with(|_| ());
        let _ = slot;
    }

    /// Reports to the model that a slot is written now.
    pub(super) fn writes(&self, slot: u32) {
        #[cfg(loom)]
        self.model.accesses[slot as usize].with_mut(|_| ());
        let _ = slot;
    }
}

#[cfg(loom)]
impl ModelMemory {
    fn new(layout: &SharedLayout) -> Self {
        let word = |_| AtomicU64::new(0);
        let place = |_| PlaceWords {
            seq: AtomicU64::new(0),
            slot: AtomicU64::new(0),
            meta: std::array::from_fn(word),
        };
        Self {
            header: HeaderWords { head: AtomicU64::new(0), counters: std::array::from_fn(word) },
            places: (0..layout.places()).map(place).collect(),
            accesses: (0..layout.slots).map(|_| crate::sync::UnsafeCell::new(())).collect(),
        }
    }
}
