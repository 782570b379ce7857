//! Tests the encoding of wakes: relative to each other and alone, and its size.

use super::*;

#[test]
fn any_wake_is_decoded_as_encoded_relative_to_any_other() {
    let mut random = Xorshift(1);
    for inputs in [0, 1, 2, 7] {
        let entries: Vec<_> = (0..2000).map(|_| any_entry(&mut random, inputs)).collect();
        let (mut encoder, mut bytes) = (Encoder::new(inputs), Vec::new());
        entries.iter().for_each(|entry| encoder.encode(entry, &mut bytes));
        let (mut decoder, mut rest) = (Decoder::new(inputs), bytes.as_slice());
        for entry in &entries {
            let read = decoder.decode(&mut rest).unwrap();
            assert_eq!(read, *entry);
            assert_eq!(read.differs_from(entry, &[], true), None);
        }
        assert!(rest.is_empty());
    }
}

#[test]
fn after_a_reset_a_wake_is_decoded_alone() {
    let mut random = Xorshift(2);
    let mut encoder = Encoder::new(2);
    for _ in 0..500 {
        let entry = any_entry(&mut random, 2);
        let (mut alone, mut reset) = (Vec::new(), Vec::new());
        Encoder::new(2).encode(&entry, &mut alone);
        encoder.reset();
        encoder.encode(&entry, &mut reset);
        assert_eq!(alone, reset);
        assert_eq!(Decoder::new(2).decode(&mut reset.as_slice()), Ok(entry));
    }
}

#[test]
fn a_usual_wake_takes_few_bytes() {
    for (inputs, max_bytes) in [(1, 14), (2, 20)] {
        let entries = usual_entries(inputs, 1000);
        let (mut encoder, mut bytes) = (Encoder::new(inputs), Vec::new());
        let mut longest = 0;
        for (index, entry) in entries.iter().enumerate() {
            let before = bytes.len();
            encoder.encode(entry, &mut bytes);
            // The first one has no previous wake, and the second no rate.
            longest = if index < 2 { 0 } else { longest.max(bytes.len() - before) };
        }
        assert!(longest <= max_bytes, "{longest} bytes for a wake with {inputs} inputs");
        let file = journal(&header(inputs), &entries, usize::MAX).len();
        let without = journal(&header(inputs), &[], usize::MAX).len();
        assert!(file - without <= max_bytes * entries.len(), "{} bytes of wakes", file - without);
    }
}

#[test]
fn a_tick_without_new_samples_takes_two_bytes_and_one_for_each_input() {
    let tick = |at_ns| JournalEntry {
        at_ns,
        seen: vec![InputView { newest: Some(([1; 16], 5)), ..InputView::default() }; 3],
        ..JournalEntry::default()
    };
    let (mut encoder, mut bytes) = (Encoder::new(3), Vec::new());
    for n in 0..2 {
        encoder.encode(&tick(n * 100_000_000), &mut bytes);
    }
    bytes.clear();
    encoder.encode(&tick(200_000_000), &mut bytes);
    assert_eq!(bytes, [1, 0, 0, 0, 0]);
}

#[test]
fn a_wake_has_the_layout_of_the_documentation() {
    let entry = JournalEntry {
        at_ns: 5,
        cause: WakeSource::Sample { writer: [0xaa; 16], seq: 3 },
        seen: vec![InputView {
            new: 40,
            digest: 0x0403_0201,
            newest: Some(([0xbb; 16], 300)),
            reach: 2,
        }],
        triggers: vec![Trigger {
            kind: TriggerKind::Stop,
            label: "x".to_owned(),
            score: Some(1.0),
            attributes: Map::from_iter([("a".to_owned(), json!(1))]),
        }],
        fault: Some(Fault {
            kind: gleaner_lambda::FaultKind::Trap,
            message: "m".to_owned(),
            used: None,
            allowed: Some(9),
        }),
        fuel: Some(64),
        log: LogDigest { lines: 2, digest: 0x0807_0605 },
    };
    let mut expected = vec![0b0111_1110, 10];
    expected.extend([0xaa; 16]);
    expected.extend([6, 0x80, 0x01]);
    expected.extend([0b1111_1111, 9, 1, 2, 3, 4, 2]);
    expected.extend([0xbb; 16]);
    expected.extend([0xac, 0x02, 2]);
    expected.extend([1, 0b110, 1, b'x']);
    expected.extend(1.0_f64.to_le_bytes());
    expected.extend(b"\x07{\"a\":1}");
    expected.extend([0b1_0100, 1, b'm', 9]);
    expected.extend([2, 5, 6, 7, 8]);
    let mut bytes = Vec::new();
    Encoder::new(1).encode(&entry, &mut bytes);
    assert_eq!(bytes, expected);
}

