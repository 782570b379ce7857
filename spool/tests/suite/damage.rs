//! Bytes of the last segment are changed, cut off or added; segments go missing.

use std::collections::BTreeMap;
use std::io::ErrorKind::Other;

use gleaner_base::{ByteSize, Explain};
use gleaner_spool::{
    BUDGET_MIN, GapReason, SpoolGap, SpoolItem, SpoolReader, SpoolStorage, SpoolWriter,
};
use gleaner_test_support::simulated_disk::{DiskFault, SimulatedDisk};

use crate::model::{KIND, STREAM, TIME, config, items, open, records, write};

const RECORDS: u64 = 40;

/// A stream of three segments; all is acknowledged.
fn stream() -> (SimulatedDisk, BTreeMap<u64, Vec<u8>>) {
    let disk = SimulatedDisk::new(3);
    for _ in 0..3 {
        let mut writer = open(&disk);
        for _ in 0..RECORDS {
            let seq = writer.status().next;
            writer.append(KIND, TIME, &vec![seq as u8; seq as usize % 23]).unwrap();
            if seq.is_multiple_of(7) {
                writer.commit().unwrap();
            }
        }
        assert_eq!(writer.commit().unwrap(), writer.status().next);
    }
    let records = records(&items(disk.clone()));
    assert_eq!((disk.firsts(), records.len()), (vec![0, 40, 80], 120));
    (disk, records)
}

/// Reads the stream, continues it with a new writer, and reads it again. Returns the number of
/// records before that.
fn read_and_continue(disk: &SimulatedDisk, original: &BTreeMap<u64, Vec<u8>>) -> usize {
    let kept = records(&items(disk.clone()));
    assert!(kept.iter().all(|(seq, payload)| original[seq] == *payload));
    let mut writer = open(disk);
    let seq = writer.append(KIND, TIME, b"new").unwrap();
    writer.commit().unwrap();
    let mut now = records(&items(disk.clone()));
    assert_eq!(now.remove(&seq).unwrap(), b"new");
    assert_eq!(now, kept, "a writer changes no record of another one");
    kept.len()
}

/// Applies `change` at each offset of segment `first`, and calls `check` before it is undone.
fn at_each_offset(
    disk: &SimulatedDisk,
    first: u64,
    change: impl Fn(&mut Vec<u8>, usize),
    check: impl Fn(usize),
) {
    let before = disk.with_content(first, |content| content.clone());
    for at in 0..before.len() {
        disk.with_content(first, |content| change(content, at));
        check(at);
        disk.with_content(first, |content| content.clone_from(&before));
    }
}

/// Applies `change` at each offset of the last segment.
fn with_change(change: impl Fn(&mut Vec<u8>, usize)) {
    let (disk, original) = stream();
    at_each_offset(&disk, 80, change, |at| {
        let kept = read_and_continue(&disk, &original);
        // Without a header, nothing in the segment can be trusted.
        assert!(if at < 128 { kept == 80 } else { (80..120).contains(&kept) }, "byte {at}: {kept}");
        for first in disk.firsts().into_iter().filter(|first| *first >= 80) {
            disk.remove(first).unwrap();
        }
        drop(disk.add(80));
    });
}

#[test]
fn a_flipped_bit_at_any_offset_is_detected_and_costs_one_record() {
    for bit in [0, 7] {
        let (disk, original) = stream();
        let flip = |content: &mut Vec<u8>, at| content[at] ^= 1 << bit;
        at_each_offset(&disk, 80, flip, |at| {
            let found = items(disk.clone());
            let lost = 120 - records(&found).len();
            assert_eq!(lost, if at < 128 { 40 } else { 1 }, "byte {at}");
            let is_torn = matches!(found.last(), Some(SpoolItem::Torn(_)));
            let is_gap = found.iter().any(
                |item| matches!(item, SpoolItem::Gap(gap) if gap.reason == GapReason::Damaged),
            );
            assert!(is_torn != is_gap, "byte {at}: {found:?}");
            // No number is used again: the writer cannot know whether the record was acknowledged.
            assert!(open(&disk).status().next >= 120, "byte {at}");
        });
        read_and_continue(&disk, &original);
    }
}

#[test]
fn a_flipped_bit_uses_no_number_twice_after_refused_records() {
    for bit in [0, 7] {
        let disk = SimulatedDisk::new(3);
        let mut writer = open(&disk);
        // Records before the refused ones, and behind them.
        for count in [3, 1000, 2, 500, 4] {
            for _ in 0..count {
                drop(writer.append(KIND, TIME, b"a record of some bytes"));
            }
            writer.commit().unwrap();
        }
        let (next, refused) = (writer.status().next, writer.status().refused);
        assert!(refused > 1000, "{refused} refused");
        let last = *disk.firsts().last().unwrap();
        let flip = |content: &mut Vec<u8>, at| content[at] ^= 1 << bit;
        at_each_offset(&disk, last, flip, |at| {
            records(&items(disk.clone()));
            let found = open(&disk).status().next;
            assert!(found >= next, "byte {at}: {found}");
        });
    }
}

#[test]
fn a_segment_cut_off_at_any_offset_keeps_what_is_before() {
    with_change(|content, at| content.truncate(at));
}

#[test]
fn zeros_and_remains_of_other_records_are_not_taken_for_records() {
    with_change(|content, at| content[at..].fill(0));
    with_change(|content, at| {
        content.truncate(at);
        content.extend_from_within(at.min(128)..at.min(300));
        content.push(1);
    });
}

