//! The samples of one topic, in the memory that the ingress shares.

use std::collections::VecDeque;
use std::sync::Arc;

use gleaner_messages::transport::{SampleMeta, StoredMeta, TopicCounters};
use gleaner_samples::SharedTopicReader;

/// Attempts to find a sample that stays until it is looked at: the ingress publishes meanwhile.
const ATTEMPTS: u32 = 8;

/// The samples of one topic, read in order, over restarts of the ingress.
pub struct SampleReader {
    fed: SharedTopicReader,
    /// Later memory of the topic: each begins where nothing is written to the one before it.
    later: VecDeque<SharedTopicReader>,
    /// Samples that were too large for earlier memory.
    too_big_before: u64,
    /// Position of the next sample.
    next: u64,
    /// Stamp of the next sample, once it is known.
    ahead: Option<i64>,
    received: u64,
    missed: u64,
}

impl SampleReader {
    pub fn new(fed: SharedTopicReader) -> SampleReader {
        let next = fed.info.first;
        let (later, too_big_before) = (VecDeque::new(), 0);
        SampleReader { fed, later, too_big_before, next, ahead: None, received: 0, missed: 0 }
    }

    /// Continues in the memory of an ingress that was started again, after the samples that the
    /// earlier one has left.
    pub fn continue_in(&mut self, fed: SharedTopicReader) {
        self.later.push_back(fed);
    }

    pub fn type_name(&self) -> &str {
        &self.fed.info.type_name
    }

    /// Returns the definitions to use: those of a recording, `local` ones, or those of nodes.
    pub fn definitions(&self, local: Option<Arc<str>>) -> Option<Arc<str>> {
        self.fed.definitions(|| local)
    }

    /// The layout that writers announce, as far as it is known.
    pub fn type_hash(&self) -> Option<&str> {
        self.fed.info.type_hash.as_deref()
    }

    /// Returns whether the next sample has an announced layout that is not known.
    pub fn lacks_layout(&mut self) -> bool {
        if self.look().is_none() || self.fed.info.is_recorded || self.type_hash().is_some() {
            return false;
        }
        let words = self.fed.reader.meta(self.next);
        words.is_some_and(|words| {
            StoredMeta::of_words(&words).sample.layout == SampleMeta::ANNOUNCED
        })
    }

    /// Sets the layout that writers announce. Without one, no definitions fit.
    pub fn set_layout(&mut self, type_hash: Option<String>) {
        self.fed.info.type_hash = Some(type_hash.unwrap_or_default());
        // Those that came without a layout.
        self.fed.info.definitions = None;
    }

    /// Returns the number of the layout of the next samples in a clip whose definitions have the
    /// layout `described`; `None` if their own is to be used: of a recording, or where a layout
    /// has no definitions.
    pub fn layout_as(&self, described: Option<&str>) -> Option<u16> {
        let is_it = self.type_hash().is_none() || self.type_hash() == described;
        (!self.fed.info.is_recorded && is_it).then_some(0)
    }

    pub fn offered_qos(&self) -> Option<&str> {
        self.fed.info.offered_qos.as_deref()
    }

    pub fn received(&self) -> u64 {
        self.received
    }

    /// Number of samples that left before they were read.
    pub fn missed(&self) -> u64 {
        self.missed
    }

    /// Number of samples that were too large for the topic.
    pub fn too_big(&self) -> u64 {
        let now = TopicCounters::of_words(&self.fed.reader.counters()).too_big;
        let here = now.saturating_sub(self.fed.info.refused);
        self.too_big_before.saturating_add(here)
    }

    /// Returns the stamp of the next sample, if there is one.
    pub fn look(&mut self) -> Option<i64> {
        for _ in 0..ATTEMPTS {
            if self.ahead.is_some() {
                return self.ahead;
            }
            if self.fed.reader.head() <= self.next {
                let later = self.later.pop_front()?;
                self.too_big_before = self.too_big();
                (self.next, self.fed) = (later.info.first, later);
                continue;
            }
            match self.fed.reader.meta(self.next) {
                Some(words) => self.ahead = Some(StoredMeta::of_words(&words).sample.at_ns),
                None => self.skip(),
            }
        }
        self.ahead
    }

    /// Reads samples in place from the next one on, up to the stamp `until_ns`, at most `most`.
    /// Returns their number and bytes. It holds them for this time only.
    pub fn read<E>(
        &mut self,
        until_ns: i64,
        most: usize,
        mut each: impl FnMut(&SampleMeta, &[u8]) -> Result<(), E>,
    ) -> Result<(usize, usize), E> {
        let window = u32::from(self.fed.info.holds.window.max(1));
        let count = window.min(u32::try_from(most).unwrap_or(u32::MAX));
        self.ahead = None;
        // It has a hold for one window, which is not in use.
        let Ok(Some(held)) = self.fed.reader.window(self.next, count) else {
            self.skip();
            return Ok((0, 0));
        };
        let (mut samples, mut bytes) = (0, 0);
        for sample in held.iter() {
            let meta = StoredMeta::of_words(sample.meta()).sample;
            let is_known = self.fed.info.is_recorded || self.fed.info.type_hash.is_some();
            if meta.at_ns > until_ns || meta.layout == SampleMeta::ANNOUNCED && !is_known {
                self.ahead = Some(meta.at_ns);
                break;
            }
            each(&meta, sample)?;
            (samples, bytes) = (samples + 1, bytes + sample.len());
            self.next += 1;
            self.received += 1;
        }
        Ok((samples, bytes))
    }

    /// Skips samples that have left.
    fn skip(&mut self) {
        let reader = &self.fed.reader;
        let oldest = reader.head().saturating_sub(reader.depth().into()).max(self.next + 1);
        self.missed += oldest - self.next;
        self.next = oldest;
    }
}
