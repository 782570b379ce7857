//! Tests damaged drives: all promised messages come first, then one error with position and cause.

use gleaner_drives::{Damage, DriveLimits, DriveOptions, Replay, ReplayError};
use mcap::WriteOptions;
use mcap::records::ChunkIndex;

use crate::support::{
    TEXT, TOPICS, TYPE, Written, add_channel, begin, begun, damage, drive, expected, file, finish,
    listen, replayed, run, run_whole, small_chunks, ticking, write, write_data,
};

fn messages() -> Vec<Written> {
    ticking(&TOPICS, 300, 1000)
}

/// Returns the chunks of a drive in file order, each with its number of messages.
fn chunks(bytes: &[u8]) -> Vec<(ChunkIndex, usize)> {
    let summary = mcap::Summary::read(bytes).unwrap().unwrap();
    let mut indexes = summary.chunk_indexes.clone();
    indexes.sort_by_key(|index| index.chunk_start_offset);
    let count = |index: &ChunkIndex| summary.stream_chunk(bytes, index).unwrap().count();
    indexes.into_iter().map(|index| (index.clone(), count(&index))).collect()
}

#[test]
fn a_file_truncated_anywhere_delivers_every_whole_chunk_before_the_cut() {
    for options in [small_chunks(), small_chunks().compression(None)] {
        let bytes = drive(options, &messages());
        let chunks = chunks(&bytes);
        for part in 1..50 {
            let cut = bytes.len() * part / 50;
            let (all, error) = match Replay::open(&[file(&bytes[..cut])]) {
                // Cut before the first channel: there is no topic to subscribe.
                Ok(replay) if gleaner_messages::transport::Transport::topics(&replay).len() < 2 => {
                    continue;
                }
                Ok(_) => replayed(&[file(&bytes[..cut])], &TOPICS),
                Err(error) => panic!("cut at {cut}: {error}"),
            };
            let end = |index: &ChunkIndex| index.chunk_start_offset + index.chunk_length;
            let whole = chunks.iter().filter(|(index, _)| end(index) <= cut as u64);
            let count: usize = whole.map(|(_, count)| count).sum();
            assert_eq!(all, expected(&messages())[..count], "cut at {cut}");
            damage(error);
        }
    }
}

#[test]
fn a_truncated_file_without_chunks_delivers_every_whole_message() {
    let bytes = drive(small_chunks().use_chunks(false), &messages());
    let mut most = 0;
    for cut in (200..bytes.len()).step_by(97) {
        let replay = Replay::open(&[file(&bytes[..cut])]).unwrap();
        if gleaner_messages::transport::Transport::topics(&replay).len() < 2 {
            continue;
        }
        let (all, error) = replayed(&[file(&bytes[..cut])], &TOPICS);
        assert_eq!(all, expected(&messages())[..all.len()], "cut at {cut}");
        assert!(all.len() >= most);
        most = all.len();
        damage(error);
    }
    assert_eq!(most, 300);
}

#[test]
fn whole_data_without_a_footer_is_replayed_and_then_reported() {
    let bytes = drive(small_chunks(), &messages());
    // The data section ends where the last message index ends.
    let (last, _) = chunks(&bytes).pop().unwrap();
    let end = last.chunk_start_offset + last.chunk_length + last.message_index_length;
    let (all, error) = replayed(&[file(&bytes[..end as usize])], &TOPICS);
    assert_eq!(all, expected(&messages()));
    let (offset, what) = damage(error);
    assert_eq!(offset, end);
    assert!(matches!(what, Damage::NoFooter));
}

#[test]
fn a_flipped_byte_in_a_chunk_ends_the_drive_before_that_chunk() {
    for options in [small_chunks(), small_chunks().compression(None)] {
        let bytes = drive(options, &messages());
        for (bad, _) in chunks(&bytes).iter().step_by(3) {
            let mut bytes = bytes.clone();
            bytes[(bad.chunk_start_offset + bad.chunk_length) as usize - 20] ^= 0x10;
            let (all, error) = replayed(&[file(&bytes)], &TOPICS);
            let before: Vec<_> = expected(&messages())
                .into_iter()
                .filter(|(at, _)| *at < bad.message_start_time as i64)
                .collect();
            assert_eq!(all, before);
            let (offset, what) = damage(error);
            assert_eq!(offset, bad.chunk_start_offset);
            assert!(matches!(what, Damage::ChunkCrc { .. } | Damage::Inflate(_)), "{what:?}");
        }
    }
}

