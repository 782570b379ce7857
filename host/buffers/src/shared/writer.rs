//! The writing end of a topic: fills slots that no reader holds, and shows the newest samples.
#![allow(unsafe_code)]

use std::collections::{BTreeMap, VecDeque};
use std::ops::{Deref, DerefMut};
use std::slice;

use super::control::{ControlMemory, HazardWindow, MappedControl, PinLimits};
use super::layout::{COUNTER_WORDS, META_WORDS, SharedMemory, WriterMemory};
use super::writer_fence;
use crate::HEADROOM;
use crate::sync::Ordering;

/// A sample or a reader that the topic has no room for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WriteError {
    TooBig {
        len: usize,
        max: usize,
    },
    /// The quotas of all readers would exceed the slots that are not warm.
    Quota {
        asked: u32,
        left: u32,
    },
    /// The words are not on the control page.
    Hazards,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReaderId(u64);

/// The writing end of a topic.
pub struct SharedWriter {
    memory: SharedMemory,
    head: u64,
    /// Position and slot of each sample that is shown or left since the last look at the hazards,
    /// in order of positions.
    filled: VecDeque<(u64, u32)>,
    /// Slots by the positions of earlier samples that were held at the last look, or not needed.
    left: BTreeMap<u64, u32>,
    /// Slots whose sample, if they had one, is neither shown nor held, and will not be: no position
    /// is in them.
    free: Vec<u32>,
    /// The first slot that was never used; all after it were not, either.
    untouched: u32,
    /// Number of slots to use before one is used again.
    warm: u32,
    pending: Option<Pending>,
    /// Positions that readers hold, from the first to before the second; computed by each look at
    /// the hazards.
    held: Vec<(u64, u64)>,
    readers: Vec<AttachedReader>,
    next_reader: u64,
}

struct AttachedReader {
    id: ReaderId,
    page: MappedControl,
    limits: PinLimits,
}

/// The slot of the next sample, until it is published.
#[derive(Debug, Clone, Copy)]
struct Pending {
    slot: u32,
    len: usize,
}

/// The bytes of the next sample.
///
/// They are those of an earlier one: write all of them, or [`truncate`](Self::truncate).
pub struct SharedDraft<'a>(&'a mut SharedWriter);

impl SharedWriter {
    /// A writer of an empty topic.
    pub fn new(memory: WriterMemory) -> Self {
        Self::with_warm_slots(memory, 0)
    }

    /// A writer of an empty topic that uses `warm` slots, or one more than are shown, before it
    /// uses one again.
    ///
    /// Readers that hold `n` samples make it use up to `n` slots more; memory beyond these is not
    /// touched. With `s` warm slots more than are shown, the hazards are read once in `s` drafts,
    /// whatever readers write there.
    pub fn with_warm_slots(WriterMemory(memory): WriterMemory, warm: u32) -> Self {
        let slots = memory.layout().slots;
        Self {
            head: 0,
            filled: VecDeque::with_capacity(slots as usize),
            left: BTreeMap::new(),
            free: Vec::with_capacity(slots as usize),
            untouched: 0,
            warm: warm.max(memory.layout().depth + 1).min(slots),
            held: Vec::new(),
            pending: None,
            readers: Vec::new(),
            next_reader: 0,
            memory,
        }
    }

    /// Lets a reader hold positions through its control page, within `limits`.
    ///
    /// # Errors
    ///
    /// [`WriteError::Quota`] and [`WriteError::Hazards`].
    pub fn attach(
        &mut self,
        control: impl ControlMemory,
        limits: PinLimits,
    ) -> Result<ReaderId, WriteError> {
        let page = MappedControl::new(control);
        let words = limits.of_page(page.control()).ok_or(WriteError::Hazards)?;
        // The kernel adds their memory now, not while a sample is written.
        for word in words {
            let _ = word.load(Ordering::Relaxed);
        }
        let given: u32 = self.readers.iter().map(|reader| reader.limits.quota()).sum();
        let left = (self.memory.layout().slots - self.warm).saturating_sub(given);
        let asked = limits.quota();
        if asked > left {
            return Err(WriteError::Quota { asked, left });
        }
        let id = ReaderId(self.next_reader);
        self.next_reader += 1;
        self.readers.push(AttachedReader { id, page, limits });
        Ok(id)
    }

