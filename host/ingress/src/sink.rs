//! The receiving end of a topic: writes each sample once into each region, and wakes the readers.
//!
//! It runs on the thread of the source. The engine takes the same lock to attach and detach
//! readers, which takes microseconds; readers take no lock.

use std::collections::VecDeque;
use std::os::fd::OwnedFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_buffers::shared::{
    Notifier, PinLimits, ReaderId, SharedWriter, WriteError, WriterMemory,
};
use gleaner_messages::transport::{
    ArrivalSums, Delivery, Gaps, Guid, SampleMeta, Sink, StoredMeta, TopicCounters,
};
use gleaner_samples::regions::{ControlRegion, KernelFutex, TopicRegion};

use crate::sizes::RegionSizes;

/// Number of samples that were too big for all regions, and are remembered.
const REFUSED: usize = 64;

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct ReceivedCounts {
    pub(crate) received: u64,
    pub(crate) too_big: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RegionId(u64);

/// The memory of a topic for samples up to one size, and its readers.
pub(crate) struct RegionWriter {
    id: RegionId,
    sizes: RegionSizes,
    writer: SharedWriter,
    sums: ArrivalSums,
    counters: TopicCounters,
    readers: Vec<RegionReader>,
    /// First position whose sums have digests, while digests are on.
    digests_from: u64,
    /// True if the last copy fits; `None` if it was made before this region, or is accepted.
    copied: Option<bool>,
}

struct RegionReader {
    id: ReaderId,
    bell: Option<Notifier>,
    digests: bool,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct AttachedReader {
    pub(crate) region: RegionId,
    pub(crate) id: ReaderId,
    /// Position of the first sample that it receives.
    pub(crate) first: u64,
    pub(crate) sizes: RegionSizes,
    /// Sum of the digests, and number of refused samples, before the first sample.
    pub(crate) digests: u32,
    pub(crate) refused: u64,
}

pub(crate) struct AttachRequest<'a> {
    pub(crate) control: &'a ControlRegion,
    pub(crate) limits: PinLimits,
    pub(crate) depth: u32,
    pub(crate) wakes: bool,
    pub(crate) digests: bool,
    /// True if it receives the samples that are shown already.
    pub(crate) is_latched: bool,
}

impl RegionWriter {
    /// Creates a region, and the file to pass to its readers.
    pub(crate) fn create(sizes: RegionSizes) -> std::io::Result<(Self, OwnedFd)> {
        let too_large = || std::io::Error::other("no region can be so large");
        let bytes = sizes.layout.bytes_needed().ok_or_else(too_large)?;
        let (region, file) = TopicRegion::create("gleaner-topic", bytes, sizes.present)?;
        let memory = WriterMemory::new(region, sizes.layout).ok_or_else(too_large)?;
        let writer = SharedWriter::with_warm_slots(memory, sizes.warm);
        let region = Self {
            id: RegionId(0),
            sizes,
            writer,
            sums: ArrivalSums::default(),
            counters: TopicCounters::default(),
            readers: Vec::new(),
            digests_from: 0,
            copied: None,
        };
        Ok((region, file.into()))
    }

    fn attach(&mut self, request: &AttachRequest<'_>) -> Result<AttachedReader, WriteError> {
        let id = self.writer.attach(request.control.clone(), request.limits)?;
        if request.digests {
            self.enable_digests();
        }
        let first = self.first(request);
        // From position 0 on, it receives all that the region has ever had.
        let is_all = request.is_latched && first == 0;
        let (digests, refused) = if is_all { (0, 0) } else { self.sums_before(first) };
        let bell = request.wakes.then(|| Notifier::of(request.control.clone()));
        self.readers.push(RegionReader { id, bell, digests: request.digests });
        Ok(AttachedReader { region: self.id, id, first, sizes: self.sizes, digests, refused })
    }

    /// Returns the position of the first sample that a reader receives.
    fn first(&self, request: &AttachRequest<'_>) -> u64 {
        let head = self.writer.head();
        let shown = self.sizes.layout.depth.min(request.depth);
        if request.is_latched { head.saturating_sub(shown.into()) } else { head }
    }

    fn enable_digests(&mut self) {
        if !self.sums.has_digests() {
            self.sums.enable_digests();
            self.digests_from = self.writer.head();
        }
    }

    /// Returns whether the sums of all samples that a reader receives are as it needs them.
    fn has_sums_for(&self, request: &AttachRequest<'_>) -> bool {
        let first = self.first(request);
        let has_digests = self.sums.has_digests() && self.digests_from <= first;
        !request.digests || first == self.writer.head() || has_digests
    }

    /// Returns the sum of the digests, and the number of refused samples, before a position.
    fn sums_before(&self, position: u64) -> (u32, u64) {
        match self.writer.shown(position) {
            Some((cdr, words)) => {
                let stored = StoredMeta::of_words(&words);
                (stored.digests_before(cdr), stored.refused)
            }
            None => (self.sums.digests(), self.sums.refused()),
        }
    }

    fn detach(&mut self, id: ReaderId) {
        self.writer.detach(id);
        self.readers.retain(|reader| reader.id != id);
        if !self.readers.iter().any(|reader| reader.digests) {
            self.sums.disable_digests();
        }
    }

    /// Copies a sample into a free slot; returns whether it fits.
    fn copy(&mut self, cdr: &[u8]) -> bool {
        let draft = self.writer.draft(cdr.len());
        let fits = draft.map(|mut draft| draft.copy_from_slice(cdr)).is_ok();
        self.copied = Some(fits);
        fits
    }

    /// Shows the copied sample and wakes the readers, or counts it as too big. Returns whether it
    /// fits; `None` if there is no copy of it.
    fn accept(&mut self, meta: &SampleMeta) -> Option<bool> {
        let fits = self.copied.take()?;
        match self.writer.drafted().filter(|_| fits) {
            Some(cdr) => {
                let stored = self.sums.add(meta, cdr);
                self.writer.publish(&stored.words());
                for bell in self.readers.iter().filter_map(|reader| reader.bell.as_ref()) {
                    bell.ring(&KernelFutex);
                }
            }
            None => self.refuse(),
        }
        Some(fits)
    }

    fn refuse(&mut self) {
        self.sums.refuse();
        self.counters.too_big += 1;
        self.writer.set_counters(&self.counters.words());
    }
}

/// The regions of a topic, shared by the engine and the subscriptions of the topic.
#[derive(Default)]
pub(crate) struct TopicSink(Mutex<SinkState>);

#[derive(Default)]
struct SinkState {
    regions: Vec<RegionWriter>,
    next_region: u64,
    counts: ReceivedCounts,
    /// The subscription of the last copy, until its sample is accepted.
    copied: Option<u64>,
    seen: Gaps,
    /// Set once there was a second subscription: a sample may come over both.
    checks_doubles: bool,
    /// The last samples that were too big for all regions. A second subscription, made for a region
    /// of larger samples, may deliver them again.
    refused: VecDeque<(Guid, u64)>,
    /// The last subscription that has received a sample.
    newest: u64,
}

impl TopicSink {
    /// Attaches a reader to a region for samples of exactly `max_bytes` with enough depth and room
    /// for its holds; `None` if there is none.
    pub(crate) fn attach(
        &self,
        max_bytes: u64,
        request: &AttachRequest<'_>,
    ) -> Option<AttachedReader> {
        let mut state = self.lock();
        let mut fitting = state.regions.iter_mut().filter(|region| {
            let layout = region.sizes.layout;
            let fits = layout.slot_bytes == max_bytes && layout.depth >= request.depth;
            fits && region.has_sums_for(request)
        });
        fitting.find_map(|region| region.attach(request).ok())
    }

    /// Adds a region, and attaches its first reader.
    pub(crate) fn attach_to(
        &self,
        mut region: RegionWriter,
        request: &AttachRequest<'_>,
    ) -> Result<AttachedReader, WriteError> {
        if request.digests {
            region.enable_digests();
        }
        let mut next = 0;
        if request.is_latched {
            // Large samples take long to copy, so the source may go on after each of them. It may
            // be faster than this; the last ones are copied under one lock.
            for _ in 0..region.sizes.layout.depth {
                let Some(behind) = self.lock().copy_next(&mut region, next) else { break };
                next = behind;
            }
        }
        let mut state = self.lock();
        region.id = RegionId(state.next_region);
        if request.is_latched {
            while let Some(behind) = state.copy_next(&mut region, next) {
                next = behind;
            }
            state.copy_draft(&mut region);
        }
        let attached = region.attach(request)?;
        state.next_region += 1;
        state.regions.push(region);
        Ok(attached)
    }

    /// Detaches a reader. Returns its region if that has no reader any more, to be dropped after
    /// the lock.
    pub(crate) fn detach(&self, region: RegionId, reader: ReaderId) -> Option<RegionWriter> {
        let mut state = self.lock();
        let index = state.regions.iter().position(|known| known.id == region)?;
        state.regions[index].detach(reader);
        state.regions[index].readers.is_empty().then(|| state.regions.swap_remove(index))
    }

    /// Stores the number of lost samples for readers to show.
    pub(crate) fn set_lost(&self, lost: Option<u64>) {
        for region in &mut self.lock().regions {
            region.counters.lost = lost;
            region.writer.set_counters(&region.counters.words());
        }
    }

    /// Drops samples that come a second time, from now on: there will be a second subscription.
    pub(crate) fn check_doubles(&self) {
        self.lock().checks_doubles = true;
    }

    pub(crate) fn counts(&self) -> ReceivedCounts {
        self.lock().counts
    }

    /// Returns the last subscription that has received a sample.
    pub(crate) fn newest_subscription(&self) -> u64 {
        self.lock().newest
    }

    fn lock(&self) -> MutexGuard<'_, SinkState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl SinkState {
    /// Returns the region that has all samples that any region has.
    fn largest(&self) -> Option<&RegionWriter> {
        self.regions.iter().max_by_key(|known| known.sizes.layout.slot_bytes)
    }

    /// Copies a shown sample to a further region: the first one from position `next` on that the
    /// region has room for. Returns the position after it; `None` if there is none.
    fn copy_next(&self, region: &mut RegionWriter, next: u64) -> Option<u64> {
        let known = self.largest()?;
        let depth = known.sizes.layout.depth.min(region.sizes.layout.depth);
        let position = next.max(known.writer.head().saturating_sub(depth.into()));
        let (cdr, words) = known.writer.shown(position)?;
        region.copy(cdr);
        region.accept(&StoredMeta::of_words(&words).sample);
        Some(position + 1)
    }

    /// Copies the sample that is copied, and not accepted yet, to a further region.
    fn copy_draft(&self, region: &mut RegionWriter) {
        let Some(known) = self.largest().filter(|_| self.copied.is_some()) else { return };
        match (known.copied, known.writer.drafted()) {
            (Some(true), Some(cdr)) => drop(region.copy(cdr)),
            (Some(false), _) => region.copied = Some(false),
            _ => {}
        }
    }

    fn copy(&mut self, subscription: u64, cdr: &[u8]) -> Delivery {
        self.copied = Some(subscription);
        let mut delivery = Delivery::Taken;
        for region in &mut self.regions {
            if !region.copy(cdr) {
                delivery = Delivery::TooBig;
            }
        }
        delivery
    }

    fn is_double(&self, meta: &SampleMeta) -> bool {
        self.checks_doubles && self.seen.has(meta.writer, meta.seq)
    }

    fn accept(&mut self, subscription: u64, meta: &SampleMeta) {
        if self.copied.take() != Some(subscription) {
            return;
        }
        self.newest = self.newest.max(subscription);
        if self.is_double(meta) {
            return self.accept_double(meta);
        }
        self.seen.note(meta.writer, meta.seq);
        let (mut is_taken, mut is_refused) = (false, false);
        for fits in self.regions.iter_mut().filter_map(|region| region.accept(meta)) {
            is_taken |= fits;
            is_refused |= !fits;
        }
        self.counts.received += 1;
        self.counts.too_big += u64::from(is_refused);
        if is_refused && !is_taken {
            if self.refused.len() == REFUSED {
                self.refused.pop_front();
            }
            self.refused.push_back((meta.writer, meta.seq));
        }
    }

    /// Drops a sample that has come before, but for regions that it was not too big for, if it was
    /// for all that there were.
    fn accept_double(&mut self, meta: &SampleMeta) {
        let known = self.refused.iter().position(|known| *known == (meta.writer, meta.seq));
        let mut is_taken = false;
        for region in &mut self.regions {
            if known.is_some() && region.copied == Some(true) {
                is_taken |= region.accept(meta).is_some();
            } else {
                region.copied = None;
                region.writer.discard();
            }
        }
        if is_taken && let Some(index) = known {
            self.refused.remove(index);
        }
    }
}

pub(crate) struct SubscriptionSink {
    pub(crate) topic: Arc<TopicSink>,
    /// Number of the subscription: 0, 1, ...
    pub(crate) number: u64,
}

impl Sink for SubscriptionSink {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        let mut state = self.topic.lock();
        let delivery = state.copy(self.number, cdr);
        state.accept(self.number, meta);
        delivery
    }

    fn too_big(&self, meta: &SampleMeta, _: usize) {
        let mut state = self.topic.lock();
        if state.is_double(meta) {
            return;
        }
        state.seen.note(meta.writer, meta.seq);
        state.regions.iter_mut().for_each(RegionWriter::refuse);
        state.counts.received += 1;
        state.counts.too_big += 1;
    }

    fn copy(&self, cdr: &[u8]) -> Option<Delivery> {
        Some(self.topic.lock().copy(self.number, cdr))
    }

    fn accept(&self, meta: &SampleMeta) {
        self.topic.lock().accept(self.number, meta);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn meta(seq: u64) -> SampleMeta {
        SampleMeta::new(0, Guid::default(), seq)
    }

    fn add(topic: &TopicSink, control: &ControlRegion, max_bytes: u64) {
        let limits = PinLimits { first_word: 0, windows: 0, window: 0, singles: 1 };
        let (wakes, digests, is_latched) = (false, false, false);
        let request = AttachRequest { control, limits, depth: 4, wakes, digests, is_latched };
        let (region, _) = RegionWriter::create(RegionSizes::of(max_bytes, true, 4, 1)).unwrap();
        topic.attach_to(region, &request).unwrap();
    }

    #[test]
    fn a_reader_that_receives_shown_samples_gets_the_sums_before_them() {
        let (control, _) = ControlRegion::create().unwrap();
        let topic = Arc::new(TopicSink::default());
        let request = |digests, depth, word| AttachRequest {
            control: &control,
            limits: PinLimits { first_word: word, windows: 0, window: 0, singles: 1 },
            depth,
            wakes: false,
            digests,
            is_latched: true,
        };
        let region = || RegionWriter::create(RegionSizes::of(100, true, 4, 3)).unwrap().0;
        topic.attach_to(region(), &request(false, 4, 0)).unwrap();
        let sink = SubscriptionSink { topic: Arc::clone(&topic), number: 0 };
        sink.deliver(&meta(1), &[1; 200]);
        for seq in 2..=4 {
            sink.deliver(&meta(seq), &[seq as u8; 50]);
        }
        // The samples in the first region have no digests.
        assert!(topic.attach(100, &request(true, 2, 1)).is_none());
        let other = topic.attach_to(region(), &request(true, 2, 1)).unwrap();
        let third = topic.attach(100, &request(true, 3, 2)).unwrap();
        let sums = |reader: &AttachedReader| (reader.first, reader.digests, reader.refused);
        let mut expected = ArrivalSums::default();
        expected.enable_digests();
        assert_eq!(sums(&third), (0, expected.digests(), 0));
        expected.add(&meta(2), &[2; 50]);
        assert_eq!(sums(&other), (1, expected.digests(), 0));
    }

    #[test]
    fn a_region_between_copy_and_accept_of_a_sample_counts_nothing() {
        let (control, _) = ControlRegion::create().unwrap();
        let topic = Arc::new(TopicSink::default());
        add(&topic, &control, 100);
        let sink = SubscriptionSink { topic: Arc::clone(&topic), number: 0 };
        assert_eq!(sink.copy(&[1; 50]), Some(Delivery::Taken));
        add(&topic, &control, 10);
        sink.accept(&meta(1));
        assert_eq!(topic.counts(), ReceivedCounts { received: 1, too_big: 0 });
        assert_eq!(sink.deliver(&meta(2), &[1; 50]), Delivery::TooBig);
        assert_eq!(topic.counts(), ReceivedCounts { received: 2, too_big: 1 });
        // A copy that is never accepted is replaced.
        sink.copy(&[3; 5]);
        sink.deliver(&meta(3), &[4; 5]);
        let state = topic.lock();
        let heads: Vec<u64> = state.regions.iter().map(|region| region.writer.head()).collect();
        assert_eq!(heads, [3, 1]);
        assert_eq!(state.regions[1].writer.shown(0).unwrap().0, [4; 5]);
    }
}
