//! Streams stay within their budget and their queue, and mark what they lose.

use std::io::ErrorKind;

use gleaner_base::ByteSize;
use gleaner_spool::{
    BUDGET_MIN, GapReason, SpoolError, SpoolFolder, SpoolGap, SpoolItem, SpoolNote, SpoolReader,
    SpoolStorage, SpoolWriter,
};
use gleaner_test_support::simulated_disk::{DiskFault, SimulatedDisk, SpoolRandom};

use crate::model::{KIND, STREAM, TIME, config, items, open, records, write};

fn gaps(disk: &SimulatedDisk) -> Vec<SpoolGap> {
    let gap = |item| match item {
        SpoolItem::Gap(gap) => Some(gap),
        _ => None,
    };
    items(disk.clone()).into_iter().filter_map(gap).collect()
}

#[test]
fn the_oldest_segments_are_removed_and_marked() {
    let disk = SimulatedDisk::new(1);
    let mut writer = open(&disk);
    for _ in 0..1000 {
        write(&mut writer, &[7; 100]);
        assert!(writer.status().disk_bytes <= BUDGET_MIN.bytes());
    }
    let status = writer.status();
    assert!(status.disk_bytes > BUDGET_MIN.bytes() / 2);
    let oldest = disk.firsts()[0];
    assert_eq!(status.removed, oldest);
    let newest = gaps(&disk).into_iter().rfind(|gap| gap.reason == GapReason::Budget).unwrap();
    assert_eq!(newest.to, oldest - 1);
    let removed = SpoolGap { from: 0, to: oldest - 1, reason: GapReason::Budget, record: None };
    assert_eq!(gaps(&disk)[0], removed);
    let first = SpoolReader::with_storage(disk, STREAM, None).next().unwrap().unwrap();
    assert!(matches!(first, SpoolItem::Record(record) if record.seq == oldest));
}

#[test]
fn released_segments_are_removed_when_room_is_needed_and_leave_no_gap_record() {
    let scratch = tempfile::tempdir().unwrap();
    let mut writer = SpoolWriter::open(scratch.path(), config(BUDGET_MIN)).unwrap();
    let reader = SpoolReader::open(scratch.path(), STREAM, None).unwrap();
    let mut files = 0;
    let mut fill = |is_released| {
        for _ in 0..50 {
            for _ in 0..20 {
                writer.append(KIND, TIME, &[7; 100]).unwrap();
            }
            let durable = writer.commit().unwrap();
            if is_released {
                reader.release(durable).unwrap();
            }
            files = files.max(std::fs::read_dir(scratch.path()).unwrap().count());
        }
        assert!(writer.status().disk_bytes <= BUDGET_MIN.bytes());
        writer.status().removed
    };
    assert_eq!(fill(true), 0);
    let gaps: Vec<_> = items(SpoolFolder::readable(scratch.path()).unwrap())
        .into_iter()
        .filter(|item| matches!(item, SpoolItem::Gap(gap) if gap.record.is_some()))
        .collect();
    assert!(gaps.is_empty(), "{gaps:?}");
    // Of a note that a power cut took, a part may be left.
    std::fs::write(scratch.path().join("released"), [255; 6]).unwrap();
    assert!(fill(false) > 0 && files >= 7, "{files} files");
}

#[test]
fn numbers_that_were_released_and_are_used_again_are_lost_if_the_budget_removes_them() {
    for records in [0, 3] {
        let disk = SimulatedDisk::new(1);
        for _ in 0..records {
            let mut writer = open(&disk);
            write(&mut writer, b"");
        }
        // A disk has lost what came after.
        disk.release(1 << 40).unwrap();
        let mut writer = open(&disk);
        assert_eq!(disk.released().unwrap(), records);
        for _ in 0..1000 {
            write(&mut writer, &[7; 100]);
        }
        assert!(writer.status().removed > 0, "{records} records");
        assert!(gaps(&disk).iter().any(|gap| gap.reason == GapReason::Budget));
    }
}

#[test]
fn a_full_queue_refuses_records_and_marks_them() {
    let disk = SimulatedDisk::new(1);
    let mut writer = open(&disk);
    let refused = (0..100).filter(|_| writer.append(KIND, TIME, &[7; 100]).is_err()).count() as u64;
    assert!(refused > 0 && writer.queued_bytes() <= 4096);
    assert!(items(disk.clone()).is_empty());
    assert_eq!(writer.commit().unwrap(), 101);
    assert_eq!(writer.append(KIND, TIME, b"").unwrap(), 101);
    writer.commit().unwrap();
    let (from, to, record) = (100 - refused, 99, Some(100));
    assert_eq!(gaps(&disk), [SpoolGap { from, to, reason: GapReason::QueueFull, record }]);
    assert_eq!(records(&items(disk)).len() as u64, 101 - refused);
    assert_eq!(writer.status().refused, refused);
}