    /// Forgets a reader: the slots that it held may be written again. Call it once the reader has
    /// ended: if it still reads, it sees other bytes.
    pub fn detach(&mut self, id: ReaderId) {
        self.readers.retain(|reader| reader.id != id);
    }

    /// Returns the bytes of the next sample, `len` of them. A draft that was not published is
    /// discarded.
    ///
    /// # Errors
    ///
    /// [`WriteError::TooBig`]. There is always a free slot.
    pub fn draft(&mut self, len: usize) -> Result<SharedDraft<'_>, WriteError> {
        self.discard();
        let max = self.memory.layout().slot_bytes as usize;
        if len > max {
            return Err(WriteError::TooBig { len, max });
        }
        let slot = self.take();
        self.memory.writes(slot);
        self.pending = Some(Pending { slot, len });
        let mut draft = SharedDraft(self);
        draft.headroom_mut().fill(0);
        Ok(draft)
    }

    /// Takes a slot that is neither shown nor held.
    fn take(&mut self) -> u32 {
        // Also where no hazard is read: the place of the next sample was that of an earlier one.
        writer_fence();
        if self.free.is_empty() && self.untouched >= self.warm {
            self.reclaim();
        }
        self.free.pop().unwrap_or_else(|| self.touch().expect("more slots than are shown and held"))
    }

    /// Takes a slot that was never used; `None` if all were.
    fn touch(&mut self) -> Option<u32> {
        let slot = self.untouched;
        (slot < self.memory.layout().slots).then(|| {
            self.untouched += 1;
            slot
        })
    }

    /// Frees slots whose samples no hazard names, oldest first, until as many are free as there are
    /// warm ones beyond the shown ones. Where too many are held, slots that were never used make up
    /// for them.
    ///
    /// Whatever a reader writes, the next drafts need no further look, and the time of a look
    /// depends on the number of words, but hardly on the number of positions that they name.
    ///
    /// Slots stay free until they are used again: a sample that was not shown before the fence of
    /// this draft cannot be held by a later hazard, as its reader checks that after its own fence.
    fn reclaim(&mut self) {
        let depth = self.memory.layout().depth;
        let wanted = (self.warm - depth) as usize;
        let shown_from = self.head.saturating_sub(depth.into());
        let leaving = self.filled.partition_point(|(position, _)| *position < shown_from);
        self.left.extend(self.filled.drain(..leaving));
        self.held.clear();
        for reader in &self.readers {
            let words = reader.limits.of_page(reader.page.control()).unwrap_or_default();
            for (index, word) in words.iter().enumerate() {
                // Once: a second load could see another value.
                let window = HazardWindow::of(word.load(Ordering::Acquire));
                let count = window.count.min(reader.limits.of_word(index));
                if count > 0 && window.first < shown_from {
                    self.held.push((window.first, window.first + u64::from(count)));
                }
            }
        }
        self.held.sort_unstable();
        // Stands for all that is shown.
        self.held.push((shown_from, u64::MAX));
        let mut from = 0;
        for (first, end) in &self.held {
            if from < *first && self.free.len() < wanted {
                let gap = self.left.extract_if(from..*first, |_, _| true);
                self.free.extend(gap.map(|(_, slot)| slot).take(wanted - self.free.len()));
            }
            from = from.max(*end);
        }
        while self.free.len() < wanted
            && let Some(slot) = self.touch()
        {
            self.free.push(slot);
        }
    }

    /// Gives up a draft that was not published.
    pub fn discard(&mut self) {
        self.free.extend(self.pending.take().map(|pending| pending.slot));
    }

    /// Shows the drafted sample to the readers, and returns its position: 0, 1, 2, ...
    ///
    /// Returns `None` if there is no draft.
    pub fn publish(&mut self, meta: &[u64; META_WORDS]) -> Option<u64> {
        let draft = self.pending.take()?;
        let position = self.head;
        let place = self.memory.place(position);
        let slot = u64::from(draft.slot) << 32 | draft.len as u64;
        place.slot.store(slot, Ordering::Relaxed);
        for (word, value) in place.meta.iter().zip(meta) {
            word.store(*value, Ordering::Relaxed);
        }
        place.seq.store(position + 1, Ordering::Release);
        self.filled.push_back((position, draft.slot));
        self.head = position + 1;
        let header = self.memory.header();
        header.head.store(self.head, Ordering::Release);
        if let Some(leaving) = position.checked_sub(u64::from(self.memory.layout().depth)) {
            // The next draft's fence comes after it. Release: a reader that sees the 0 also sees
            // the `head` above, so it knows that a newer sample is shown.
            self.memory.place(leaving).seq.store(0, Ordering::Release);
        }
        Some(position)
    }

    /// Returns the bytes of the draft, if there is one.
    pub fn drafted(&self) -> Option<&[u8]> {
        let Pending { slot, len } = self.pending?;
        let payload = self.memory.payload(slot);
        // SAFETY: a slot has `slot_bytes >= len` bytes, and only this writer writes to it.
        Some(unsafe { slice::from_raw_parts(payload.as_ptr(), len) })
    }

    /// Returns the bytes and the words of the sample at `position`, if it is shown.
    pub fn shown(&self, position: u64) -> Option<(&[u8], [u64; META_WORDS])> {
        let depth = u64::from(self.memory.layout().depth);
        if position >= self.head || position < self.head.saturating_sub(depth) {
            return None;
        }
        let place = self.memory.place(position);
        let slot = place.slot.load(Ordering::Relaxed);
        let payload = self.memory.payload((slot >> 32) as u32);
        let len = slot as u32 as usize;
        // SAFETY: `publish` stored slot and length of a draft; its slot is not written while the
        // sample is shown, and only this writer writes to it.
        let bytes = unsafe { slice::from_raw_parts(payload.as_ptr(), len) };
        Some((bytes, std::array::from_fn(|index| place.meta[index].load(Ordering::Relaxed))))
    }

    /// Stores counters for the readers to show.
    pub fn set_counters(&self, counters: &[u64; COUNTER_WORDS]) {
        for (word, value) in self.memory.header().counters.iter().zip(counters) {
            word.store(*value, Ordering::Relaxed);
        }
    }

    /// Number of samples published.
    pub fn head(&self) -> u64 {
        self.head
    }
}

