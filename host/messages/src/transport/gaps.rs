//! Counts losses by gaps in the sequence numbers of writers.

use std::collections::VecDeque;

use crate::transport::Guid;

/// Number of writers tracked at a time. One more replaces the one that was silent for longest.
const MAX_WRITERS: usize = 256;
/// Number of gaps of a writer that a late sample may still fill. Beyond it, the oldest gaps are
/// final.
const OPEN_GAPS: usize = 64;

/// Counts the samples that are missing between the received ones, for each writer.
///
/// A writer's first sample sets the beginning of its numbers: earlier ones are not lost. A late
/// sample, as networks cause without any fault, reverts its loss. A restarted writer has another
/// [`Guid`].
#[derive(Clone, Debug, Default)]
pub struct Gaps {
    writers: Vec<TrackedWriter>,
    /// Number of samples noted; serves to find the writer that was silent for longest.
    noted: u64,
    lost: u64,
}

#[derive(Clone, Debug)]
struct TrackedWriter {
    guid: Guid,
    /// The expected number; `None` after the last one.
    next: Option<u64>,
    /// First and last number of each unfilled gap, oldest first.
    open: VecDeque<(u64, u64)>,
    last_noted: u64,
}

impl Gaps {
    /// Notes a received sample. Returns the number of samples missing just before it.
    pub fn note(&mut self, writer: Guid, seq: u64) -> u64 {
        self.noted += 1;
        let Some(found) = self.writers.iter_mut().find(|known| known.guid == writer) else {
            self.track(writer, seq);
            return 0;
        };
        found.last_noted = self.noted;
        let Some(next) = found.next.filter(|next| *next <= seq) else {
            self.lost = self.lost.saturating_sub(u64::from(found.fill(seq)));
            return 0;
        };
        found.next = seq.checked_add(1);
        let missing = seq - next;
        if missing > 0 {
            found.open.push_back((next, seq - 1));
            if found.open.len() > OPEN_GAPS {
                found.open.pop_front();
            }
            self.lost = self.lost.saturating_add(missing);
        }
        missing
    }

    /// Returns the number of missing samples of all writers.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Returns whether this sample was received, or is older than the tracked ones: it is neither a
    /// next one nor in an open gap.
    pub fn has(&self, writer: Guid, seq: u64) -> bool {
        let known = self.writers.iter().find(|known| known.guid == writer);
        known.is_some_and(|known| {
            let missing = known.open.iter().any(|(first, last)| (*first..=*last).contains(&seq));
            known.next.is_none_or(|next| seq < next) && !missing
        })
    }

    fn track(&mut self, guid: Guid, seq: u64) {
        if self.writers.len() >= MAX_WRITERS
            && let Some(oldest) =
                (0..self.writers.len()).min_by_key(|index| self.writers[*index].last_noted)
        {
            self.writers.swap_remove(oldest);
        }
        self.writers.push(TrackedWriter {
            guid,
            next: seq.checked_add(1),
            open: VecDeque::new(),
            last_noted: self.noted,
        });
    }
}

