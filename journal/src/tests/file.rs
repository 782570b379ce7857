//! Tests journals as files: complete, truncated at every byte, and on a full disk.

use std::io::{self, Write};

use super::*;

#[test]
fn a_journal_is_read_back_with_its_header_and_end() {
    let mut random = Xorshift(11);
    let entries: Vec<_> = (0..3000).map(|_| any_entry(&mut random, 2)).collect();
    let header = header(2);
    let bytes = journal(&header, &entries, usize::MAX);
    let mut reader = JournalReader::open(bytes.as_slice()).unwrap();
    assert_eq!((reader.header(), reader.end()), (&header, None));
    let (read, error) = read_all(&mut reader);
    assert!(error.is_none() && read == entries);
    assert_eq!(reader.end(), Some(&end(3000)));
    assert_eq!((reader.truncated(), reader.torn_bytes(), reader.unknown_blocks()), (false, 0, 0));
    // Further calls return the end again.
    assert_eq!(reader.next().unwrap(), None);
}

#[test]
fn a_reader_accepts_reads_of_any_length() {
    struct Drip<'b>(&'b [u8], bool);
    impl io::Read for Drip<'_> {
        fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
            self.1 = !self.1;
            if self.1 {
                return Err(io::ErrorKind::Interrupted.into());
            }
            let n = buffer.len().min(self.0.len()).min(3);
            buffer[..n].copy_from_slice(&self.0[..n]);
            self.0 = &self.0[n..];
            Ok(n)
        }
    }
    let entries = usual_entries(2, 50);
    let bytes = journal(&header(2), &entries, 7);
    let mut reader = JournalReader::open(Drip(&bytes, false)).unwrap();
    assert_eq!(read_all(&mut reader).0, entries);
}

#[test]
fn a_journal_truncated_at_any_byte_has_its_complete_blocks() {
    let entries = usual_entries(2, 12);
    let header = header(2);
    let mut writer = JournalWriter::begin(Vec::new(), &header).unwrap();
    let header_len = writer_len(&mut writer);
    // The length after each block, and the number of wakes until then.
    let mut blocks = vec![(header_len, 0)];
    for (index, entry) in entries.iter().enumerate() {
        writer.wake(entry).unwrap();
        if index % 3 == 2 {
            blocks.push((writer_len(&mut writer), index + 1));
        }
    }
    let bytes = writer.finish(&end(12)).unwrap();
    for cut in 0..bytes.len() {
        let opened = JournalReader::open(&bytes[..cut]);
        if cut < header_len {
            assert!(
                matches!(opened, Err(JournalError::NoHeader { bytes }) if bytes == cut as u64),
                "{cut}"
            );
            continue;
        }
        let mut reader = opened.unwrap();
        let (read, error) = read_all(&mut reader);
        let (whole, wakes) = *blocks.iter().rev().find(|(len, _)| *len <= cut).unwrap();
        assert!(error.is_none(), "{cut}: {error:?}");
        assert_eq!(read, entries[..wakes], "{cut}");
        assert!(reader.truncated() && reader.end().is_none(), "{cut}");
        assert_eq!(reader.torn_bytes(), (cut - whole) as u64, "{cut}");
    }
}

fn writer_len(writer: &mut JournalWriter<Vec<u8>>) -> usize {
    writer.flush().unwrap();
    writer.written().len()
}

#[test]
fn zeros_at_the_end_after_a_loss_of_power_are_a_torn_block() {
    let entries = usual_entries(1, 4);
    let mut writer = JournalWriter::begin(Vec::new(), &header(1)).unwrap();
    entries.iter().for_each(|entry| writer.wake(entry).unwrap());
    writer.flush().unwrap();
    let whole = writer.written().clone();
    for zeros in [1, HEAD_LEN, 4096, 10_000] {
        let mut bytes = whole.clone();
        bytes.resize(whole.len() + zeros, 0);
        let mut reader = JournalReader::open(bytes.as_slice()).unwrap();
        let (read, error) = read_all(&mut reader);
        assert!(error.is_none() && read == entries, "{zeros}: {error:?}");
        assert_eq!((reader.truncated(), reader.torn_bytes()), (true, zeros as u64));
        if zeros > HEAD_LEN {
            *bytes.last_mut().unwrap() = 1;
            let (_, error) = read_all(&mut JournalReader::open(bytes.as_slice()).unwrap());
            let is_damaged = matches!(error, Some(JournalError::Damaged { why: Damage::Head, .. }));
            assert!(is_damaged, "{zeros}");
        }
    }
}

#[test]
fn a_long_journal_is_written_in_blocks_of_256_wakes() {
    let entries = usual_entries(2, 20_000);
    let bytes = journal(&header(2), &entries, usize::MAX);
    let offsets = offsets(&bytes);
    let lengths: Vec<_> = offsets.windows(2).map(|pair| pair[1] - pair[0] - HEAD_LEN).collect();
    let wakes = &lengths[1..lengths.len() - 1];
    assert_eq!(wakes.len(), 20_000_usize.div_ceil(256), "{lengths:?}");
    assert!(wakes.iter().all(|len| (256..32_000).contains(len)), "{lengths:?}");
}