#[test]
fn a_flipped_byte_in_a_file_without_summary_ends_the_readable_part() {
    let indexed = drive(small_chunks(), &messages());
    let options = small_chunks().emit_summary_records(false).emit_summary_offsets(false);
    let mut bytes = drive(options, &messages());
    let (bad, _) = &chunks(&indexed)[5];
    bytes[(bad.chunk_start_offset + bad.chunk_length) as usize - 20] ^= 0x10;
    let (all, error) = replayed(&[file(&bytes)], &TOPICS);
    let count: usize = chunks(&indexed)[..5].iter().map(|(_, count)| count).sum();
    assert_eq!(all, expected(&messages())[..count]);
    assert_eq!(damage(error).0, bad.chunk_start_offset);
}

#[test]
fn damage_in_one_file_ends_the_drive_for_all() {
    let first = drive(small_chunks(), &messages());
    let cut = &first[..first.len() / 2];
    let mut second = ticking(&["/c"], 300, 1005);
    second.iter_mut().for_each(|message| message.value += 1000);
    let paths = [file(cut), file(&drive(small_chunks(), &second))];
    let (all, error) = replayed(&paths, &["/a", "/b", "/c"]);
    damage(error);
    let last = all.iter().filter(|(_, value)| *value < 1000).map(|(at, _)| *at).max().unwrap();
    let both: Vec<_> = messages().into_iter().chain(second).collect();
    let until: Vec<_> = expected(&both).into_iter().filter(|(at, _)| *at <= last).collect();
    assert_eq!(all, until);
}

#[test]
fn a_damaged_summary_costs_no_message() {
    let mut bytes = drive(small_chunks(), &messages());
    let at = bytes.len() - 60;
    bytes[at] ^= 0xff;
    let (all, error) = replayed(&[file(&bytes)], &TOPICS);
    assert_eq!(all, expected(&messages()));
    assert!(matches!(damage(error).1, Damage::Summary(_)));
}

#[test]
fn messages_outside_chunks_are_covered_by_the_checksum_of_the_data_section() {
    let mut bytes = drive(small_chunks().use_chunks(false), &messages());
    // A value: only the checksum covers it.
    let needle = 150i64.to_le_bytes();
    let at = bytes.windows(8).position(|window| window == needle).unwrap();
    bytes[at] ^= 1;
    let (all, error) = replayed(&[file(&bytes)], &TOPICS);
    assert_eq!(all.len(), 300);
    assert!(matches!(damage(error).1, Damage::DataCrc { .. }));
}

#[test]
fn fewer_messages_than_the_summary_counts_are_noticed_at_the_end() {
    let mut bytes = drive(small_chunks().calculate_summary_section_crc(false), &messages());
    // The last entry of the statistics: channel 1 has 150 messages.
    let mut needle = 1u16.to_le_bytes().to_vec();
    needle.extend(150u64.to_le_bytes());
    let at = bytes.windows(10).rposition(|window| window == needle).unwrap();
    bytes[at + 2] = 151;
    let (all, error) = replayed(&[file(&bytes)], &TOPICS);
    assert_eq!(all.len(), 300);
    let (_, what) = damage(error);
    assert_eq!(what.to_string(), "topic `/a` should have 151 messages; 150 were found");
}

