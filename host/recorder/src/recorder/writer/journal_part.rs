//! The part of a lambda's journal that belongs to a clip.

use std::collections::BTreeMap;
use std::io;

use gleaner_journal::{JournalEnd, JournalHeader, JournalWriter};

/// Approximate overhead of a wake in memory.
const OVERHEAD: usize = 64;

/// Wakes of one lambda, each encoded independently, added in any order.
///
/// If there is no room for all, the last ones are dropped: the wakes of a journal are consecutive,
/// so that it can be replayed wake by wake.
#[derive(Debug, Default)]
pub struct JournalPart {
    /// By their numbers.
    wakes: BTreeMap<u64, Box<[u8]>>,
    bytes: usize,
    /// The first wake that found no room.
    end: Option<u64>,
    cut: u64,
}

impl JournalPart {
    /// Adds a wake, of which there is none with this number, if all of them take at most `most`
    /// bytes.
    pub fn push(&mut self, number: u64, encoded: &[u8], most: usize) {
        if self.end.is_some_and(|end| number >= end) {
            self.cut += 1;
            return;
        }
        self.bytes += encoded.len() + OVERHEAD;
        self.wakes.insert(number, encoded.into());
        while self.bytes > most
            && let Some((last, encoded)) = self.wakes.pop_last()
        {
            self.bytes -= encoded.len() + OVERHEAD;
            self.end = Some(last);
            self.cut += 1;
        }
    }

    /// Number of wakes without room.
    pub fn cut(&self) -> u64 {
        self.cut
    }

    /// Approximate size in memory.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Keeps the longest run of consecutive wakes, and returns the number of others: some in
    /// between did not reach the recorder.
    pub fn keep_run(&mut self) -> u64 {
        let (mut longest, mut run) = (0..0, 0..0);
        for number in self.wakes.keys() {
            run = if *number == run.end && !run.is_empty() {
                run.start..number + 1
            } else {
                *number..number + 1
            };
            if run.end - run.start > longest.end - longest.start {
                longest = run.clone();
            }
        }
        let all = self.wakes.len();
        self.wakes.retain(|number, _| longest.contains(number));
        (all - self.wakes.len()) as u64
    }

    /// A journal of these wakes; `None` if there are none.
    pub fn write(self, header: &JournalHeader) -> Option<io::Result<Vec<u8>>> {
        let (first, _) = self.wakes.first_key_value()?;
        let header = JournalHeader { wakes_before: *first, ..header.clone() };
        Some(self.journal(&header))
    }

    fn journal(&self, header: &JournalHeader) -> io::Result<Vec<u8>> {
        let mut writer = JournalWriter::begin(Vec::new(), header)?;
        for encoded in self.wakes.values() {
            writer.encoded_wake(encoded)?;
        }
        writer.finish(&JournalEnd {
            wakes: self.wakes.len() as u64,
            samples: Vec::new(),
            drives: Vec::new(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The numbers that a part of at most `most` bytes keeps of wakes of 36 bytes, and the number
    /// it drops.
    fn kept(numbers: impl IntoIterator<Item = u64>, most: usize) -> (Vec<u64>, u64) {
        let mut part = JournalPart::default();
        for number in numbers {
            // One is longer than the room that is left, while the ones after it would fit again.
            let len = if number == 7 { 400 } else { 36 };
            part.push(number, &vec![number as u8; len], most);
        }
        assert!(part.bytes <= most);
        (part.wakes.into_keys().collect(), part.cut)
    }

    #[test]
    fn wakes_after_the_first_one_without_room_are_dropped_too() {
        assert_eq!(kept(0..5, 1000), ((0..5).collect(), 0));
        assert_eq!(kept(0..12, 1000), ((0..7).collect(), 5), "without a hole at 7");
        assert_eq!(kept([3], 99), (vec![], 1));
    }

    #[test]
    fn a_journal_with_holes_is_its_longest_run() {
        let run = |numbers: &[u64]| {
            let mut part = JournalPart::default();
            numbers.iter().for_each(|number| part.push(*number, b"wake", 1 << 20));
            (part.keep_run(), part.wakes.into_keys().collect::<Vec<_>>())
        };
        assert_eq!(run(&[3, 4, 5]), (0, vec![3, 4, 5]));
        assert_eq!(run(&[0, 3, 4, 6, 7, 8, 20]), (4, vec![6, 7, 8]));
        assert_eq!(run(&[0, 2]), (1, vec![0]));
        assert_eq!(run(&[]), (0, vec![]));
    }

    #[test]
    fn earlier_wakes_that_arrive_late_displace_the_last_ones() {
        assert_eq!(kept((20..30).chain(8..13), 1000), ((8..13).chain(20..25).collect(), 5));
        assert_eq!(kept([10, 11, 12, 0, 13, 1, 12], 300), (vec![0, 1, 10], 4));
    }
}