/// Accepts `room` bytes, then fails in the middle of a write.
struct FullDisk {
    room: usize,
    bytes: Vec<u8>,
}

impl Write for FullDisk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = bytes.len().min(self.room);
        if n == 0 && !bytes.is_empty() {
            // Later writes would succeed, but the writer must not try.
            self.room = usize::MAX;
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.room -= n;
        self.bytes.extend_from_slice(&bytes[..n]);
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[test]
fn nothing_is_written_after_a_block_torn_by_a_full_disk() {
    let entries = usual_entries(1, 6);
    let begin = journal(&header(1), &[], 1).len();
    for room in [begin, begin + 1, begin + 20, begin + 60] {
        let disk = FullDisk { room, bytes: Vec::new() };
        let mut writer = JournalWriter::begin(disk, &header(1)).unwrap();
        let failed = entries
            .iter()
            .position(|entry| writer.wake(entry).and_then(|()| writer.flush()).is_err())
            .unwrap();
        let torn = writer.written().bytes.clone();
        assert!(writer.wake(&entries[0]).is_err() && writer.flush().is_err());
        assert_eq!(writer.written().bytes, torn);
        assert!(writer.finish(&end(0)).is_err());
        let mut reader = JournalReader::open(torn.as_slice()).unwrap();
        let (read, error) = read_all(&mut reader);
        assert!(error.is_none() && reader.truncated());
        assert_eq!(read, entries[..failed]);
    }
}

#[test]
fn a_wake_that_readers_refuse_is_omitted_and_the_next_one_is_written() {
    let entries = usual_entries(1, 3);
    let mut writer = JournalWriter::begin(Vec::new(), &header(1)).unwrap();
    writer.wake(&entries[0]).unwrap();
    let trigger = any_trigger(&mut Xorshift(5));
    let long = Map::from_iter([("x".to_owned(), json!("y".repeat(ATTRIBUTES_MAX)))]);
    let triggers: [Vec<Trigger>; 3] = [
        vec![trigger.clone(); TRIGGERS_MAX + 1],
        vec![Trigger { attributes: long, ..trigger.clone() }],
        vec![Trigger { score: Some(f64::NAN), ..trigger.clone() }],
    ];
    for triggers in triggers {
        let error = writer.wake(&JournalEntry { triggers, ..entries[1].clone() }).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::InvalidInput);
    }
    let message = "m".repeat(3 << 20);
    let fault = Fault { kind: gleaner_lambda::FaultKind::Trap, message, used: None, allowed: None };
    for refused in [
        JournalEntry { fault: Some(fault), ..entries[1].clone() },
        JournalEntry { seen: vec![InputView::default(); 2], ..entries[1].clone() },
    ] {
        assert_eq!(writer.wake(&refused).unwrap_err().kind(), io::ErrorKind::InvalidInput);
    }
    writer.wake(&entries[2]).unwrap();
    let bytes = writer.finish(&end(2)).unwrap();
    let (read, error) = read_all(&mut JournalReader::open(bytes.as_slice()).unwrap());
    assert!(error.is_none());
    assert_eq!(read, [entries[0].clone(), entries[2].clone()]);
}

#[test]
fn the_largest_wake_that_the_host_allows_fits() {
    let text = "\u{1}".repeat(1024);
    let attributes: Map<_, _> = (0..16).map(|n| (format!("{n:\u{1}>64}"), json!(text))).collect();
    let trigger =
        Trigger { kind: TriggerKind::Event, label: "l".repeat(128), score: Some(1.0), attributes };
    let fault = Fault {
        kind: gleaner_lambda::FaultKind::Trap,
        message: "m".repeat(4096),
        used: Some(1),
        allowed: Some(1),
    };
    let mut entries = usual_entries(1, 3);
    entries[1].triggers = vec![trigger; 16];
    entries[1].fault = Some(fault);
    let bytes = journal(&header(1), &entries, usize::MAX);
    let (read, error) = read_all(&mut JournalReader::open(bytes.as_slice()).unwrap());
    assert!(error.is_none() && read == entries, "{error:?}");
}

#[test]
fn a_header_that_readers_refuse_is_not_written() {
    let begin = |header: &JournalHeader| {
        JournalWriter::begin(Vec::new(), header).err().map(|error| error.kind())
    };
    assert_eq!(begin(&header(INPUTS_MAX)), None);
    assert_eq!(begin(&header(INPUTS_MAX + 1)), Some(io::ErrorKind::InvalidInput));
    assert_eq!(
        begin(&JournalHeader { event_input: Some(2), ..header(2) }),
        Some(io::ErrorKind::InvalidInput)
    );
    let long = JournalHeader { engine: "x".repeat(3 << 20), ..header(2) };
    assert_eq!(begin(&long), Some(io::ErrorKind::InvalidInput));
}
