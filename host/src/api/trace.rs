//! Traces one topic for the journal: the samples since the previous wake, and how far back the
//! lambda looked.

use gleaner_buffers::RingCounts;
use gleaner_journal::InputView;
use gleaner_messages::transport::StoredMeta;

use super::data::{SumsBefore, Topic};

/// Number of samples of `topic` so far, including refused ones.
pub fn offered(topic: &Topic) -> u64 {
    let RingCounts { received, no_slot, too_big, .. } = topic.reader().counts();
    received + no_slot + too_big
}

/// Traces the visible samples of one topic from wake to wake.
pub struct Trace {
    /// Number of samples so far, including refused ones.
    offered: u64,
    /// Position behind the newest visible sample, and the sums up to it.
    until: u64,
    digest: u32,
    refused: u64,
}

impl Trace {
    /// Starts the trace. Another process sums up all samples of `topic`: then it begins with the
    /// first one, which the lambda may see in its first wake. Otherwise they are summed up from now
    /// on.
    pub fn of(topic: &Topic) -> Self {
        topic.sum_digests();
        let newest = topic.reader().newest_meta().filter(|_| !topic.reader().is_shared());
        let (until, SumsBefore { digest, refused }) = match newest {
            Some((position, StoredMeta { digests: digest, refused, .. })) => {
                (position + 1, SumsBefore { digest, refused })
            }
            None => (0, topic.sums_before),
        };
        Self { offered: until + refused, until, digest, refused }
    }

    /// Notes the samples since the previous wake; call it before each wake. If a sample of this
    /// topic causes the wake, `woken_by` has its position in the ring and its metadata, which saves
    /// a lookup if it is the newest.
    pub fn begin(
        &mut self,
        topic: &Topic,
        woken_by: Option<(u64, &StoredMeta)>,
        seen: &mut InputView,
    ) {
        let head = topic.reader().head();
        let until = topic.until().min(head);
        seen.digest = 0;
        if until > self.until {
            self.until = until;
            let newest = match woken_by {
                Some((position, meta)) if position + 1 == until => Some(*meta),
                _ => newest_visible(topic, until),
            };
            if let Some(StoredMeta { digests, refused, .. }) = newest {
                seen.digest = digests.wrapping_sub(self.digest);
                self.digest = digests;
                self.refused = self.refused.max(refused);
            }
            seen.newest = newest.map(|meta| (meta.sample.writer.0, meta.sample.seq));
        }
        // Where no sample arrives during the wake, those that were refused since the newest count.
        let is_still = topic.until() == u64::MAX;
        if is_still {
            let RingCounts { no_slot, too_big, .. } = topic.reader().counts();
            self.refused = no_slot + too_big;
        }
        let offered = (self.until + self.refused).max(self.offered);
        seen.new = offered - self.offered;
        self.offered = offered;
        topic.look_back.reset();
    }

    /// Notes how far back the lambda looked; call it after each wake. `woken_by` is the position of
    /// the sample that caused it, if it is one of this topic.
    pub fn end(&self, topic: &Topic, woken_by: Option<u64>, seen: &mut InputView) {
        let oldest = [topic.look_back.oldest(), woken_by].into_iter().flatten().min();
        seen.reach = oldest.map_or(0, |oldest| self.until.saturating_sub(oldest));
    }
}

/// Metadata of the newest sample below position `until`.
fn newest_visible(topic: &Topic, until: u64) -> Option<StoredMeta> {
    let newest = topic.pinned().or_else(|| topic.reader().newest_before(until));
    newest.map(|lease| *lease.meta())
}