#[test]
fn messages_that_are_not_cdr_are_left_out_and_counted() {
    // No bytes, a list of parameters, XCDR2 plain and delimited.
    for bad in [&[][..], &[0, 1, 0], &[0, 3, 0, 0, 1], &[0, 7, 0, 0, 1], &[0, 9, 0, 0, 1]] {
        let mut writer = begin();
        let channel = add_channel(&mut writer, "/a", TEXT);
        for (n, message) in ticking(&["/a"], 6, 10).iter().enumerate() {
            if n == 3 {
                write_data(&mut writer, channel, 35, bad);
            }
            write(&mut writer, channel, message);
        }
        let (mut replay, memory) = begun(&[file(&finish(writer))], &["/a"]);
        let steps = run_whole(&mut replay);
        assert!(memory.values().iter().map(|(_, value)| *value).eq(0..6));
        // Time passes with it, as for every other message.
        assert!(steps.len() == 7 && steps[3].at_ns == 35);
        assert_eq!(steps[3].delivery, gleaner_messages::transport::Delivery::Malformed);
        assert_eq!(replay.malformed()["/a"], 1);
    }
}

#[test]
fn a_chunk_beyond_the_limit_is_refused() {
    let bytes = drive(WriteOptions::new(), &messages());
    let limits = DriveLimits { chunk_bytes: 10_000, ..DriveLimits::default() };
    let mut replay = Replay::open_with(&[file(&bytes)], limits).unwrap();
    listen(&mut replay, &TOPICS);
    let (steps, error) = run(&mut replay);
    assert!(steps.is_empty());
    let what = damage(error).1;
    assert!(matches!(what, Damage::ChunkTooLarge { claimed: 10_001.., allowed: 10_000 }), "{what}");
}

#[test]
fn damage_before_a_part_costs_its_latched_samples_alone_and_is_reported_at_its_end() {
    const FROM: i64 = 2500;
    let mut writer = begin();
    let schema = writer.add_schema(TYPE, "ros2msg", TEXT.as_bytes()).unwrap();
    let qos = "- durability: transient_local\n".to_owned();
    let qos = [("offered_qos_profiles".to_owned(), qos)].into();
    let map = writer.add_channel(schema, "/map", "cdr", &qos).unwrap();
    let a = add_channel(&mut writer, "/a", TEXT);
    let messages = ticking(&["/a"], 300, 1000);
    for (n, message) in messages.iter().enumerate() {
        write(&mut writer, if [0, 70].contains(&n) { map } else { a }, message);
    }
    let bytes = finish(writer);
    let of_part = || expected(&messages).into_iter().filter(|(at, _)| *at >= FROM);
    let (mut with, mut without) = (0, 0);
    for (bad, _) in chunks(&bytes).iter().filter(|(bad, _)| bad.message_end_time < FROM as u64) {
        let mut bytes = bytes.clone();
        bytes[(bad.chunk_start_offset + bad.chunk_length) as usize - 20] ^= 0x10;
        let paths = [file(&bytes)];
        let mut replay = Replay::open(&paths).unwrap();
        replay.restrict(FROM, i64::MAX);
        replay.begin_with_latched(&paths, &DriveOptions::default());
        let memory = listen(&mut replay, &["/map", "/a"]);
        let (_, error) = run(&mut replay);
        if bad.message_index_offsets.contains_key(&map) {
            with += 1;
            // The lost one may have replaced the other: neither is known to be valid.
            assert_eq!(memory.values(), of_part().collect::<Vec<_>>());
            let Some(ReplayError::WithoutLatched { source }) = error else { panic!("{error:?}") };
            assert_eq!(damage(Some(*source)).0, bad.chunk_start_offset);
        } else {
            without += 1;
            let latched = [(FROM, 0), (FROM, 70)].into_iter();
            assert_eq!(memory.values(), latched.chain(of_part()).collect::<Vec<_>>());
            assert!(error.is_none(), "{error:?}");
        }
    }
    assert!(with == 2 && without > 5, "{with}, {without}");
}

#[test]
fn after_the_error_there_is_nothing_more() {
    let bytes = drive(small_chunks(), &messages());
    let (mut replay, _) = begun(&[file(&bytes[..bytes.len() / 2])], &TOPICS);
    let (_, error) = run(&mut replay);
    damage(error);
    assert!(replay.step().unwrap().is_none());
    assert!(replay.peek_at_ns().unwrap().is_none());
}