#[test]
fn numbers_at_the_ends_of_their_range_do_not_overflow() {
    let entry = |at_ns, number| JournalEntry {
        at_ns,
        cause: WakeSource::Sample { writer: [0; 16], seq: number },
        seen: vec![InputView {
            new: number,
            digest: 1,
            newest: Some(([0; 16], number)),
            reach: number,
        }],
        fuel: Some(number),
        log: LogDigest { lines: u32::MAX, digest: 0 },
        ..JournalEntry::default()
    };
    let ends =
        [(i64::MIN, 0), (i64::MAX, u64::MAX), (i64::MIN, u64::MAX), (i64::MAX, 1), (-1, 1 << 63)];
    let (mut encoder, mut bytes) = (Encoder::new(1), Vec::new());
    ends.iter().for_each(|&(at_ns, number)| encoder.encode(&entry(at_ns, number), &mut bytes));
    let (mut decoder, mut rest) = (Decoder::new(1), bytes.as_slice());
    for (at_ns, number) in ends {
        assert_eq!(decoder.decode(&mut rest), Ok(entry(at_ns, number)));
    }
}

#[test]
fn a_fraction_keeps_its_last_bit() {
    let mut random = Xorshift(3);
    for _ in 0..2000 {
        let value = f64::from_bits(random.next());
        if !value.is_finite() {
            continue;
        }
        let mut entry = any_entry(&mut random, 0);
        let mut trigger = any_trigger(&mut random);
        trigger.score = Some(-0.0);
        trigger.attributes.insert("value".to_owned(), json!(value));
        entry.triggers = vec![trigger];
        let mut bytes = Vec::new();
        Encoder::new(0).encode(&entry, &mut bytes);
        let read = Decoder::new(0).decode(&mut bytes.as_slice()).unwrap();
        // Needs the feature `float_roundtrip` of serde_json: without it, a parsed value may be off
        // by one bit.
        assert_eq!(read.differs_from(&entry, &[], true), None);
    }
}

#[test]
#[should_panic(expected = "number of inputs of a wake")]
fn a_wake_with_another_number_of_inputs_panics() {
    Encoder::new(1).encode(&any_entry(&mut Xorshift(4), 2), &mut Vec::new());
}

#[test]
fn wakes_that_were_encoded_elsewhere_are_read_like_any_other() {
    let entries = usual_entries(2, 10);
    let mut encoder = Encoder::new(2);
    let mut writer = JournalWriter::begin(Vec::new(), &header(2)).unwrap();
    for (index, entry) in entries.iter().enumerate() {
        if index % 3 == 0 {
            writer.wake(entry).unwrap();
            continue;
        }
        let mut encoded = Vec::new();
        encoder.reset();
        encoder.encode(entry, &mut encoded);
        writer.encoded_wake(&encoded).unwrap();
    }
    let too_long = writer.encoded_wake(&vec![0; 2 << 20]).unwrap_err();
    assert_eq!(too_long.to_string(), "a wake is too large for a block of a journal");
    let bytes = writer.finish(&end(entries.len())).unwrap();
    let mut reader = JournalReader::open(bytes.as_slice()).unwrap();
    assert_eq!(read_all(&mut reader).0, entries);
    assert_eq!(reader.end().unwrap().wakes, 10);
}
