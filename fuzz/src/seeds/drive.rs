//! Seeds: small drives, written with every option of the writer; most without checksums, which a
//! fuzzer would not get past.

use std::collections::BTreeMap;
use std::io::Cursor;

use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, Compression, WriteOptions};

/// Dictionary of channels and metadata.
pub const WORDS: &[&str] = &[
    "ros2msg",
    "cdr",
    "ros2",
    "zstd",
    "lz4",
    "gleaner.writer",
    "offered_qos_profiles",
    "int64 value\n",
    "test_msgs/msg/Number",
];

pub fn all() -> Vec<Vec<u8>> {
    let small = || WriteOptions::new().profile("ros2").library("").chunk_size(Some(200));
    let unchecked = || {
        small()
            .calculate_chunk_crcs(false)
            .calculate_data_section_crc(false)
            .calculate_summary_section_crc(false)
            .calculate_attachment_crcs(false)
    };
    let options = [
        small(),
        unchecked().compression(None),
        unchecked(),
        unchecked().compression(Some(Compression::Lz4)),
        unchecked().use_chunks(false),
        unchecked().compression(None).emit_summary_records(false).emit_summary_offsets(false),
        unchecked().compression(None).emit_message_indexes(false),
        unchecked().compression(None).chunk_size(Some(60)),
    ];
    options.into_iter().map(drive).collect()
}

fn drive(options: WriteOptions) -> Vec<u8> {
    let mut writer = options.create(Cursor::new(Vec::new())).expect("writing to memory succeeds");
    let schema =
        writer.add_schema("test_msgs/msg/Number", "ros2msg", b"int64 value\n").expect("a schema");
    let writers = BTreeMap::from([
        ("gleaner.writer".to_owned(), "0123456789abcdef".repeat(2)),
        ("offered_qos_profiles".to_owned(), "- depth: 1".to_owned()),
    ]);
    let channels = [("/a", BTreeMap::new()), ("/b", writers)];
    let channels = channels.map(|(topic, metadata)| {
        writer.add_channel(schema, topic, "cdr", &metadata).expect("a channel")
    });
    for number in 0..8_u64 {
        let channel_id = channels[number as usize % 2];
        // Chunks that overlap in time, so that several are open together.
        let log_time = 1000 + number * 10 - 25 * (number % 3);
        let header = MessageHeader {
            channel_id,
            sequence: number as u32 / 2 + 1,
            log_time,
            publish_time: log_time,
        };
        let data = [&[0, 1, 0, 0][..], &number.to_le_bytes()].concat();
        writer.write_to_known_channel(&header, &data).expect("the channel is known");
    }
    let metadata = BTreeMap::from([("key".to_owned(), "value".to_owned())]);
    writer.write_metadata(&Metadata { name: "gleaner".to_owned(), metadata }).expect("metadata");
    let attachment = Attachment {
        log_time: 1,
        create_time: 1,
        name: "a".to_owned(),
        media_type: "text/plain".to_owned(),
        data: b"abc"[..].into(),
    };
    writer.attach(&attachment).expect("an attachment");
    writer.finish().expect("writing to memory succeeds");
    writer.into_inner().into_inner()
}
