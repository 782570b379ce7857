//! Samples of a topic that were lost, over restarts of the ingress.
//!
//! Each ingress counts the samples that it lost itself. Those that were sent while there was none
//! are known from the numbers that each writer gives its samples: the last one before, and the
//! first one after.

use gleaner_buffers::shared::SharedReader;
use gleaner_messages::transport::{Guid, StoredMeta};
use gleaner_protocol::ingress::ReceptionStatus;

use crate::feed::TopicMemory;

/// Most writers of a topic whose numbers are followed over a gap.
const WRITERS: usize = 256;

/// Counts of a topic over all ingresses so far.
pub(crate) struct TopicLosses {
    /// Sums over earlier ingresses, and over the times between them; `None` if unknown.
    lost: Option<u64>,
    malformed: u64,
    gap: Option<ReceptionGap>,
}

impl Default for TopicLosses {
    fn default() -> Self {
        Self { lost: Some(0), malformed: 0, gap: None }
    }
}

impl TopicLosses {
    /// Adds the counts of an ingress that has ended: its last status, and the samples that it has
    /// left. A time without reception begins.
    pub(crate) fn begin_gap(&mut self, topic: &TopicMemory, last: &ReceptionStatus) {
        self.look(&topic.reader);
        match &mut self.gap {
            // The ingress after it has ended, too, before it attached the topic.
            Some(gap) if gap.next.is_none() => return,
            // Or before it received a sample.
            Some(gap) if topic.reader.head() == topic.first => {
                gap.next = None;
                self.malformed = self.malformed.saturating_add(last.malformed);
                return;
            }
            // It is not known any more what was lost in it.
            Some(_) => self.lost = None,
            None => {}
        }
        self.lost = self.lost.zip(last.lost).map(|(before, lost)| before.saturating_add(lost));
        self.malformed = self.malformed.saturating_add(last.malformed);
        self.gap = Some(ReceptionGap::after(topic, last.writers));
    }

    /// Ends the time without reception: the samples are in the memory of another ingress.
    pub(crate) fn end_gap(&mut self, topic: &TopicMemory) {
        if let Some(gap) = &mut self.gap {
            gap.next = Some(topic.first);
        }
    }

    /// Looks for the first samples after a gap.
    pub(crate) fn look(&mut self, reader: &SharedReader) {
        let Some(lost) = self.gap.as_mut().and_then(|gap| gap.look(reader)) else { return };
        self.lost = self.lost.map(|before| before.saturating_add(lost));
        self.gap = None;
    }

    /// Adds earlier counts to the state of a subscription.
    pub(crate) fn add_to(&self, status: &mut ReceptionStatus) {
        let known = self.lost.filter(|_| self.gap.is_none());
        status.lost = known.zip(status.lost).map(|(before, lost)| before.saturating_add(lost));
        status.malformed = status.malformed.saturating_add(self.malformed);
        if self.gap.as_ref().is_some_and(|gap| gap.next.is_none()) {
            status.writers = None;
        }
    }
}

struct ReceptionGap {
    /// Writers whose first sample after it was not found yet, with their last number before it.
    awaited: Vec<(Guid, u64)>,
    /// False if another writer may have lost samples, too.
    is_known: bool,
    /// Position of the next sample to look at; `None` while the gap lasts.
    next: Option<u64>,
    lost: u64,
}

impl ReceptionGap {
    /// Begins a gap after the samples that an ingress has left. It had matched `writers`.
    fn after(topic: &TopicMemory, writers: Option<usize>) -> Self {
        let head = topic.reader.head();
        let oldest = head.saturating_sub(topic.reader.depth().into()).max(topic.first);
        let mut awaited: Vec<(Guid, u64)> = Vec::new();
        let mut is_crowded = false;
        for words in (oldest..head).filter_map(|position| topic.reader.meta(position)) {
            let sample = StoredMeta::of_words(&words).sample;
            match awaited.iter().position(|(writer, _)| *writer == sample.writer) {
                Some(index) => awaited[index].1 = awaited[index].1.max(sample.seq),
                None if awaited.len() == WRITERS => is_crowded = true,
                None => awaited.push((sample.writer, sample.seq)),
            }
        }
        let is_known = writers.map_or(!awaited.is_empty(), |writers| writers <= awaited.len());
        Self { awaited, is_known: is_known && !is_crowded, next: None, lost: 0 }
    }

    /// Looks at further samples; returns the number of lost ones once it is known.
    fn look(&mut self, reader: &SharedReader) -> Option<u64> {
        let mut next = self.next?;
        let head = reader.head();
        while next < head && self.is_known && !self.awaited.is_empty() {
            // A sample that left before it was looked at may be the first one of any writer.
            let Some(words) = reader.meta(next) else {
                self.is_known = false;
                break;
            };
            let sample = StoredMeta::of_words(&words).sample;
            let found = self.awaited.iter().position(|(writer, _)| *writer == sample.writer);
            if let Some((_, last)) = found.map(|index| self.awaited.swap_remove(index)) {
                let between = sample.seq.saturating_sub(last).saturating_sub(1);
                self.lost = self.lost.saturating_add(between);
            }
            next += 1;
        }
        self.next = Some(next);
        (self.is_known && self.awaited.is_empty()).then_some(self.lost)
    }
}