#[test]
fn a_missing_segment_is_a_gap() {
    let (disk, _) = stream();
    disk.remove(40).unwrap();
    let found = items(disk.clone());
    let missing = SpoolGap { from: 40, to: 79, reason: GapReason::Missing, record: None };
    assert!(found.contains(&SpoolItem::Gap(missing)));
    assert_eq!(records(&found).len(), 80);
}

#[test]
fn a_torn_tail_is_reported_once_and_then_marked() {
    let (disk, _) = stream();
    disk.with_content(80, |content| content.truncate(content.len() - 1));
    let mut reader = SpoolReader::with_storage(disk.clone(), STREAM, Some(110));
    assert_eq!(reader.by_ref().filter(|item| matches!(item, Ok(SpoolItem::Torn(_)))).count(), 1);
    assert!(reader.next().is_none(), "nothing is new");
    let mut writer = open(&disk);
    assert_eq!((writer.durable(), writer.status().next), (119, 122));
    writer.commit().unwrap();
    let writer = SpoolWriter::with_storage(disk, config(BUDGET_MIN)).unwrap();
    assert_eq!(writer.durable(), writer.status().next);
    let Some(Ok(SpoolItem::Gap(gap))) = reader.next() else { panic!("no gap") };
    assert_eq!((gap.from, gap.reason), (119, GapReason::Torn));
    assert!(reader.next().is_none());
}

#[test]
fn a_record_in_the_payload_of_another_is_not_taken_for_one_behind_damage() {
    let disk = SimulatedDisk::new(3);
    let large = || config(ByteSize::mib(1));
    let mut writer = SpoolWriter::with_storage(disk.clone(), large()).unwrap();
    write(&mut writer, b"first");
    // The only bytes with the right salt are those of the segment, which a lambda cannot read. A
    // copy of the first record has an old number.
    let copy = disk.with_content(0, |content| content[128..].to_vec());
    for _ in 0..3 {
        writer.append(KIND, TIME, &copy).unwrap();
    }
    writer.commit().unwrap();
    disk.with_content(0, |content| content[128 + copy.len()] ^= 1);
    let kept: Vec<u64> = records(&items(disk)).into_keys().collect();
    assert_eq!(kept, [0, 2, 3]);
}

#[test]
fn an_unreadable_sector_anywhere_costs_its_records_and_blocks_nothing() {
    const BLOCK: u64 = 4096;
    let large = || config(ByteSize::mib(1));
    // Of the last segment, and of one before it.
    for last in [true, false] {
        for sector in 0..12 {
            let disk = SimulatedDisk::new(3);
            let mut writer = SpoolWriter::with_storage(disk.clone(), large()).unwrap();
            for seq in 0..60_u64 {
                write(&mut writer, &[seq as u8; 710]);
            }
            if !last {
                writer = SpoolWriter::with_storage(disk.clone(), large()).unwrap();
                write(&mut writer, b"another segment");
            }
            let next = writer.status().next;
            disk.set_unreadable(0, sector * BLOCK..(sector + 1) * BLOCK);
            let found = items(disk.clone());
            let lost = next as usize - records(&found).len();
            if sector == 0 {
                assert_eq!(lost, 60, "without the header, nothing can be trusted");
            } else {
                assert!((1..=7).contains(&lost), "sector {sector}: {lost} records lost");
            }
            let writer = SpoolWriter::with_storage(disk.clone(), large()).unwrap();
            assert!(writer.status().next >= next, "sector {sector}");
        }
    }
}

#[test]
fn a_segment_that_cannot_be_opened_is_named_by_the_error() {
    let disk = SimulatedDisk::new(3);
    let mut writer = open(&disk);
    write(&mut writer, b"one");
    let fault = |after| DiskFault { from: disk.operations() + after, count: 1, kind: Other };
    let mut reader = SpoolReader::with_storage(disk.clone(), STREAM, None);
    disk.set_fault(Some(fault(2)));
    let error = reader.next().unwrap().unwrap_err();
    assert_eq!(
        error.to_string(),
        "cannot read segment `00000000000000000000.seg` of stream `logs`"
    );
    assert!(error.help().unwrap().contains("remove it if it is not a segment"));
    disk.set_fault(Some(fault(1)));
    let error = reader.next().unwrap().unwrap_err();
    assert_eq!(error.to_string(), "cannot read the spool of stream `logs`");
    assert!(matches!(reader.next(), Some(Ok(SpoolItem::Record(_)))));
}

#[test]
fn a_segment_that_leaves_too_few_numbers_is_refused_with_its_name() {
    for first in [(1 << 62) + 1, (1 << 63) - 1] {
        let disk = SimulatedDisk::new(3);
        drop(disk.add(first));
        let error = SpoolWriter::with_storage(disk, config(BUDGET_MIN)).unwrap_err();
        let name = format!("segment `{first:020}.seg` of stream `logs` leaves too few numbers");
        assert_eq!(error.to_string(), name);
        assert!(error.help().unwrap().contains("remove it if it is not a segment"));
    }
    // All that a writer accepts can be read.
    let disk = SimulatedDisk::new(3);
    drop(disk.add(1 << 62));
    let mut writer = open(&disk);
    assert_eq!(write(&mut writer, b"one"), (1 << 62) + 1);
    let read = SpoolReader::with_storage(disk, STREAM, None).next();
    assert!(matches!(read, Some(Ok(SpoolItem::Record(record))) if record.seq == 1 << 62));
}
