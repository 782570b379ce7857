//! Tests metadata records and attachments: all of them, or an error, or those before the cut.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::Cursor;

use gleaner_drives::{Attachment, Damage, Extras, ReplayError, read_extras};
use mcap::WriteOptions;
use mcap::records::Metadata;

use crate::support::{
    MAGIC, TEXT, add_channel, file, finish, finished, record, small_chunks, ticking, write,
};

const LIMIT: u64 = 1 << 20;

fn pairs(pairs: &[(&str, &str)]) -> BTreeMap<String, String> {
    pairs.iter().map(|(key, value)| (key.to_string(), value.to_string())).collect()
}

fn held() -> Extras {
    let attachment = |name: &str, media_type: &str, data: &[u8]| Attachment {
        name: name.to_owned(),
        media_type: media_type.to_owned(),
        data: data.to_vec(),
    };
    Extras {
        metadata: vec![
            ("gleaner.begin".to_owned(), pairs(&[("clock", "log_time"), ("from_ns", "12")])),
            ("gleaner.topic".to_owned(), pairs(&[("topic", "/a")])),
            ("gleaner.topic".to_owned(), pairs(&[])),
        ],
        attachments: vec![
            attachment("thumbnail.jpg", "image/jpeg", &[0xff, 0xd8, 1, 2, 3]),
            attachment("journal/späh.journal", "", &[]),
        ],
        is_whole: true,
        misfit: None,
    }
}

/// Returns a file with messages, and the extras before, between and after them.
fn clip(options: WriteOptions) -> Vec<u8> {
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    let held = held();
    let mut metadata =
        held.metadata.into_iter().map(|(name, metadata)| Metadata { name, metadata });
    let mut attachments = held.attachments.into_iter().map(|attachment| mcap::Attachment {
        log_time: 5,
        create_time: 6,
        name: attachment.name,
        media_type: attachment.media_type,
        data: Cow::Owned(attachment.data),
    });
    writer.write_metadata(&metadata.next().unwrap()).unwrap();
    let channel = add_channel(&mut writer, "/a", TEXT);
    for message in ticking(&["/a"], 20, 100) {
        write(&mut writer, channel, &message);
    }
    writer.attach(&attachments.next().unwrap()).unwrap();
    for message in ticking(&["/a"], 20, 1000) {
        write(&mut writer, channel, &message);
    }
    metadata.for_each(|metadata| writer.write_metadata(&metadata).unwrap());
    attachments.for_each(|attachment| writer.attach(&attachment).unwrap());
    finish(writer)
}

fn read(bytes: &[u8], limit_bytes: u64) -> Result<Extras, ReplayError> {
    let path = file(bytes);
    let read = read_extras(&path, limit_bytes);
    std::fs::remove_file(path).unwrap();
    read
}

#[track_caller]
fn damage(read: Result<Extras, ReplayError>) -> Damage {
    match read {
        Err(ReplayError::Damaged { what, .. }) => what,
        other => panic!("expected damage, got {other:?}"),
    }
}

fn find(bytes: &[u8], needle: &[u8]) -> usize {
    bytes.windows(needle.len()).position(|window| window == needle).unwrap()
}

#[test]
fn every_layout_of_a_file_gives_its_extras_in_order() {
    for (options, is_indexed) in [
        (small_chunks(), true),
        (small_chunks().compression(None), true),
        (small_chunks().use_chunks(false), true),
        (small_chunks().emit_summary_records(false).emit_summary_offsets(false), false),
        (small_chunks().emit_attachment_indexes(false).emit_metadata_indexes(false), false),
        (small_chunks().calculate_attachment_crcs(false), true),
        (small_chunks().emit_statistics(false), true),
    ] {
        let found = read(&clip(options), LIMIT).unwrap();
        assert_eq!(found.misfit.is_none(), is_indexed, "{:?}", found.misfit);
        assert_eq!(Extras { misfit: None, ..found }, held());
    }
}

#[test]
fn a_file_without_extras_has_none() {
    let bytes = crate::support::drive(small_chunks(), &ticking(&["/a"], 20, 100));
    assert_eq!(read(&bytes, 0).unwrap(), Extras { is_whole: true, ..Extras::default() });
}

