//! The entries that a source has lost from the preroll, for windows that cover them.

use std::collections::VecDeque;

/// Maximum number of stamps kept for each source and cause. The losses of a window that reaches
/// further back are unknown.
const STAMPS_MAX: usize = 4096;

/// The losses of one source.
#[derive(Debug, Default)]
pub struct Losses {
    /// Evicted for lack of room.
    pub overwritten: LossStamps,
    /// Larger than the store.
    pub too_big: LossStamps,
    /// Dropped as older than any window reaches, unless its trigger comes late.
    pub aged: Horizon,
    /// Lost before the recorder, at the stamps of the next sample.
    pub lost: LossStamps,
}

/// Stamps of the losses of one cause.
#[derive(Debug, Default)]
pub struct LossStamps {
    /// Stamp, the group whose clips have it, and the number lost at once.
    stamps: VecDeque<(i64, u64, u64)>,
    forgotten: Horizon,
}

impl LossStamps {
    /// Adds a loss with the stamp `at`; it is in the clips of group `group`, 0 for none.
    pub fn add(&mut self, at: i64, group: u64) {
        self.add_some(at, group, 1);
    }

    /// Adds `count` losses at once, as [`add`](Self::add) does for one.
    pub fn add_some(&mut self, at: i64, group: u64, count: u64) {
        if self.stamps.len() == STAMPS_MAX
            && let Some((at, group, _)) = self.stamps.pop_front()
        {
            self.forgotten.add(at, group);
        }
        self.stamps.push_back((at, group, count));
    }

    /// Takes back one of the last losses that are in no clip's count: it has arrived after all.
    pub fn take_back(&mut self) {
        if let Some((_, _, count)) =
            self.stamps.iter_mut().rev().find(|(_, group, count)| *group == 0 && *count > 0)
        {
            *count -= 1;
        }
    }

    /// Counts the losses that `covered` selects and that are not in the clips of group `group`.
    /// Each is counted once.
    pub fn count(&mut self, group: u64, covered: impl Fn(i64) -> bool) -> u64 {
        let missing =
            self.stamps.iter_mut().filter(|(at, in_clip, _)| *in_clip != group && covered(*at));
        missing
            .map(|(_, in_clip, count)| {
                *in_clip = group;
                *count
            })
            .fold(0, u64::saturating_add)
    }

    /// Returns whether losses from `from` on may be missing here, because their stamps were
    /// dropped.
    pub fn is_unknown(&self, from: i64, group: u64) -> bool {
        self.forgotten.hides(from, group)
    }
}

/// The extent of missing entries.
#[derive(Debug)]
pub struct Horizon {
    /// Newest stamp of an entry in no clip.
    unwritten: i64,
    /// The last group whose clips have a lost entry, and its newest stamp.
    written: (u64, i64),
}

impl Default for Horizon {
    fn default() -> Horizon {
        Horizon { unwritten: i64::MIN, written: (0, i64::MIN) }
    }
}

impl Horizon {
    /// Adds a lost entry with the stamp `at`; it is in the clips of group `group`, 0 for none.
    pub fn add(&mut self, at: i64, group: u64) {
        if group == 0 {
            self.unwritten = self.unwritten.max(at);
        } else if group == self.written.0 {
            self.written.1 = self.written.1.max(at);
        } else {
            // For a later group, entries in the clips of an earlier one are missing as well.
            self.unwritten = self.unwritten.max(self.written.1);
            self.written = (group, at);
        }
    }

    /// Returns whether a window of group `group` that begins at `from` covers a lost entry that is
    /// in none of its clips.
    pub fn hides(&self, from: i64, group: u64) -> bool {
        from <= self.unwritten || (group != self.written.0 && from <= self.written.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_are_counted_once_for_each_group_of_windows() {
        let mut gone = LossStamps::default();
        for at in 0..10 {
            gone.add(at, if at < 3 { 7 } else { 0 });
        }
        assert_eq!(gone.count(7, |at| at < 5), 2, "three of five are in its clips");
        assert_eq!(gone.count(7, |at| at < 6), 1);
        assert_eq!(gone.count(8, |at| at < 6), 6);
        assert!(!gone.is_unknown(0, 7));
    }

    #[test]
    fn losses_beyond_the_kept_stamps_are_unknown() {
        let mut gone = LossStamps::default();
        for at in 0..STAMPS_MAX as i64 + 10 {
            gone.add(at, 0);
        }
        assert!(gone.is_unknown(9, 1) && !gone.is_unknown(10, 1));
    }

    #[test]
    fn an_entry_in_a_clip_is_not_missing_from_it_when_it_ages() {
        let mut aged = Horizon::default();
        aged.add(5, 0);
        aged.add(9, 2);
        assert!(!aged.hides(6, 2) && aged.hides(5, 2) && aged.hides(6, 3) && !aged.hides(10, 3));
        aged.add(12, 3);
        assert!(aged.hides(9, 3) && !aged.hides(10, 3));
    }
}