#[test]
fn what_a_full_disk_refused_is_a_gap_and_counted_after_kills() {
    for seed in 0..40 {
        let disk = SimulatedDisk::new(seed);
        let noted = || disk.noted().unwrap().unwrap();
        let readable = || records(&items(disk.clone()));
        let mut life = open(&disk);
        (0..5).for_each(|_| assert!(life.append(KIND, TIME, b"kept").is_ok()));
        life.commit().unwrap();
        disk.set_fault(Some(DiskFault { from: 0, count: u64::MAX, kind: ErrorKind::StorageFull }));
        let mut appended = 5;
        for (batch, commits, is_killed) in [(3, 1, seed % 2 == 0), (1, 100, true), (1, 2, false)] {
            let mut taken = 0;
            for _ in 0..commits {
                taken += (0..batch).filter(|_| life.append(KIND, TIME, &[7; 100]).is_ok()).count();
                life.commit().unwrap_err();
            }
            appended += batch * commits;
            assert_eq!((noted().queued, noted().failing_ns != 0), (taken as u64, true));
            if is_killed {
                std::mem::forget(life);
            } else {
                drop(life);
            }
            assert_eq!(noted().failing_ns != 0, is_killed);
            // It finds up to two records of the first batch whole, and a part of the next one.
            life = open(&disk);
            let lost = (appended - readable().len()) as u64;
            assert_eq!((noted().lost + noted().pending, noted().queued), (lost, 0), "seed {seed}");
        }
        disk.set_fault(None);
        write(&mut life, b"new");
        assert_eq!(readable().last_key_value().unwrap().1, b"new");
        assert!(gaps(&disk).iter().any(|gap| gap.reason == GapReason::DiskFull));
        let SpoolNote { lost, pending, queued, failing_ns, .. } = noted();
        let expected = (appended + 1 - readable().len()) as u64;
        assert_eq!((lost, pending, queued, failing_ns), (expected, 0, 0, 0), "seed {seed}");
    }
}

#[test]
fn a_note_about_numbers_that_the_disk_has_lost_hides_none_that_use_them_again() {
    let disk = SimulatedDisk::new(1);
    let lost = SpoolNote { durable: 9, next: 9, removed: 8, ..SpoolNote::default() };
    disk.note(&lost).unwrap();
    drop(open(&disk));
    assert_eq!(disk.noted().unwrap(), Some(SpoolNote::default()));
}

#[test]
fn refused_records_keep_the_stream_within_its_budget() {
    let disk = SimulatedDisk::new(1);
    let mut writer = open(&disk);
    let mut random = SpoolRandom(4);
    let mut gaps_seen = 0;
    for _ in 0..600 {
        for _ in 0..random.below(80) {
            drop(writer.append(KIND, TIME, &[7; 100]));
        }
        writer.commit().unwrap();
        assert!(writer.status().disk_bytes <= BUDGET_MIN.bytes(), "{:?}", writer.status());
        gaps_seen += u64::from(writer.status().refused > 0);
    }
    assert!(gaps_seen > 500 && writer.status().removed > 0);
    records(&items(disk));
}

#[test]
fn the_number_of_segments_is_bounded() {
    let disk = SimulatedDisk::new(1);
    let open = || SpoolWriter::with_storage(disk.clone(), config(ByteSize::gib(1))).unwrap();
    // Segments of earlier writers, such as those of a program that crashes again and again.
    for seq in 0..6000 {
        drop(disk.add(seq));
    }
    let mut writer = open();
    for _ in 0..2 {
        write(&mut writer, b"x");
    }
    assert_eq!(disk.firsts().len(), 4096);
    assert!(gaps(&disk).iter().any(|gap| gap.reason == GapReason::Budget));
}

#[test]
fn a_record_that_is_too_long_gets_no_number() {
    let disk = SimulatedDisk::new(1);
    let mut writer = open(&disk);
    let error = writer.append(KIND, TIME, &[0; 2049]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "a record of stream `logs` has 2049 bytes, above the maximum of 2048"
    );
    assert_eq!(writer.append(KIND, TIME, &[0; 2048]).unwrap(), 0);
}

#[test]
fn a_wrong_name_or_budget_is_refused() {
    let open = |config| SpoolWriter::with_storage(SimulatedDisk::new(1), config).unwrap_err();
    let mut wrong = config(ByteSize::kib(63));
    assert!(matches!(open(wrong.clone()), SpoolError::Budget { .. }));
    wrong.stream = "x".repeat(65);
    assert!(matches!(open(wrong), SpoolError::Name { .. }));
}