#[test]
fn a_file_truncated_anywhere_has_the_extras_before_the_cut() {
    let bytes = clip(small_chunks());
    let held = held();
    let mut most = (0, 0);
    for cut in MAGIC.len()..bytes.len() {
        let found = read(&bytes[..cut], LIMIT).unwrap();
        assert!(!found.is_whole, "cut at {cut}");
        assert!(held.metadata.starts_with(&found.metadata), "cut at {cut}");
        assert!(held.attachments.starts_with(&found.attachments), "cut at {cut}");
        let now = (found.metadata.len(), found.attachments.len());
        assert!(now.0 >= most.0 && now.1 >= most.1, "cut at {cut}");
        most = now;
    }
    assert_eq!(most, (3, 2));
    for cut in 0..MAGIC.len() {
        assert!(matches!(read(&bytes[..cut], LIMIT), Err(ReplayError::NotMcap { .. })));
    }
}

#[test]
fn extras_after_a_torn_record_are_reported_as_missing() {
    let bytes = clip(small_chunks());
    let torn = find(&bytes, &[0xff, 0xd8, 1, 2, 3]);
    // Pages that never reached the disk read as zeros.
    let mut zeros = bytes[..bytes.len() - 1].to_vec();
    zeros[torn..].fill(0);
    let found = read(&zeros, LIMIT).unwrap();
    assert_eq!((found.metadata.len(), found.attachments.len(), found.is_whole), (1, 0, false));
}

#[test]
fn a_flipped_byte_never_gives_attachments_other_than_those_written() {
    let bytes = clip(small_chunks());
    let held = held();
    for at in MAGIC.len()..bytes.len() {
        for flip in [0x01, 0x80, 0xff] {
            let mut bytes = bytes.clone();
            bytes[at] ^= flip;
            match read(&bytes, LIMIT) {
                Ok(found) if found.is_whole => {
                    assert_eq!(found.attachments, held.attachments, "byte {at}");
                    assert_eq!(found.metadata.len(), held.metadata.len(), "byte {at}");
                }
                // The flip was in the end that marks a finished file.
                Ok(found) => assert!(held.attachments.starts_with(&found.attachments), "byte {at}"),
                Err(ReplayError::Damaged { .. }) => {}
                Err(other) => panic!("byte {at}: {other:?}"),
            }
        }
    }
}

#[test]
fn the_error_names_an_attachment_with_a_wrong_checksum() {
    let mut bytes = clip(small_chunks());
    let at = find(&bytes, &[0xff, 0xd8, 1, 2, 3]);
    bytes[at + 2] = 9;
    let what = damage(read(&bytes, LIMIT));
    let Damage::AttachmentCrc { name, .. } = &what else { panic!("{what}") };
    assert_eq!(name, "thumbnail.jpg");
    // The checksum also covers the bytes before the data.
    let mut bytes = clip(small_chunks());
    let at = find(&bytes, b"image/jpeg");
    bytes[at] = b'I';
    assert!(matches!(damage(read(&bytes, LIMIT)), Damage::AttachmentCrc { .. }));
}

#[test]
fn a_missing_record_is_noticed_by_the_count_in_the_summary() {
    // Without the checksum of the data section, which would notice it first.
    let bytes = clip(small_chunks().calculate_data_section_crc(false));
    let heads = [(13, b"gleaner.begin", "metadata records"), (13, b"thumbnail.jpg", "attachments")];
    for (len, name, kind) in heads {
        let mut bytes = bytes.clone();
        // The kind is 9 bytes before the body, which begins with the name in a metadata record, and
        // with two stamps in an attachment.
        let before = if kind == "attachments" { 9 + 16 + 4 } else { 9 + 4 };
        let at = find(&bytes, &name[..len]) - before;
        bytes[at] = 0x80;
        let what = damage(read(&bytes, LIMIT));
        assert!(what.to_string().starts_with("the file should have"), "{what}");
        assert!(matches!(what, Damage::MissingExtras { what, .. } if what == kind));
    }
}

#[test]
fn a_changed_byte_that_no_record_covers_is_noticed_by_the_checksum_of_the_whole() {
    let mut bytes = clip(small_chunks());
    let at = find(&bytes, b"gleaner.begin");
    bytes[at] = b'G';
    assert!(matches!(damage(read(&bytes, LIMIT)), Damage::DataCrc { .. }));
}

