//! The control page of a reader: its hazards and its bell.
//!
//! A "page" has room for more words than most readers are granted. Memory is used only for words
//! that are granted.
#![allow(unsafe_code)]

use std::ptr::NonNull;

use crate::sync::{Arc, AtomicU32, AtomicU64, Ordering};

#[cfg(not(loom))]
const _: () = assert!(size_of::<ControlPage>() == CONTROL_BYTES);

/// Bytes of a control page: enough for the largest manifest, 256 inputs of 1,032 words each.
///
/// An odd number of pages of memory: neighbours that are a multiple of 16 apart compete for the
/// same entries of a TLB, and a look at the hazards of 50 readers took a quarter longer.
#[cfg(not(loom))]
const CONTROL_BYTES: usize = 529 << 12;

#[cfg(not(loom))]
pub const HAZARDS: usize = (CONTROL_BYTES - 64) / 8;
/// A few of them in a model, which creates each of them in every order.
#[cfg(loom)]
pub const HAZARDS: usize = 4;

/// The words of a control page.
///
/// Its reader and the writer map it; the writer trusts none of it.
#[repr(C, align(64))]
pub struct ControlPage {
    /// Raised for each sample that wakes the reader.
    pub(super) bell: AtomicU32,
    /// Set while the reader waits for the bell.
    pub(super) waiting: AtomicU32,
    _padding: [AtomicU64; 7],
    /// First position in the upper 48 bits, number of positions in the lower 16; 0 names none.
    pub(super) hazards: [AtomicU64; HAZARDS],
}

/// The hazard words of one topic on a control page, and the positions that each may name.
///
/// Each word has a limit of its own, and their sum has none: the writer reads the words one after
/// another, so an old value of one and a new value of another may add up to more than the reader
/// held at any time. A limit of the sum would then ignore a word that is in use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PinLimits {
    /// The first word. Words for windows come first, then words for single positions.
    pub first_word: u32,
    /// Words that name a window.
    pub windows: u16,
    /// Positions that a window has at most.
    pub window: u16,
    /// Words that name a single position.
    pub singles: u16,
}

impl PinLimits {
    /// Returns the number of positions that a reader can hold.
    pub fn quota(&self) -> u32 {
        u32::from(self.windows) * u32::from(self.window) + u32::from(self.singles)
    }

    pub(super) fn words(&self) -> usize {
        usize::from(self.windows) + usize::from(self.singles)
    }

    /// Returns the number of positions that word `index` of the topic may name.
    pub(super) fn of_word(&self, index: usize) -> u32 {
        if index < usize::from(self.windows) { self.window.into() } else { 1 }
    }

    /// Returns the number of positions that a word may name at most; 1 without words for windows.
    pub(super) fn largest(&self) -> usize {
        if self.windows == 0 { 1 } else { self.window.max(1).into() }
    }

    /// Returns the words of the topic; `None` if there are none, or the page lacks some.
    pub(super) fn of_page<'a>(&self, page: &'a ControlPage) -> Option<&'a [AtomicU64]> {
        let first = self.first_word as usize;
        let end = first.checked_add(self.words())?;
        page.hazards.get(first..end).filter(|words| !words.is_empty())
    }
}

impl ControlPage {
    /// A page without hazards, on the heap: it is too large for the stack of a thread.
    #[cfg(not(loom))]
    pub fn on_heap() -> Arc<Self> {
        // SAFETY: all fields are atomic numbers, for which zeros are a value.
        unsafe { Arc::new_zeroed().assume_init() }
    }

    /// A page without hazards.
    #[cfg(loom)]
    pub fn on_heap() -> Arc<Self> {
        Arc::new(Self {
            bell: AtomicU32::new(0),
            waiting: AtomicU32::new(0),
            _padding: std::array::from_fn(|_| AtomicU64::new(0)),
            hazards: std::array::from_fn(|_| AtomicU64::new(0)),
        })
    }
}

/// A mapped control page.
///
/// # Safety
///
/// For as long as the value lives, [`page`](Self::page) returns the same address, which points to
/// a mapped page of this type, aligned to a cache line, that is valid for atomic reads and writes
/// from any thread. Other processes may write it.
pub unsafe trait ControlMemory: Send + Sync + 'static {
    fn page(&self) -> NonNull<ControlPage>;

    /// Stores `value` in a hazard word, as every process that maps the page can.
    ///
    /// # Panics
    ///
    /// If the page has no such word.
    ///
    /// # Safety
    ///
    /// No [`HeldSample`](super::HeldSample) of this page is used any more.
    unsafe fn overwrite(&self, word: usize, value: u64) {
        // SAFETY: the promise of the trait; hazards are atomics.
        unsafe { self.page().as_ref() }.hazards[word].store(value, Ordering::Relaxed);
    }
}

// SAFETY: a boxed page stays where it is.
unsafe impl ControlMemory for Arc<ControlPage> {
    fn page(&self) -> NonNull<ControlPage> {
        NonNull::from(&**self)
    }
}

pub(super) struct MappedControl(Box<dyn ControlMemory>);

impl MappedControl {
    pub(super) fn new(memory: impl ControlMemory) -> Self {
        Self(Box::new(memory))
    }

    pub(super) fn control(&self) -> &ControlPage {
        // SAFETY: the promise of `ControlMemory`; all fields that change are atomics.
        unsafe { self.0.page().as_ref() }
    }
}

/// A hazard word: positions from `first`, `count` of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct HazardWindow {
    pub(super) first: u64,
    pub(super) count: u32,
}

impl HazardWindow {
    pub(super) fn word(self) -> u64 {
        self.first << 16 | u64::from(self.count)
    }

    pub(super) fn of(word: u64) -> Self {
        Self { first: word >> 16, count: (word & 0xffff) as u32 }
    }
}

/// Stores a hazard. Release: it may replace another one, whose sample was read before.
pub(super) fn set(hazard: &AtomicU64, window: HazardWindow) {
    hazard.store(window.word(), Ordering::Release);
}

/// Clears a hazard. Release: the sample was read before.
pub(super) fn clear(hazard: &AtomicU64) {
    hazard.store(0, Ordering::Release);
}