impl SharedDraft<'_> {
    /// Keeps the first `len` bytes; does nothing if there are no more.
    pub fn truncate(&mut self, len: usize) {
        let pending = self.pending_mut();
        pending.len = pending.len.min(len);
    }

    /// Returns the bytes in front of the sample; 0 in a new draft.
    pub fn headroom_mut(&mut self) -> &mut [u8; HEADROOM] {
        let payload = self.0.memory.payload(self.pending().slot);
        // SAFETY: the headroom lies in front of each payload and belongs to its slot, which no
        // reader holds, and the writer is borrowed mutably.
        unsafe { payload.sub(HEADROOM).cast().as_mut() }
    }

    fn pending(&self) -> Pending {
        self.0.pending.expect("a draft borrows a writer that has one")
    }

    fn pending_mut(&mut self) -> &mut Pending {
        self.0.pending.as_mut().expect("a draft borrows a writer that has one")
    }
}

impl Deref for SharedDraft<'_> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        let Pending { slot, len } = self.pending();
        let payload = self.0.memory.payload(slot);
        // SAFETY: a slot has `slot_bytes >= len` bytes, and only the borrowed writer writes to it.
        unsafe { slice::from_raw_parts(payload.as_ptr(), len) }
    }
}

impl DerefMut for SharedDraft<'_> {
    fn deref_mut(&mut self) -> &mut [u8] {
        let Pending { slot, len } = self.pending();
        let payload = self.0.memory.payload(slot);
        // SAFETY: as in `deref`, and the draft is borrowed mutably.
        unsafe { slice::from_raw_parts_mut(payload.as_ptr(), len) }
    }
}
