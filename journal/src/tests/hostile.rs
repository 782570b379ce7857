//! Tests manipulated journals: each change is found, and none makes the reader panic or allocate.

use super::*;

/// Reads all of `bytes`; returns the wakes, and whether the journal is truncated.
fn outcome(bytes: &[u8]) -> Result<(Vec<JournalEntry>, bool), JournalError> {
    let mut reader = JournalReader::open(bytes)?;
    match read_all(&mut reader) {
        (entries, None) => Ok((entries, reader.truncated())),
        (_, Some(error)) => Err(error),
    }
}

fn damage<T: std::fmt::Debug>(outcome: Result<T, JournalError>) -> Damage {
    match outcome {
        Err(JournalError::Damaged { why, .. }) => why,
        other => panic!("{other:?}"),
    }
}

#[test]
fn any_changed_byte_of_a_finished_journal_is_found() {
    let mut random = Xorshift(21);
    let mut entries = usual_entries(2, 5);
    entries.push(any_entry(&mut random, 2));
    let bytes = journal(&header(2), &entries, 3);
    assert!(outcome(&bytes).is_ok());
    for at in 0..bytes.len() {
        for change in (0..8).map(|bit| 1 << bit).chain([0xff, random.next() as u8 | 1]) {
            let mut changed = bytes.clone();
            changed[at] ^= change;
            let error = outcome(&changed).expect_err("a changed byte");
            match at {
                0..8 => assert!(matches!(error, JournalError::NotAJournal), "{at}: {error:?}"),
                8..10 => assert!(matches!(error, JournalError::Version { .. }), "{at}: {error:?}"),
                _ => assert!(
                    matches!(error, JournalError::Damaged { offset, .. } if offset <= at as u64),
                    "{at}: {error:?}"
                ),
            }
        }
    }
}

#[test]
fn damage_is_located_by_its_block_and_the_wakes_before_it() {
    let entries = usual_entries(1, 9);
    let mut bytes = journal(&header(1), &entries, 3);
    let at = offsets(&bytes)[2];
    bytes[at + HEAD_LEN + 4] ^= 1;
    let mut reader = JournalReader::open(bytes.as_slice()).unwrap();
    let (read, error) = read_all(&mut reader);
    assert_eq!(read, entries[..3]);
    let error = error.unwrap();
    assert_eq!(
        error.to_string(),
        format!("the journal is damaged in block 2, at byte {at}, after 3 wakes")
    );
    assert_eq!(
        std::error::Error::source(&error).unwrap().to_string(),
        "the checksum of the block is wrong"
    );
    let help = "it was changed after it was written: copy it again, or write a new one";
    assert_eq!((error.help().as_deref(), error.exit()), (Some(help), Exit::Usage));
    // It stays damaged, and is not truncated.
    assert!(matches!(reader.next(), Err(JournalError::Damaged { block: 2, wake: 3, .. })));
    assert!(!reader.truncated() && reader.end().is_none());
}

#[test]
fn a_missing_duplicate_or_moved_block_is_found() {
    let entries = usual_entries(1, 9);
    let bytes = journal(&header(1), &entries, 3);
    let cuts = offsets(&bytes);
    let block = |n: usize| &bytes[cuts[n]..cuts[n + 1]];
    let read = |blocks: &[usize]| {
        let mut all = bytes[..PREAMBLE_LEN].to_vec();
        blocks.iter().for_each(|n| all.extend_from_slice(block(*n)));
        outcome(&all)
    };
    assert_eq!(read(&[0, 1, 2, 3, 4]).unwrap(), (entries, false));
    for order in
        [&[0, 2, 3, 4][..], &[0, 1, 1, 2, 3, 4], &[0, 2, 1, 3, 4], &[0, 1, 3, 4], &[1, 2, 3, 4]]
    {
        assert_eq!(damage(read(order)), Damage::Head, "{order:?}");
    }
    assert_eq!(damage(read(&[0, 1, 2, 3, 4, 4])), Damage::AfterEnd);
}

