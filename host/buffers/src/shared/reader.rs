//! The reading end of a topic: finds samples and holds them in place.
#![allow(unsafe_code)]

use std::ops::Deref;
use std::slice;

use super::control::{ControlMemory, HazardWindow, HoldLimits, MappedControl, clear, set};
use super::layout::{COUNTER_WORDS, META_WORDS, ReaderMemory, SharedMemory};
use super::reader_fence;
use crate::HEADROOM;
use crate::sync::{Arc, Mutex, MutexGuard, Ordering};

/// A reading end that cannot be used, or has no hold left.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReadError {
    /// All hazard words for so many positions are in use, also while another thread looks for a
    /// sample.
    OutOfHolds,
    /// The words are not on the control page.
    Hazards,
}

/// The reading end of a topic; clones read the same topic, each from any thread.
#[derive(Clone)]
pub struct SharedReader(Arc<ReaderState>);

struct ReaderState {
    memory: Arc<SharedMemory>,
    page: MappedControl,
    limits: HoldLimits,
    holds: Mutex<HoldTable>,
}

/// The holds of this process.
struct HoldTable {
    /// For each hazard word, in the order of the page.
    words: Box<[HazardUse]>,
}

#[derive(Clone, Copy, Default)]
struct HazardUse {
    /// Handles on its samples; 0 if the word is free.
    handles: u32,
}

/// A sample as its place describes it.
#[derive(Debug, Clone, Copy)]
struct FoundSample {
    position: u64,
    slot: u32,
    len: u32,
    meta: [u64; META_WORDS],
}

impl SharedReader {
    /// Creates a reader that holds positions through its control page, within `limits`.
    ///
    /// # Errors
    ///
    /// [`ReadError::Hazards`].
    ///
    /// # Safety
    ///
    /// Until the last [`HeldSample`] is dropped: the writer of this memory is a [`SharedWriter`],
    /// it has this page attached with limits that are at least these, and nothing else stores to
    /// these words of the page, for example another reader or a forked process. Otherwise the bytes
    /// of held samples may change.
    ///
    /// [`SharedWriter`]: super::SharedWriter
    pub unsafe fn new(
        memory: &ReaderMemory,
        control: impl ControlMemory,
        limits: HoldLimits,
    ) -> Result<Self, ReadError> {
        let page = MappedControl::new(control);
        let words = limits.of_page(page.control()).ok_or(ReadError::Hazards)?;
        let words = vec![HazardUse::default(); words.len()].into();
        let holds = Mutex::new(HoldTable { words });
        Ok(Self(Arc::new(ReaderState { memory: Arc::clone(&memory.0), page, limits, holds })))
    }

    /// Number of samples published so far: the position that the next one will have.
    pub fn head(&self) -> u64 {
        self.0.memory.header().head.load(Ordering::Acquire)
    }

    /// Number of samples that the topic shows at most.
    pub fn depth(&self) -> u32 {
        self.0.memory.layout().depth
    }

    /// Counters of the writer.
    pub fn counters(&self) -> [u64; COUNTER_WORDS] {
        let counters = &self.0.memory.header().counters;
        std::array::from_fn(|index| counters[index].load(Ordering::Relaxed))
    }

    /// Holds the sample at `position`; `None` if it is not shown (any more).
    ///
    /// # Errors
    ///
    /// [`ReadError::OutOfHolds`].
    pub fn get(&self, position: u64) -> Result<Option<HeldSample>, ReadError> {
        Ok(self.window(position, 1)?.and_then(|window| window.samples.into_iter().next()))
    }

    /// Holds the newest sample below position `end`; `None` if there was a moment during the
    /// call at which none was shown.
    ///
    /// # Errors
    ///
    /// [`ReadError::OutOfHolds`].
    pub fn newest_before(&self, end: u64) -> Result<Option<HeldSample>, ReadError> {
        Ok(self.last_before(end, 1)?.and_then(|window| window.samples.into_iter().next()))
    }

    /// Holds the samples at `count` positions from `first`, in place; `None` if the first of
    /// them is not shown (any more). Later ones that are not published yet are left out.
    ///
    /// # Errors
    ///
    /// [`ReadError::OutOfHolds`].
    pub fn window(&self, first: u64, count: u32) -> Result<Option<HeldWindow>, ReadError> {
        let end = first.saturating_add(count.min(self.depth()).into());
        let mut found = Vec::with_capacity((end - first) as usize);
        found.extend((first..end).map_while(|position| self.look(position)));
        if found.is_empty() {
            return Ok(None);
        }
        let word = self.0.reserve(found.len() as u32)?;
        let hazard = self.0.hazard(word);
        set(hazard, HazardWindow { first, count: found.len() as u32 });
        reader_fence();
        // Positions leave in order: the oldest one stands for all.
        let place = self.0.memory.place(first);
        // Acquire: if it left, the `head` that the writer raised before is visible.
        if place.seq.load(Ordering::Acquire) != first + 1 {
            clear(hazard);
            self.0.unreserve(word);
            return Ok(None);
        }
        let hold = |found: FoundSample| HeldSample { shared: Arc::clone(&self.0), word, found };
        Ok(Some(HeldWindow { samples: found.into_iter().map(hold).collect() }))
    }

