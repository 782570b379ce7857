//! A reader beside a writer that works.

use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use gleaner_base::ByteSize;
use gleaner_spool::{
    BUDGET_MIN, GapReason, SpoolItem, SpoolReader, SpoolStorage, SpoolWriter, TornTail,
};

use crate::model::{KIND, STREAM, TIME, config};
use crate::simulated::SimulatedDisk;

fn segment(count: u64) -> Vec<u8> {
    let disk = SimulatedDisk::new(5);
    let mut writer = SpoolWriter::with_storage(disk.clone(), config(BUDGET_MIN)).unwrap();
    for seq in 0..count {
        writer.append(KIND, TIME, &[seq as u8]).unwrap();
    }
    writer.commit().unwrap();
    disk.with_content(0, |content| content.clone())
}

/// The numbers of the records that `reader` returns until the end, and its torn tail.
fn numbers<S: SpoolStorage>(reader: &mut SpoolReader<S>) -> (Vec<u64>, Option<TornTail>) {
    let (mut numbers, mut tail) = (Vec::new(), None);
    for item in reader.by_ref() {
        match item.unwrap() {
            SpoolItem::Record(record) => numbers.push(record.seq),
            SpoolItem::Torn(torn) => tail = Some(torn),
            SpoolItem::Gap(gap) => panic!("{gap:?}"),
        }
    }
    (numbers, tail)
}

#[test]
fn a_segment_that_was_empty_when_a_reader_entered_it_is_read_once_it_is_filled() {
    let (disk, whole) = (SimulatedDisk::new(1), segment(3));
    drop(disk.create(0).unwrap());
    let mut reader = SpoolReader::with_storage(disk.clone(), STREAM, None);
    assert_eq!(numbers(&mut reader), (vec![], None));
    // Part of the header: a commit is in progress.
    disk.with_content(0, |content| content.extend_from_slice(&whole[..100]));
    assert_eq!(numbers(&mut reader), (vec![], Some(TornTail { from: 0, bytes: 100 })));
    disk.with_content(0, |content| content.clone_from(&whole));
    assert_eq!(numbers(&mut reader), (vec![0, 1, 2], None));
}

#[test]
fn a_segment_that_is_replaced_under_its_name_is_opened_again() {
    let (disk, whole) = (SimulatedDisk::new(1), segment(3));
    // A commit failed after a part of the header, or of the first record.
    for part in [0, 50, 128, 150, 169] {
        drop(disk.create(0).unwrap());
        disk.with_content(0, |content| content.extend_from_slice(&whole[..part]));
        let mut reader = SpoolReader::with_storage(disk.clone(), STREAM, None);
        let before = numbers(&mut reader).0;
        drop(disk.create(0).unwrap());
        disk.with_content(0, |content| content.clone_from(&whole));
        let after = numbers(&mut reader).0;
        assert_eq!([before, after].concat(), [0, 1, 2], "{part} bytes");
    }
}

#[test]
fn a_segment_replaced_on_the_disk_is_opened_again() {
    let scratch = tempfile::tempdir().unwrap();
    let path = scratch.path().join("00000000000000000000.seg");
    fs::write(&path, b"").unwrap();
    let mut reader = SpoolReader::open(scratch.path(), STREAM, None).unwrap();
    assert_eq!(numbers(&mut reader), (vec![], None));
    let mut writer = SpoolWriter::open(scratch.path(), config(BUDGET_MIN)).unwrap();
    writer.append(KIND, TIME, b"one").unwrap();
    writer.commit().unwrap();
    assert_eq!(numbers(&mut reader), (vec![0], None));
    // Removed, not replaced: the reader waits for the next segment.
    fs::remove_file(&path).unwrap();
    assert_eq!(numbers(&mut reader), (vec![], None));
}

#[test]
fn reading_lists_the_folder_a_few_times_for_any_number_of_segments() {
    let disk = SimulatedDisk::new(1);
    for _ in 0..300 {
        let config = config(ByteSize::mib(8));
        let mut writer = SpoolWriter::with_storage(disk.clone(), config).unwrap();
        writer.append(KIND, TIME, b"one of few").unwrap();
        writer.commit().unwrap();
    }
    let before = disk.lists();
    let mut reader = SpoolReader::with_storage(disk.clone(), STREAM, None);
    assert_eq!(numbers(&mut reader).0.len(), 300);
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
                writer.append(KIND, TIME, &[7; 1500]).unwrap();
                writer.commit().unwrap();
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