impl TrackedWriter {
    /// Returns whether `seq` was missing until now, and fills its gap.
    fn fill(&mut self, seq: u64) -> bool {
        let Some(index) =
            self.open.iter().position(|(first, last)| (*first..=*last).contains(&seq))
        else {
            return false;
        };
        let (first, last) = self.open[index];
        match (first == seq, last == seq) {
            (true, true) => drop(self.open.remove(index)),
            (true, false) => self.open[index].0 = seq + 1,
            (false, true) => self.open[index].1 = seq - 1,
            (false, false) => {
                self.open[index].1 = seq - 1;
                self.open.insert(index + 1, (seq + 1, last));
                // The limit holds for gaps that are split, too.
                if self.open.len() > OPEN_GAPS {
                    self.open.pop_front();
                }
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    fn guid(n: u16) -> Guid {
        let mut bytes = [0; 16];
        bytes[..2].copy_from_slice(&n.to_be_bytes());
        Guid(bytes)
    }

    fn lost_after(numbers: &[u64]) -> u64 {
        let mut gaps = Gaps::default();
        for seq in numbers {
            gaps.note(guid(1), *seq);
        }
        gaps.lost()
    }

    #[test]
    fn samples_before_the_first_received_one_are_not_lost() {
        assert_eq!(lost_after(&[1000, 1001]), 0);
        assert_eq!(lost_after(&[1000, 1002]), 1);
    }

    #[test]
    fn a_late_sample_reverts_its_loss_once() {
        assert_eq!(lost_after(&[1, 5]), 3);
        assert_eq!(lost_after(&[1, 5, 3]), 2);
        assert_eq!(lost_after(&[1, 5, 3, 3]), 2);
        assert_eq!(lost_after(&[1, 5, 3, 2, 4]), 0);
    }

    #[test]
    fn a_sample_that_comes_twice_or_from_before_the_first_changes_nothing() {
        assert_eq!(lost_after(&[5, 7, 7, 5, 1]), 1);
    }

    #[test]
    fn received_samples_differ_from_missing_ones() {
        let mut gaps = Gaps::default();
        for seq in [5, 6, 9, u64::MAX, 7] {
            gaps.note(guid(1), seq);
        }
        assert!([1, 5, 6, 7, 9, u64::MAX].iter().all(|seq| gaps.has(guid(1), *seq)));
        assert!([8, 10, 1 << 40].iter().all(|seq| !gaps.has(guid(1), *seq)));
        assert!(!gaps.has(guid(2), 5));
    }

    #[test]
    fn writers_are_counted_separately_and_a_new_one_starts_at_its_first_sample() {
        let mut gaps = Gaps::default();
        for (writer, seq, missing) in
            [(1, 1, 0), (2, 100, 0), (1, 3, 1), (2, 101, 0), (3, 1, 0), (2, 104, 2)]
        {
            assert_eq!(gaps.note(guid(writer), seq), missing);
        }
        assert_eq!(gaps.lost(), 3);
    }

    #[test]
    fn numbers_without_end_saturate() {
        let mut gaps = Gaps::default();
        for writer in 0..3 {
            gaps.note(guid(writer), 0);
            assert_eq!(gaps.note(guid(writer), u64::MAX), u64::MAX - 1);
            assert_eq!(gaps.note(guid(writer), u64::MAX), 0);
        }
        assert_eq!(gaps.lost(), u64::MAX);
    }

    #[test]
    fn the_writer_that_was_silent_for_longest_is_replaced_first() {
        let mut gaps = Gaps::default();
        for writer in 0..MAX_WRITERS as u16 {
            gaps.note(guid(writer), 1);
        }
        gaps.note(guid(0), 2);
        gaps.note(guid(9999), 1);
        assert_eq!(gaps.note(guid(0), 4), 1, "it was the last but one to send");
        assert_eq!(gaps.note(guid(1), 4), 0, "it is new again");
        assert_eq!(gaps.writers.len(), MAX_WRITERS);
    }

    #[test]
    fn gaps_that_are_too_many_become_final_and_memory_stays_bounded() {
        let mut gaps = Gaps::default();
        for n in 0..10_000 {
            gaps.note(guid(1), 1 + 2 * n);
        }
        assert_eq!(gaps.lost(), 9_999);
        gaps.note(guid(1), 2);
        assert_eq!(gaps.lost(), 9_999, "the oldest gap is final");
        gaps.note(guid(1), 19_998);
        assert_eq!(gaps.lost(), 9_998, "the newest is not");
        for n in 0..10_000 {
            gaps.note(guid(2), 1 + 1_000 * (n % 3) + n);
        }
        assert!(gaps.writers.iter().all(|writer| writer.open.len() <= OPEN_GAPS));
    }

    /// A model that remembers all numbers of a writer.
    #[derive(Default)]
    struct Naive {
        first: Option<u64>,
        received: BTreeSet<u64>,
    }

    impl Naive {
        fn note(&mut self, seq: u64) {
            let first = *self.first.get_or_insert(seq);
            if seq >= first {
                self.received.insert(seq);
            }
        }

        fn lost(&self) -> u64 {
            match (self.first, self.received.last()) {
                (Some(first), Some(last)) => last - first + 1 - self.received.len() as u64,
                _ => 0,
            }
        }
    }

    #[test]
    fn random_orders_are_counted_as_by_a_model_that_remembers_everything() {
        let mut state = 0x9e37_79b9_7f4a_7c15_u64;
        let mut random = move |below: u64| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) % below
        };
        for _ in 0..300 {
            let (mut gaps, mut naive) = (Gaps::default(), [Naive::default(), Naive::default()]);
            // The numbers are in a window that moves on, so that the number of gaps stays below the
            // limit.
            for step in 0..500 {
                let (writer, seq) = (random(2) as usize, 1 + step / 4 + random(40));
                gaps.note(guid(writer as u16), seq);
                naive[writer].note(seq);
                assert_eq!(gaps.lost(), naive.iter().map(Naive::lost).sum::<u64>(), "step {step}");
            }
        }
    }
}