    /// Holds the newest samples below position `end`, `count` of them or fewer, oldest first.
    ///
    /// # Errors
    ///
    /// [`ReadError::OutOfHolds`].
    pub fn last_before(&self, end: u64, count: u32) -> Result<Option<HeldWindow>, ReadError> {
        let mut head = self.head();
        loop {
            let end = head.min(end);
            let oldest = head.saturating_sub(u64::from(self.depth()));
            let first = end.saturating_sub(u64::from(count)).max(oldest);
            if first >= end {
                return Ok(None);
            }
            if let Some(window) = self.window(first, (end - first) as u32)? {
                return Ok(Some(window));
            }
            // Its oldest sample left, so `head` moved: the writer raised it before it took the
            // sample away.
            let now = self.head();
            if now == head {
                return Ok(None);
            }
            head = now;
        }
    }

    /// Reads the place of a position, if its sample is shown.
    fn look(&self, position: u64) -> Option<FoundSample> {
        let memory = &self.0.memory;
        let place = memory.place(position);
        if place.seq.load(Ordering::Acquire) != position + 1 {
            return None;
        }
        let slot = place.slot.load(Ordering::Relaxed);
        let (slot, len) = ((slot >> 32) as u32, slot as u32);
        let layout = memory.layout();
        if slot >= layout.slots || u64::from(len) > layout.slot_bytes {
            return None;
        }
        let meta = std::array::from_fn(|index| place.meta[index].load(Ordering::Relaxed));
        Some(FoundSample { position, slot, len, meta })
    }
}

impl ReaderState {
    fn holds(&self) -> MutexGuard<'_, HoldTable> {
        self.holds.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn hazard(&self, word: u16) -> &crate::sync::AtomicU64 {
        let words = self.limits.of_page(self.page.control()).unwrap_or_default();
        &words[usize::from(word)]
    }

    /// Reserves a hazard word for `count` positions, with a handle on each.
    fn reserve(&self, count: u32) -> Result<u16, ReadError> {
        let mut holds = self.holds();
        // Words for single positions come last, and are taken first.
        let is_free = |(index, word): &(usize, &HazardUse)| {
            word.handles == 0 && count <= self.limits.of_word(*index)
        };
        let free = holds.words.iter().enumerate().rfind(is_free);
        let (word, _) = free.ok_or(ReadError::OutOfHolds)?;
        holds.words[word] = HazardUse { handles: count };
        Ok(word as u16)
    }

    /// Gives back a word whose hazard is cleared.
    fn unreserve(&self, word: u16) {
        self.holds().words[usize::from(word)].handles = 0;
    }

    /// Adds a handle to a word that has one.
    fn share(&self, word: u16) {
        let handles = &mut self.holds().words[usize::from(word)].handles;
        *handles = handles.checked_add(1).expect("2^32 handles do not fit into memory");
    }

    /// Gives up one handle; the last one clears the hazard.
    fn release(&self, word: u16) {
        let mut holds = self.holds();
        let handles = &mut holds.words[usize::from(word)].handles;
        *handles -= 1;
        if *handles == 0 {
            clear(self.hazard(word));
        }
    }
}

/// Samples at neighbouring positions, held by one hazard until the last of them is dropped.
pub struct HeldWindow {
    samples: Vec<HeldSample>,
}

impl HeldWindow {
    /// The samples, oldest first.
    pub fn into_samples(self) -> Vec<HeldSample> {
        self.samples
    }
}

impl Deref for HeldWindow {
    type Target = [HeldSample];

    fn deref(&self) -> &[HeldSample] {
        &self.samples
    }
}

/// A sample that is held in place: its bytes do not change while a handle on it lives.
pub struct HeldSample {
    shared: Arc<ReaderState>,
    word: u16,
    found: FoundSample,
}

impl HeldSample {
    /// Position of the sample.
    pub fn position(&self) -> u64 {
        self.found.position
    }

    /// Words that the sample carries beside its bytes.
    pub fn meta(&self) -> &[u64; META_WORDS] {
        &self.found.meta
    }

    /// The [`HEADROOM`] bytes and the sample as one slice.
    pub fn with_headroom(&self) -> &[u8] {
        let memory = &self.shared.memory;
        memory.reads(self.found.slot);
        let payload = memory.payload(self.found.slot);
        let len = self.found.len as usize;
        // SAFETY: `look` checked slot and length. The writer leaves the
        // slot alone while our hazard names its position, and it filled the slot before it stored
        // the `seq` that `look` loaded.
        unsafe { slice::from_raw_parts(payload.sub(HEADROOM).as_ptr(), HEADROOM + len) }
    }
}

impl Deref for HeldSample {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.with_headroom()[HEADROOM..]
    }
}

impl Clone for HeldSample {
    fn clone(&self) -> Self {
        self.shared.share(self.word);
        Self { shared: Arc::clone(&self.shared), word: self.word, found: self.found }
    }
}

impl Drop for HeldSample {
    fn drop(&mut self) {
        self.shared.release(self.word);
    }
}
