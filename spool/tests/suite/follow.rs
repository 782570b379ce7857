//! A reader beside a writer that works.

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use gleaner_base::ByteSize;
use gleaner_spool::{BUDGET_MIN, GapReason, SpoolItem, SpoolReader, SpoolStorage, SpoolWriter};
use gleaner_test_support::simulated_disk::SimulatedDisk;

use crate::model::{STREAM, config, write};

/// The numbers of the records that `reader` returns until the end.
fn numbers<S: SpoolStorage>(reader: &mut SpoolReader<S>) -> Vec<u64> {
    let number = |item| match item {
        Ok(SpoolItem::Record(record)) => record.seq,
        other => panic!("{other:?}"),
    };
    reader.by_ref().map(number).collect()
}

#[test]
fn a_segment_replaced_on_the_disk_is_opened_again() {
    let scratch = tempfile::tempdir().unwrap();
    let path = scratch.path().join("00000000000000000000.seg");
    fs::write(&path, b"").unwrap();
    let mut reader = SpoolReader::open(scratch.path(), STREAM, None).unwrap();
    assert_eq!(numbers(&mut reader), [0_u64; 0]);
    let mut writer = SpoolWriter::open(scratch.path(), config(BUDGET_MIN)).unwrap();
    write(&mut writer, b"one");
    assert_eq!(numbers(&mut reader), [0]);
    // Removed, not replaced: the reader waits for the next segment.
    fs::remove_file(&path).unwrap();
    assert_eq!(numbers(&mut reader), [0_u64; 0]);
}

#[test]
fn reading_lists_the_folder_a_few_times_for_any_number_of_segments() {
    let disk = SimulatedDisk::new(1);
    for _ in 0..300 {
        let config = config(ByteSize::mib(8));
        let mut writer = SpoolWriter::with_storage(disk.clone(), config).unwrap();
        write(&mut writer, b"one of few");
    }
    let before = disk.lists();
    let mut reader = SpoolReader::with_storage(disk.clone(), STREAM, None);
    assert_eq!(numbers(&mut reader).len(), 300);
    assert!(disk.lists() - before <= 3, "{} lists", disk.lists() - before);
}

/// The first number of the oldest segment in `folder`.
fn oldest(folder: &Path) -> u64 {
    let names = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name());
    let firsts = names.filter_map(|name| name.to_str()?.strip_suffix(".seg")?.parse().ok());
    firsts.min().unwrap()
}

#[test]
fn a_reader_beside_a_writer_returns_each_record_unless_the_budget_removed_it() {
    const RECORDS: u64 = 1500;
    let scratch = tempfile::tempdir().unwrap();
    let mut writer = SpoolWriter::open(scratch.path(), config(BUDGET_MIN)).unwrap();
    let written = AtomicBool::new(false);
    let mut expected = 0;
    thread::scope(|scope| {
        scope.spawn(|| {
            // Long records: a segment has room for five.
            for _ in 0..RECORDS {
                write(&mut writer, &[7; 1500]);
            }
            written.store(true, Ordering::Release);
        });
        let mut reader = SpoolReader::open(scratch.path(), STREAM, Some(0)).unwrap();
        loop {
            let is_last = written.load(Ordering::Acquire);
            for item in reader.by_ref() {
                expected = match item.unwrap() {
                    SpoolItem::Record(record) => {
                        assert_eq!(record.seq, expected);
                        record.seq + 1
                    }
                    SpoolItem::Gap(gap) if gap.record.is_none() => {
                        assert_eq!((gap.from, gap.reason), (expected, GapReason::Budget));
                        let oldest = oldest(scratch.path());
                        assert!(gap.to < oldest, "{gap:?}, but segment {oldest} is there");
                        gap.to + 1
                    }
                    SpoolItem::Gap(gap) => gap.record.unwrap() + 1,
                    SpoolItem::Torn(torn) => torn.from,
                };
            }
            if is_last {
                break;
            }
        }
    });
    assert_eq!(expected, writer.status().next);
}
