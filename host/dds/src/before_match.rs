//! Estimates the number of samples that were not sent to us: after the subscription, and before its
//! reader was matched.
//!
//! A volatile reader gets nothing from before its match, and no gap shows it: a writer's first
//! received sample may have any number. That number is an upper limit. A writer may also be older
//! than the subscription: so the time since the subscription, divided by the interval of the
//! writer's samples, is another limit. The lower one counts, which is exact for a writer with a
//! constant rate. RustDDS does not expose HEARTBEATs; the first one after the match would give
//! about the same number.

use std::collections::HashMap;

use gleaner_messages::transport::{Guid, SampleMeta};

/// Most writers whose first samples are tracked.
const MOST: usize = 256;
/// The interval of a writer's samples is taken over this many of them.
const SPAN: u64 = 16;

/// The samples of one topic that were sent after the subscription and before the match.
#[derive(Debug)]
pub(super) struct BeforeMatch {
    subscribed_ns: i64,
    writers: HashMap<Guid, FirstSamples>,
    /// Samples of writers that are gone, and no longer tracked.
    of_gone: u64,
}

#[derive(Copy, Clone, Debug)]
struct FirstSamples {
    /// The first received number.
    seq: u64,
    at_ns: i64,
    publish_ns: i64,
    /// Known from the second sample on.
    before: Option<u64>,
    is_final: bool,
}

impl BeforeMatch {
    /// `subscribed_ns` is the time of the subscription by the clock of receive stamps.
    pub(super) fn new(subscribed_ns: i64) -> Self {
        Self { subscribed_ns, writers: HashMap::new(), of_gone: 0 }
    }

    pub(super) fn note(&mut self, meta: &SampleMeta) {
        let Some(first) = self.writers.get_mut(&meta.writer) else {
            if self.writers.len() < MOST {
                let (seq, at_ns, publish_ns) = (meta.seq, meta.at_ns, meta.publish_ns);
                // Nothing was sent before number 1.
                let before = (seq <= 1).then_some(0);
                let is_final = before.is_some();
                let first = FirstSamples { seq, at_ns, publish_ns, before, is_final };
                self.writers.insert(meta.writer, first);
            }
            return;
        };
        if !first.is_final && meta.seq > first.seq {
            first.before = Some(first.estimate(meta, self.subscribed_ns));
            first.is_final = meta.seq - first.seq >= SPAN;
        }
    }

    /// Makes room for new writers if there is little: writers that are not `present` go.
    pub(super) fn make_room(&mut self, present: impl Fn(&Guid) -> bool) {
        if self.writers.len() >= MOST / 2 {
            self.writers.retain(|guid, first| {
                let stays = present(guid);
                if !stays {
                    self.of_gone = self.of_gone.saturating_add(first.before.unwrap_or(0));
                }
                stays
            });
        }
    }

    /// The number of samples; `None` while it is not known of a writer.
    pub(super) fn count(&self) -> Option<u64> {
        self.writers
            .values()
            .try_fold(self.of_gone, |sum, first| Some(sum.saturating_add(first.before?)))
    }
}

impl FirstSamples {
    /// The number of samples that the writer sent in the time from `subscribed_ns` to the first
    /// received one, at the interval of those up to `meta`.
    fn estimate(&self, meta: &SampleMeta, subscribed_ns: i64) -> u64 {
        let sent = self.seq.saturating_sub(1);
        // By the clock of the writer: it shows no bursts of the network.
        let elapsed = meta.publish_ns.saturating_sub(self.publish_ns);
        let waited = u64::try_from(self.at_ns.saturating_sub(subscribed_ns)).unwrap_or(0);
        match u64::try_from(elapsed).unwrap_or(0) / (meta.seq - self.seq) {
            // All at once: there is no interval.
            0 => sent,
            interval => sent.min(waited / interval),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    fn sample(writer: u16, seq: u64, at_ns: i64) -> SampleMeta {
        let mut guid = [0; 16];
        guid[..2].copy_from_slice(&writer.to_be_bytes());
        // The writer has another clock.
        let publish_ns = at_ns - 1_000 * SECOND;
        SampleMeta { publish_ns, ..SampleMeta::new(at_ns, Guid(guid), seq) }
    }

    /// The count after samples `first..first + count` of a writer, at 100 Hz from `at_ns` on, and a
    /// subscription at 10 s.
    fn count(first: u64, count: u64, at_ns: i64) -> Option<u64> {
        let mut before = BeforeMatch::new(10 * SECOND);
        for n in 0..count {
            before.note(&sample(1, first + n, at_ns + n as i64 * SECOND / 100));
        }
        before.count()
    }

    #[test]
    fn of_a_writer_that_is_younger_than_the_subscription_all_samples_count() {
        assert_eq!(count(785, 100, 60 * SECOND), Some(784));
        assert_eq!(count(1, 100, 60 * SECOND), Some(0));
    }

    #[test]
    fn of_a_writer_that_is_older_those_since_the_subscription_count() {
        assert_eq!(count(1_000_000, 100, 10 * SECOND + SECOND / 2), Some(50));
        assert_eq!(count(1_000_000, 100, 10 * SECOND), Some(0));
        assert_eq!(count(1_000_000, 100, 9 * SECOND), Some(0), "the clock was set back");
    }

    #[test]
    fn one_sample_has_no_interval_unless_it_is_the_first_ever() {
        assert_eq!(count(1_000, 1, 11 * SECOND), None);
        assert_eq!(count(1_000, 2, 11 * SECOND), Some(100));
        assert_eq!(count(1, 1, 11 * SECOND), Some(0));
    }

    #[test]
    fn a_pause_of_the_writer_after_its_first_samples_changes_nothing() {
        let mut before = BeforeMatch::new(10 * SECOND);
        for n in 0..=SPAN {
            before.note(&sample(1, 500 + n, 11 * SECOND + n as i64 * SECOND / 100));
        }
        before.note(&sample(1, 1_000, 3_600 * SECOND));
        assert_eq!(before.count(), Some(100));
    }

    #[test]
    fn numbers_without_end_and_without_time_are_harmless() {
        let mut before = BeforeMatch::new(i64::MIN);
        for writer in 0..3 {
            before.note(&sample(writer, u64::MAX - 1, 0));
            before.note(&sample(writer, u64::MAX, 0));
            before.note(&sample(writer, 0, i64::MAX));
        }
        assert_eq!(before.count(), Some(u64::MAX));
    }

    #[test]
    fn writers_come_and_go_without_end_and_the_count_stays() {
        let mut before = BeforeMatch::new(10 * SECOND);
        for writer in 0..1_000 {
            before.note(&sample(writer, 2, 11 * SECOND));
            before.note(&sample(writer, 3, 12 * SECOND));
            let this = sample(writer, 0, 0).writer;
            before.make_room(|guid| *guid == this);
        }
        assert_eq!(before.count(), Some(1_000));
        assert!(before.writers.len() < MOST);
    }
}