#[test]
fn invalid_blocks_with_correct_checksums_are_refused() {
    let header = header(1);
    let first = header_block(&header);
    let why = |blocks: &[(u8, Vec<u8>)]| damage(outcome(&journal_of(blocks)));
    let end = (kind::END, serde_json::to_vec(&end(0)).unwrap());
    assert_eq!(why(std::slice::from_ref(&end)), Damage::NotAHeader { kind: kind::END });
    assert_eq!(why(&[first.clone(), first.clone()]), Damage::SecondHeader);
    assert_eq!(why(&[first.clone(), end.clone(), end]), Damage::AfterEnd);
    assert!(matches!(why(&[first.clone(), (kind::END, b"{}".to_vec())]), Damage::Json(_)));
    assert!(matches!(why(&[(kind::HEADER, b"[".repeat(100_000))]), Damage::Json(_)));
    let many = JournalHeader { inputs: vec![header.inputs[0].clone(); 257], ..header.clone() };
    assert_eq!(why(&[header_block(&many)]), Damage::Inputs { found: 257 });
    let nowhere = JournalHeader { event_input: Some(1), ..header };
    assert_eq!(why(&[header_block(&nowhere)]), Damage::EventInput);
    let wakes = |payload: &[u8]| why(&[first.clone(), (kind::WAKES, payload.to_vec())]);
    assert_eq!(wakes(&[]), Damage::Wake(MalformedWake::Short));
    assert_eq!(wakes(&[0, 0]), Damage::AfterWakes);
    assert_eq!(wakes(&[1, 1, 0, 0, 0]), Damage::AfterWakes);
    assert_eq!(wakes(&[2, 1, 0, 0]), Damage::Wake(MalformedWake::Short));
    let claim = [&[0xff; 9][..], &[1], &[1, 0, 0]].concat();
    assert_eq!(wakes(&claim), Damage::Wake(MalformedWake::Short));
}

#[test]
fn a_journal_with_bytes_after_its_end_is_damaged() {
    let end = (kind::END, serde_json::to_vec(&end(0)).unwrap());
    let bytes = journal_of(&[header_block(&header(1)), end.clone(), end]);
    let mut reader = JournalReader::open(bytes.as_slice()).unwrap();
    assert!(reader.next().is_err() && reader.end().is_none());
}

#[test]
fn a_block_of_an_unknown_kind_is_skipped_and_counted() {
    let mut payload = vec![1];
    let entry = usual_entries(1, 1).remove(0);
    Encoder::new(1).encode(&entry, &mut payload);
    let blocks =
        [header_block(&header(1)), (200, vec![1, 2, 3]), (kind::WAKES, payload), (0, Vec::new())];
    let bytes = journal_of(&blocks);
    let mut reader = JournalReader::open(bytes.as_slice()).unwrap();
    assert_eq!(read_all(&mut reader).0, [entry]);
    assert_eq!((reader.unknown_blocks(), reader.truncated()), (2, true));
}

#[test]
fn keys_of_a_newer_header_are_ignored() {
    let mut json = serde_json::to_value(header(1)).unwrap();
    json.as_object_mut().unwrap().insert("mood".to_owned(), json!({"x": [1]}));
    let bytes = journal_of(&[(kind::HEADER, serde_json::to_vec(&json).unwrap())]);
    assert_eq!(JournalReader::open(bytes.as_slice()).unwrap().header(), &header(1));
}

#[test]
fn an_impossible_length_is_damage_and_allocates_nothing() {
    let mut bytes = journal_of(&[header_block(&header(1))]);
    let head = Head { kind: kind::WAKES, len: u32::MAX, payload_crc: 0 };
    bytes.extend_from_slice(&head.to_bytes(1));
    assert_eq!(damage(outcome(&bytes)), Damage::TooLong { len: u32::MAX });
}

#[test]
fn other_versions_and_other_files_are_refused_with_help() {
    let mut newer = journal(&header(1), &[], 1);
    newer[8] = 2;
    let error = outcome(&newer).unwrap_err();
    assert_eq!(error.to_string(), "the journal has format version 2; this gleaner reads version 1");
    assert_eq!(
        (error.help().as_deref(), error.exit()),
        (Some("use the gleaner that wrote it"), Exit::Usage)
    );
    for other in [&b"\x89MCAP0\r\n and so on, for long enough"[..], b"{", b"\x89GLJRN\n\n"] {
        assert!(matches!(outcome(other), Err(JournalError::NotAJournal)));
    }
    let error = outcome(b"").unwrap_err();
    assert_eq!(error.to_string(), "the journal ends after 0 bytes, within its header");
}

#[test]
fn a_failed_read_is_final() {
    struct Broken(Vec<u8>, usize);
    impl std::io::Read for Broken {
        fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
            let rest = &self.0[self.1..];
            if rest.is_empty() {
                self.1 = 0;
                return Err(std::io::Error::other("gone"));
            }
            let n = rest.len().min(buffer.len());
            buffer[..n].copy_from_slice(&rest[..n]);
            self.1 += n;
            Ok(n)
        }
    }
    let bytes = journal_of(&[header_block(&header(1))]);
    let mut reader = JournalReader::open(Broken(bytes, 0)).unwrap();
    for _ in 0..2 {
        let error = reader.next().unwrap_err();
        assert!(matches!(error, JournalError::Read { .. }));
        assert_eq!(error.exit(), Exit::Internal);
    }
}

