//! The reading end of a topic: finds samples, and holds them in place.
#![allow(unsafe_code)]

use super::control::{ControlMemory, PinLimits};
use super::hold::{HoldTable, WindowHold};
use super::layout::{COUNTER_WORDS, META_WORDS, ReaderMemory, SharedMemory};
use super::{HeldSample, HeldWindow};
use crate::sync::{Arc, Ordering, fence};

/// Attempts to find samples while the writer publishes: far more than an honest writer can
/// interrupt.
const ATTEMPTS: u32 = 1000;

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
///
/// Samples that are held already take no further word: their holds are shared.
#[derive(Clone)]
pub struct SharedReader(Arc<ReaderState>);

pub(super) struct ReaderState {
    pub(super) memory: Arc<SharedMemory>,
    pub(super) holds: HoldTable,
}

/// A sample as its place describes it. Slot and length are within the region.
#[derive(Debug, Clone, Copy)]
pub(super) struct FoundSample {
    pub(super) position: u64,
    pub(super) slot: u32,
    pub(super) len: u32,
    pub(super) meta: [u64; META_WORDS],
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
        limits: PinLimits,
    ) -> Result<Self, ReadError> {
        let holds = HoldTable::new(control, limits).ok_or(ReadError::Hazards)?;
        Ok(Self(Arc::new(ReaderState { memory: Arc::clone(&memory.0), holds })))
    }

    /// Number of samples published so far: the position that the next one will have.
    pub fn head(&self) -> u64 {
        self.0.memory.header().head.load(Ordering::Acquire)
    }

    /// Number of samples that the topic shows at most.
    pub fn depth(&self) -> u32 {
        self.0.memory.layout().depth
    }

    pub fn counters(&self) -> [u64; COUNTER_WORDS] {
        let counters = &self.0.memory.header().counters;
        std::array::from_fn(|index| counters[index].load(Ordering::Relaxed))
    }

    /// Meta data of the sample at `position`, without a hold; `None` if it is not shown (any more).
    pub fn meta(&self, position: u64) -> Option<[u64; META_WORDS]> {
        let found = self.look(position)?;
        // Acquire: a word of a later sample was stored after `seq` was cleared (rule 5).
        fence(Ordering::Acquire);
        self.is_shown(position).then_some(found.meta)
    }

    /// Position and meta data of the newest sample, without a hold; `None` before the first one.
    pub fn newest_meta(&self) -> Option<(u64, [u64; META_WORDS])> {
        let mut head = self.head();
        for _ in 0..ATTEMPTS {
            let position = head.checked_sub(1)?;
            if let Some(meta) = self.meta(position) {
                return Some((position, meta));
            }
            // It left, so `head` moved.
            let now = self.head();
            if now == head {
                return None;
            }
            head = now;
        }
        None
    }

    /// Holds the sample at `position`; `None` if it is not shown (any more).
    /// Fails only with [`ReadError::OutOfHolds`].
    pub fn get(&self, position: u64) -> Result<Option<HeldSample>, ReadError> {
        Ok(self.window(position, 1)?.map(|window| window.newest()))
    }

    /// Holds the newest sample below position `end`; `None` if there was a moment during the
    /// call at which none was shown. Fails only with [`ReadError::OutOfHolds`].
    pub fn newest_before(&self, end: u64) -> Result<Option<HeldSample>, ReadError> {
        Ok(self.last_before(end, 1)?.map(|window| window.newest()))
    }

    /// Holds the samples at `count` positions from `first`, in place; `None` if the first of
    /// them is not shown (any more). Later ones that are not published yet are left out.
    /// Fails only with [`ReadError::OutOfHolds`].
    pub fn window(&self, first: u64, count: u32) -> Result<Option<HeldWindow>, ReadError> {
        // No reader sees a sample before the others do, so that all have it if the writer dies.
        let end = first.saturating_add(count.min(self.depth()).into()).min(self.head());
        let found: Vec<_> = (first..end).map_while(|position| self.look(position)).collect();
        self.hold(&found)
    }

    /// Holds the newest samples below position `end`, `count` of them or fewer, oldest first.
    ///
    /// Samples that leave during the call may be missing, but not the newest one. Fails only
    /// with [`ReadError::OutOfHolds`].
    pub fn last_before(&self, end: u64, count: u32) -> Result<Option<HeldWindow>, ReadError> {
        self.newest_while(end, count, |_| true)
    }

    /// Holds the newest samples below position `end`, at most `max`, back to the first one whose
    /// meta data `keep` refuses; oldest first. `keep` is called newest first, and more than once
    /// for a sample if samples leave during the call. Fails only with [`ReadError::OutOfHolds`].
    pub fn newest_while(
        &self,
        end: u64,
        max: u32,
        mut keep: impl FnMut(&[u64; META_WORDS]) -> bool,
    ) -> Result<Option<HeldWindow>, ReadError> {
        let mut head = self.head();
        for _ in 0..ATTEMPTS {
            let end = head.min(end);
            let oldest = head.saturating_sub(self.depth().into());
            let oldest = end.saturating_sub(max.into()).max(oldest);
            let mut refused = false;
            let mut found: Vec<FoundSample> = Vec::new();
            for position in (oldest..end).rev() {
                let Some(sample) = self.look(position) else { break };
                refused = !keep(&sample.meta);
                if refused {
                    break;
                }
                found.push(sample);
            }
            if oldest >= end || refused && found.is_empty() {
                return Ok(None);
            }
            found.reverse();
            if let Some(window) = self.hold(&found)? {
                return Ok(Some(window));
            }
            // A sample left, so `head` moved: the writer raised it before it took the sample away.
            let now = self.head();
            if now == head {
                return Ok(None);
            }
            head = now;
        }
        Ok(None)
    }

    /// Holds samples at neighbouring positions, oldest first; `None` if there is none, or one has
    /// left.
    fn hold(&self, found: &[FoundSample]) -> Result<Option<HeldWindow>, ReadError> {
        match self.hold_by_one_word(found) {
            // More than one word can name take several, and words for single samples may be left.
            Err(ReadError::OutOfHolds) if found.len() > 1 => {
                let largest = self.0.holds.largest();
                let part = if found.len() > largest { largest } else { 1 };
                let parts = found.chunks(part).map(|part| self.hold(part).transpose());
                let held: Option<Result<Vec<_>, _>> = parts.collect();
                Ok(held.transpose()?.map(HeldWindow::concat))
            }
            held => held,
        }
    }

    fn hold_by_one_word(&self, found: &[FoundSample]) -> Result<Option<HeldWindow>, ReadError> {
        let Some(oldest) = found.first().map(|oldest| oldest.position) else { return Ok(None) };
        // Positions leave in order: the oldest one stands for all.
        let is_shown = || self.is_shown(oldest);
        let word = self.0.holds.hold(oldest, found.len() as u32, is_shown)?;
        Ok(word.map(|word| HeldWindow::new(WindowHold::new(Arc::clone(&self.0), word, found))))
    }

    /// Returns whether the sample at `position` is shown. Acquire: if it left, the `head` that the
    /// writer raised before is visible.
    fn is_shown(&self, position: u64) -> bool {
        let place = self.0.memory.place(position);
        position.checked_add(1) == Some(place.seq.load(Ordering::Acquire))
    }

    /// Reads the place of a position, if its sample is shown and lies in the region.
    fn look(&self, position: u64) -> Option<FoundSample> {
        if !self.is_shown(position) {
            return None;
        }
        let memory = &self.0.memory;
        let place = memory.place(position);
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

#[cfg(all(test, not(loom)))]
mod tests {
    use super::*;
    use crate::shared::{ControlPage, SharedLayout, SharedWriter, in_process};

    fn topic() -> (SharedWriter, SharedReader) {
        let layout = SharedLayout { depth: 4, slots: 16, slot_bytes: 64 };
        let (memory, reading) = in_process(layout).unwrap();
        let (mut writer, control) = (SharedWriter::new(memory), ControlPage::on_heap());
        let limits = PinLimits { first_word: 0, windows: 2, window: 4, singles: 2 };
        writer.attach(control.clone(), limits).unwrap();
        // SAFETY: the page is attached with these limits, and nothing else stores to it.
        let reader = unsafe { SharedReader::new(&reading, control, limits) }.unwrap();
        for value in 0..6 {
            writer.draft(8).unwrap().fill(value);
            writer.publish(&[value.into(); META_WORDS]).unwrap();
        }
        (writer, reader)
    }

    /// Reads in every way; no number that the writer stored may end the process or the search.
    fn read_all(reader: &SharedReader) -> usize {
        let mut found = 0;
        for position in [0, 1, 5, 6, 1 << 48, u64::MAX - 1, u64::MAX] {
            found += usize::from(reader.meta(position).is_some());
            found += reader.get(position).unwrap().map_or(0, |held| held.len());
            for end in [position, u64::MAX] {
                found += reader.newest_before(end).unwrap().map_or(0, |held| held.len());
                let windows = [reader.window(position, 4), reader.last_before(end, u32::MAX)];
                found += windows.map(|window| window.unwrap().map_or(0, |held| held.len()))[0];
            }
        }
        found
    }

    #[test]
    fn a_slot_or_length_outside_of_the_region_is_no_sample() {
        let (_writer, reader) = topic();
        let place = reader.0.memory.place(5);
        for slot in [16_u64 << 32 | 8, u64::from(u32::MAX) << 32, 65, u64::MAX] {
            place.slot.store(slot, Ordering::Relaxed);
            assert!(reader.get(5).unwrap().is_none() && reader.meta(5).is_none());
            assert!(reader.newest_before(u64::MAX).unwrap().is_none());
            assert_eq!(reader.newest_before(5).unwrap().unwrap().position(), 4);
        }
        place.slot.store(15 << 32 | 64, Ordering::Relaxed);
        assert_eq!(reader.get(5).unwrap().unwrap().len(), 64);
    }

    #[test]
    fn any_number_of_a_hostile_writer_ends_no_search() {
        let (_writer, reader) = topic();
        assert!(read_all(&reader) > 0);
        let header = reader.0.memory.header();
        for head in [0, 5, 7, 1 << 48, u64::MAX - 1, u64::MAX] {
            header.head.store(head, Ordering::Relaxed);
            for seq in [0, 6, 1 << 48, u64::MAX] {
                for position in 0..5 {
                    reader.0.memory.place(position).seq.store(seq, Ordering::Relaxed);
                }
                read_all(&reader);
            }
        }
    }
}
