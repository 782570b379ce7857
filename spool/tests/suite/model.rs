//! The promises of a stream: an oracle that remembers every append and every acknowledgement.

use std::collections::BTreeMap;
use std::num::NonZeroU8;

use gleaner_base::ByteSize;
use gleaner_spool::{
    BUDGET_MIN, BootId, GapReason, SpoolConfig, SpoolError, SpoolGap, SpoolItem, SpoolReader,
    SpoolStorage, SpoolTime, SpoolWriter,
};
use gleaner_test_support::simulated_disk::{SimulatedDisk, SpoolRandom};

pub const KIND: NonZeroU8 = NonZeroU8::MIN;
pub const TIME: SpoolTime = SpoolTime { since_boot_ns: 5, wall_ns: -7 };
pub const STREAM: &str = "logs";

/// Number of repetitions: that of the environment variable, or `usual`, twenty times as many with
/// `GLEANER_LONG=1`.
pub fn times(variable: &str, usual: u64) -> u64 {
    let long = std::env::var("GLEANER_LONG").is_ok_and(|value| value == "1");
    let usual = if long { 20 * usual } else { usual };
    std::env::var(variable).map_or(usual, |times| times.parse().unwrap())
}

pub fn config(budget: ByteSize) -> SpoolConfig {
    SpoolConfig { stream: STREAM.to_owned(), boot: BootId([9; 16]), budget }
}

pub fn open(disk: &SimulatedDisk) -> SpoolWriter<SimulatedDisk> {
    SpoolWriter::with_storage(disk.clone(), config(BUDGET_MIN)).unwrap()
}

/// Appends a record and commits it; returns the first number that is not acknowledged.
pub fn write<S: SpoolStorage>(writer: &mut SpoolWriter<S>, payload: &[u8]) -> u64 {
    writer.append(KIND, TIME, payload).unwrap();
    writer.commit().unwrap()
}

/// All items of the stream from number 0 on.
pub fn items<S: SpoolStorage>(storage: S) -> Vec<SpoolItem> {
    SpoolReader::with_storage(storage, STREAM, Some(0)).map(Result::unwrap).collect()
}

/// The records among `items`, after a check that they are in order, and that each number from 0 on
/// is in a record or in a gap.
pub fn records(items: &[SpoolItem]) -> BTreeMap<u64, Vec<u8>> {
    let (mut expected, mut records) = (0, BTreeMap::new());
    for item in items {
        expected = match item {
            SpoolItem::Record(record) => {
                assert_eq!(record.seq, expected, "{items:?}");
                assert_eq!((record.kind, record.time), (KIND, TIME));
                records.insert(record.seq, record.payload.clone());
                record.seq + 1
            }
            SpoolItem::Gap(gap) => match gap.record {
                Some(record) if gap.to + 1 != record => {
                    assert_eq!(record, expected, "{items:?}");
                    record + 1
                }
                record => {
                    assert_eq!(gap.from, expected, "{items:?}");
                    record.unwrap_or(gap.to) + 1
                }
            },
            SpoolItem::Torn(torn) => {
                assert_eq!((item, torn.from), (items.last().unwrap(), expected));
                expected
            }
        };
    }
    records
}

/// Appended and acknowledged records.
#[derive(Default)]
pub struct StreamModel {
    /// All payloads that were ever appended with a number: one that was not acknowledged may be
    /// used again after a power cut.
    appended: BTreeMap<u64, Vec<Vec<u8>>>,
    acknowledged: BTreeMap<u64, Vec<u8>>,
    queued: BTreeMap<u64, Vec<u8>>,
    /// Numbers below it were removed, as durable gap records state.
    removed: u64,
}

impl StreamModel {
    /// Opens a writer; `None` if the disk does not allow it.
    pub fn open(&mut self, disk: &SimulatedDisk) -> Option<SpoolWriter<SimulatedDisk>> {
        self.queued.clear();
        let writer = match SpoolWriter::with_storage(disk.clone(), config(BUDGET_MIN)) {
            Err(SpoolError::Read { .. }) => return None,
            other => other.unwrap(),
        };
        let newest = self.acknowledged.last_key_value().map(|(seq, _)| *seq);
        assert!(newest < Some(writer.status().next), "a number is used twice");
        Some(writer)
    }

    /// Appends a record of a random length, and returns whether it was accepted.
    pub fn append<S: SpoolStorage>(
        &mut self,
        writer: &mut SpoolWriter<S>,
        random: &mut SpoolRandom,
    ) -> bool {
        let longest = if random.below(10) == 0 { 2000 } else { 200 };
        let payload: Vec<u8> =
            (0..random.below(longest)).map(|_| random.below(256) as u8).collect();
        match writer.append(KIND, TIME, &payload) {
            Ok(seq) => {
                assert!(!self.acknowledged.contains_key(&seq), "number {seq} is used twice");
                self.appended.entry(seq).or_default().push(payload.clone());
                assert!(self.queued.insert(seq, payload).is_none());
                true
            }
            Err(SpoolError::Refused { .. }) => false,
            Err(error) => panic!("{error}"),
        }
    }

    /// Commits, and returns whether all was acknowledged.
    pub fn commit<S: SpoolStorage>(&mut self, writer: &mut SpoolWriter<S>) -> bool {
        let committed = writer.commit();
        let rest = self.queued.split_off(&writer.durable());
        self.acknowledged.append(&mut self.queued);
        self.queued = rest;
        match committed {
            Ok(durable) => {
                assert_eq!((durable, writer.queued_bytes()), (writer.status().next, 0));
                true
            }
            Err(SpoolError::Write { .. }) => false,
            Err(error) => panic!("{error}"),
        }
    }

    /// Reads all, and checks that every acknowledged record is there, unless the budget removed it.
    pub fn check(&mut self, disk: &SimulatedDisk) {
        let items = items(disk.clone());
        let records = records(&items);
        for (seq, payload) in &records {
            assert!(self.appended[seq].contains(payload), "record {seq} was never appended");
        }
        for item in &items {
            if let SpoolItem::Gap(SpoolGap { to, reason: GapReason::Budget, .. }) = item {
                self.removed = self.removed.max(to + 1);
            }
        }
        for (seq, payload) in self.acknowledged.range(self.removed..) {
            assert_eq!(records.get(seq), Some(payload), "acknowledged record {seq}");
        }
    }

    /// Number of gap records for refused records.
    pub fn refusals(disk: &SimulatedDisk) -> usize {
        let refused = |item: &&SpoolItem| {
            use GapReason::{DiskFull, QueueFull, WriteFailed};
            matches!(item, SpoolItem::Gap(gap)
                if matches!(gap.reason, DiskFull | WriteFailed | QueueFull))
        };
        items(disk.clone()).iter().filter(refused).count()
    }
}