#[test]
fn no_change_of_a_wake_makes_the_decoder_panic() {
    let mut random = Xorshift(22);
    for inputs in [0, 1, 3] {
        let (mut encoder, mut bytes) = (Encoder::new(inputs), Vec::new());
        (0..40).for_each(|_| encoder.encode(&any_entry(&mut random, inputs), &mut bytes));
        let mut payload = vec![40];
        payload.extend_from_slice(&bytes);
        for _ in 0..4000 {
            let mut changed = payload.clone();
            for _ in 0..=random.below(4) {
                let at = random.below(changed.len() as u64) as usize;
                match random.below(4) {
                    0 => changed.truncate(at + 1),
                    1 => changed.insert(at, random.next() as u8),
                    2 => changed[at] = 0xff,
                    _ => changed[at] = random.next() as u8,
                }
            }
            // The checksums are correct, so that the decoder has to find the change.
            let bytes = journal_of(&[header_block(&header(inputs)), (kind::WAKES, changed)]);
            let _ = outcome(&bytes);
        }
        for _ in 0..4000 {
            let noise: Vec<_> = (0..random.below(60)).map(|_| random.next() as u8).collect();
            let mut rest = noise.as_slice();
            let mut decoder = Decoder::new(inputs);
            while decoder.decode(&mut rest).is_ok() && !rest.is_empty() {}
        }
    }
}

#[test]
fn counts_in_a_wake_are_checked_before_memory_is_allocated() {
    let decode =
        |inputs: usize, bytes: &[u8]| Decoder::new(inputs).decode(&mut &*bytes).unwrap_err();
    let (tick, triggers, fault, log) = (1_u8, 1 << 4, 1 << 5, 1 << 6);
    assert_eq!(decode(1 << 40 >> 20, &[tick, 0, 0]), MalformedWake::Short);
    assert_eq!(decode(0, &[]), MalformedWake::Short);
    assert_eq!(decode(0, &[tick, 0x80]), MalformedWake::Short);
    assert_eq!(decode(0, &[&[tick][..], &[0xff; 10]].concat()), MalformedWake::Number);
    assert_eq!(decode(0, &[1 << 7, 0]), MalformedWake::Unknown { what: "flags", value: 0x80 });
    assert_eq!(decode(0, &[tick | 2, 0]), MalformedWake::Unknown { what: "flags", value: 3 });
    assert_eq!(decode(0, &[tick | triggers, 0, 65]), MalformedWake::Triggers { found: 65 });
    assert_eq!(decode(0, &[tick | triggers, 0, 64]), MalformedWake::Short);
    let kind = MalformedWake::Unknown { what: "kind of trigger", value: 3 };
    assert_eq!(decode(0, &[tick | triggers, 0, 1, 3, 0, 0]), kind);
    let long_label = [tick | triggers, 0, 1, 0, 0xff, 0xff, 0xff, 0xff, 0x7f];
    assert_eq!(decode(0, &long_label), MalformedWake::Short);
    assert_eq!(decode(0, &[tick | triggers, 0, 1, 0, 1, 0xff, 0]), MalformedWake::Text);
    let nan = [&[tick | triggers, 0, 1, 4, 0][..], &f64::NAN.to_le_bytes(), &[0]].concat();
    assert_eq!(decode(0, &nan), MalformedWake::Score);
    let found = ATTRIBUTES_MAX as u64 + 1;
    assert_eq!(
        decode(0, &[tick | triggers, 0, 1, 0, 0, 0x81, 0x80, 8]),
        MalformedWake::LongAttributes { found }
    );
    assert_eq!(decode(0, &[tick | triggers, 0, 1, 0, 0, 2, b'[', b']']), MalformedWake::Attributes);
    let mut deep = vec![tick | triggers, 0, 1, 0, 0, 0x80, 0x80, 4];
    deep.extend(br#"{"a":"#.repeat(1 << 14));
    assert_eq!(decode(0, &deep), MalformedWake::Attributes);
    let kind = MalformedWake::Unknown { what: "kind of fault", value: 8 | 7 << 5 };
    assert_eq!(decode(0, &[tick | fault, 0, 8 | 7 << 5, 0]), kind);
    assert_eq!(
        decode(0, &[tick | log, 0, 0xff, 0xff, 0xff, 0xff, 0x7f, 0, 0, 0, 0]),
        MalformedWake::Number
    );
    let form = MalformedWake::Unknown { what: "form of a newest sample", value: 1 };
    assert_eq!(decode(1, &[tick, 0, 1 << 5, 1, 0]), form);
    let overflow = [&[tick, 0, 31][..], &[0xff; 9], &[1]].concat();
    assert_eq!(decode(1, &overflow), MalformedWake::Number);
}