#[test]
fn more_than_the_limit_is_refused_before_memory_is_allocated() {
    let bytes = clip(small_chunks());
    let needed = (0..LIMIT).find(|limit| read(&bytes, *limit).is_ok()).unwrap();
    assert_eq!(read(&bytes, needed).unwrap(), held());
    let what = damage(read(&bytes, needed - 1));
    let expected = format!("its metadata and attachments take more than {} bytes", needed - 1);
    assert_eq!(what.to_string(), expected);
    // A truncated file has the same limit.
    assert!(matches!(
        damage(read(&bytes[..bytes.len() - 1], 10)),
        Damage::ExtrasTooLarge { allowed: 10 }
    ));
    // Many tiny pairs take more than their bytes.
    let pair = |n| [&[3, 0, 0, 0][..], format!("{n:03}").as_bytes(), &[0; 4]].concat();
    let tiny: Vec<u8> = (0..1000).flat_map(pair).collect();
    let body = [&[0; 4][..], &(tiny.len() as u32).to_le_bytes(), &tiny].concat();
    let bytes = finished(&[record(12, &body)]);
    assert_eq!(read(&bytes, LIMIT).unwrap().metadata[0].1.len(), 1000);
    assert!(matches!(damage(read(&bytes, 50_000)), Damage::ExtrasTooLarge { .. }));
}

#[test]
fn hostile_lengths_are_damage() {
    let attachment = |name: u32, len: u64| {
        [
            &[0; 16][..],
            &name.to_le_bytes(),
            &[b'n'; 4],
            &0u32.to_le_bytes(),
            &len.to_le_bytes(),
            &[7; 4],
            &[0; 4],
        ]
        .concat()
    };
    let valid = finished(&[record(9, &attachment(4, 4))]);
    assert_eq!(read(&valid, LIMIT).unwrap().attachments[0].data, [7; 4]);
    let with_head = |opcode: u8, len: u64| [&[opcode][..], &len.to_le_bytes(), &[0; 50]].concat();
    for bad in [
        record(9, &attachment(4, u64::MAX)),
        record(9, &attachment(4, 5)),
        record(9, &attachment(u32::MAX, 4)),
        record(9, &[]),
        record(12, &[]),
        record(12, &u32::MAX.to_le_bytes()),
        record(12, &[0, 0, 0, 0, 0xff, 0xff, 0xff, 0xff]),
        record(12, &[0, 0, 0, 0, 3, 0, 0, 0, 0, 0, 0]),
        record(12, &[1, 0, 0, 0, 0xff, 0, 0, 0, 0]),
        // A key twice.
        record(12, &[&[0, 0, 0, 0, 16, 0, 0, 0][..], &[0; 16]].concat()),
        // Text that is not UTF-8.
        record(12, &[&[0, 0, 0, 0, 9, 0, 0, 0][..], &[1, 0, 0, 0, 0xff], &[0; 4]].concat()),
        record(11, &[0; 8]),
        record(0, &[]),
        record(2, &[0; 20]),
        with_head(12, u64::MAX),
        with_head(9, u64::MAX - 8),
        with_head(6, 1 << 40),
        with_head(11, u64::MAX),
    ] {
        damage(read(&finished(std::slice::from_ref(&bad)), LIMIT));
        // At the end of a file without a footer, the same means that it was truncated.
        let cut = read(&[&MAGIC[..], &bad].concat(), LIMIT).unwrap();
        assert_eq!(cut, Extras::default(), "{bad:?}");
    }
    // Within the file, but larger than statistics can be.
    assert!(matches!(
        damage(read(&finished(&[record(11, &vec![0; 2 << 20])]), LIMIT)),
        Damage::Summary(_)
    ));
}

#[test]
fn a_file_that_is_not_a_drive_is_refused() {
    assert!(matches!(read_extras("no/such/file".as_ref(), LIMIT), Err(ReplayError::Open { .. })));
    assert!(matches!(
        read_extras(&std::env::temp_dir(), LIMIT),
        Err(ReplayError::Directory { .. })
    ));
    assert!(matches!(read(b"SQLite format 3\0", LIMIT), Err(ReplayError::NotMcap { .. })));
}
