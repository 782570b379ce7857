//! The holds of a reader: hazard words in use, and the samples that they protect.
#![allow(unsafe_code)]

use std::ops::Deref;
use std::slice;

use super::control::{ControlMemory, HazardWindow, MappedControl, PinLimits, clear, set};
use super::layout::META_WORDS;
use super::reader::{FoundSample, ReadError, ReaderState};
use super::reader_fence;
use crate::HEADROOM;
use crate::sync::{Arc, AtomicU64, Mutex, MutexGuard};

/// The hazard words of this process for one topic.
pub(super) struct HoldTable {
    page: MappedControl,
    limits: PinLimits,
    /// For each word, in the order of the page.
    words: Mutex<Box<[WordUse]>>,
}

#[derive(Clone, Copy)]
struct WordUse {
    /// Number of holds that share the word; 0 if it is free.
    holds: u32,
    /// Positions that the word protects.
    window: HazardWindow,
}

impl WordUse {
    fn protects(&self, window: HazardWindow) -> bool {
        let end = |window: HazardWindow| window.first.saturating_add(window.count.into());
        self.holds > 0 && self.window.first <= window.first && end(window) <= end(self.window)
    }
}

impl HoldTable {
    /// A table without holds; `None` if the words are not on the page.
    pub(super) fn new(control: impl ControlMemory, limits: PinLimits) -> Option<Self> {
        let page = MappedControl::new(control);
        let words = limits.of_page(page.control())?;
        // Also maps their memory now, not at the first hold.
        words.iter().for_each(clear);
        let count = words.len();
        let free = WordUse { holds: 0, window: HazardWindow { first: 0, count: 0 } };
        Some(Self { page, limits, words: Mutex::new(vec![free; count].into()) })
    }

    /// Protects `count` positions from `first`, and returns the word; `None` if the first sample
    /// has left, which `is_shown` returns after the word is visible to the writer.
    pub(super) fn hold(
        &self,
        first: u64,
        count: u32,
        is_shown: impl FnOnce() -> bool,
    ) -> Result<Option<u32>, ReadError> {
        let window = HazardWindow { first, count };
        // Held until the check, so that another thread shares only a word that protects.
        let mut words = self.words();
        if let Some(word) = words.iter().position(|word| word.protects(window)) {
            // The slots are protected; the places could have been written again.
            reader_fence();
            if !is_shown() {
                return Ok(None);
            }
            words[word].holds += 1;
            return Ok(Some(word as u32));
        }
        // Words for single positions come last, and are taken first.
        let is_free = |(index, word): &(usize, &WordUse)| {
            word.holds == 0 && count <= self.limits.of_word(*index)
        };
        let free = words.iter().enumerate().rfind(is_free).map(|(index, _)| index);
        let word = free.ok_or(ReadError::OutOfHolds)?;
        let hazard = self.hazard(word);
        set(hazard, window);
        reader_fence();
        if !is_shown() {
            clear(hazard);
            return Ok(None);
        }
        words[word] = WordUse { holds: 1, window };
        Ok(Some(word as u32))
    }

    /// Returns the number of positions that one word protects at most.
    pub(super) fn largest(&self) -> usize {
        self.limits.largest()
    }

    /// Ends a hold; the last one of its word clears the hazard.
    fn release(&self, word: u32) {
        let mut words = self.words();
        let word = word as usize;
        words[word].holds -= 1;
        if words[word].holds == 0 {
            clear(self.hazard(word));
        }
    }

    fn words(&self) -> MutexGuard<'_, Box<[WordUse]>> {
        self.words.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn hazard(&self, word: usize) -> &AtomicU64 {
        &self.limits.of_page(self.page.control()).unwrap_or_default()[word]
    }
}

/// A hold on samples at neighbouring positions. Dropping it ends the protection.
pub(super) struct WindowHold {
    reader: Arc<ReaderState>,
    word: u32,
    samples: Box<[FoundSample]>,
}

impl WindowHold {
    /// Takes over the hold of `word`, which protects `samples`.
    pub(super) fn new(reader: Arc<ReaderState>, word: u32, samples: &[FoundSample]) -> Self {
        Self { reader, word, samples: samples.into() }
    }
}

impl Drop for WindowHold {
    fn drop(&mut self) {
        self.reader.holds.release(self.word);
    }
}

/// Samples at neighbouring positions, at least one. They are held by one hazard until the last of
/// them is dropped, or by one hazard each.
pub struct HeldWindow {
    samples: Vec<HeldSample>,
}

impl HeldWindow {
    /// The samples of a hold, at least one.
    pub(super) fn new(hold: WindowHold) -> Self {
        let hold = Arc::new(hold);
        let sample = |index| HeldSample { hold: Arc::clone(&hold), index: index as u32 };
        Self { samples: (0..hold.samples.len()).map(sample).collect() }
    }

    pub(super) fn concat(windows: Vec<Self>) -> Self {
        Self { samples: windows.into_iter().flat_map(Self::into_samples).collect() }
    }

    /// The samples, oldest first.
    pub fn into_samples(self) -> Vec<HeldSample> {
        self.samples
    }

    pub(super) fn newest(mut self) -> HeldSample {
        self.samples.pop().expect("a hold has samples")
    }
}

impl Deref for HeldWindow {
    type Target = [HeldSample];

    fn deref(&self) -> &[HeldSample] {
        &self.samples
    }
}

/// A sample that is held in place: its bytes do not change while a handle on it lives.
#[derive(Clone)]
pub struct HeldSample {
    hold: Arc<WindowHold>,
    index: u32,
}

impl HeldSample {
    pub fn position(&self) -> u64 {
        self.found().position
    }

    /// Words that the sample carries beside its bytes.
    pub fn meta(&self) -> &[u64; META_WORDS] {
        &self.found().meta
    }

    /// The [`HEADROOM`] bytes and the sample as one slice.
    pub fn with_headroom(&self) -> &[u8] {
        let memory = &self.hold.reader.memory;
        let FoundSample { slot, len, .. } = *self.found();
        memory.reads(slot);
        let payload = memory.payload(slot);
        // SAFETY: slot and length of a found sample are within the region. The writer leaves the
        // slot alone while the hazard of our hold names its position, and it filled the slot before
        // it stored the `seq` that the search loaded.
        unsafe { slice::from_raw_parts(payload.sub(HEADROOM).as_ptr(), HEADROOM + len as usize) }
    }

    fn found(&self) -> &FoundSample {
        &self.hold.samples[self.index as usize]
    }
}

impl Deref for HeldSample {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.with_headroom()[HEADROOM..]
    }
}
