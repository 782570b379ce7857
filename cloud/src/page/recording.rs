//! The topics of a stored clip, from the summary at the end of its file. The file comes from a
//! vehicle: only its last part is read, and nothing of it is decompressed.

use std::collections::BTreeMap;

use axum::body::{Body, to_bytes};
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::Response;
use gleaner_fleet::clips::FleetClip;
use mcap::records::{Channel, Record, Statistics};

use crate::clips::FleetClips;
use crate::error::CloudResult;

/// Number of bytes at the end of a file that are read: summaries take some KiB.
const TAIL_MAX: u64 = 1 << 20;
pub(super) const TOPICS_MAX: usize = 200;
/// Bytes of the record at the end of a file, with its head, and of the magic number after it.
const FOOTER: usize = 29;
const MAGIC: &[u8] = b"\x89MCAP0\r\n";

#[derive(Debug, Default, PartialEq)]
pub(super) struct Recording {
    pub(super) messages: u64,
    /// Times of the first and the last message, in ns since 1970.
    pub(super) span: [u64; 2],
    /// The topics, at most [`TOPICS_MAX`].
    pub(super) topics: Vec<StoredTopic>,
    /// Number of topics that are left out.
    pub(super) omitted: usize,
}

#[derive(Debug, PartialEq)]
pub(super) struct StoredTopic {
    pub(super) name: String,
    pub(super) type_name: String,
    pub(super) messages: u64,
}

/// Reads the summary of a stored clip; `None` if it has none that can be read.
pub(super) async fn read(clips: &FleetClips, clip: &FleetClip) -> CloudResult<Option<Recording>> {
    let start = clip.facts.bytes.saturating_sub(TAIL_MAX);
    let mut headers = HeaderMap::new();
    if let Ok(range) = HeaderValue::from_str(&format!("bytes={start}-")) {
        headers.insert(header::RANGE, range);
    }
    let reply = clips.recording(&clip.id, &headers, ()).await?;
    let tail = whole(reply, TAIL_MAX).await.unwrap_or_default();
    Ok(parse(&tail, start))
}

/// Reads an answer of at most `most` bytes; `None` if it is longer or breaks off.
pub(super) async fn whole(reply: Response, most: u64) -> Option<Vec<u8>> {
    let body: Body = reply.into_body();
    let bytes = to_bytes(body, usize::try_from(most).ok()?).await.ok()?;
    Some(bytes.to_vec())
}

/// Parses the end of a file, which begins at `start`.
fn parse(tail: &[u8], start: u64) -> Option<Recording> {
    let rest = tail.strip_suffix(MAGIC)?;
    let (rest, footer) = rest.split_at_checked(rest.len().checked_sub(FOOTER)?)?;
    let place = u64::from_le_bytes(footer.get(9..17)?.try_into().ok()?);
    let place = usize::try_from(place.checked_sub(start)?).ok()?;
    let summary = rest.get(place..).filter(|_| footer[0] == mcap::records::op::FOOTER)?;
    let mut types = BTreeMap::new();
    let mut channels: BTreeMap<u16, Channel> = BTreeMap::new();
    let mut statistics: Option<Statistics> = None;
    for record in mcap::read::LinearReader::sans_magic(summary) {
        match record.ok()? {
            Record::Schema { header, .. } => drop(types.insert(header.id, header.name)),
            Record::Channel(channel) => drop(channels.insert(channel.id, channel)),
            Record::Statistics(found) => statistics = Some(found),
            _ => {}
        }
    }
    let statistics = statistics?;
    let counts = &statistics.channel_message_counts;
    let topics = channels.values().take(TOPICS_MAX).map(|channel| StoredTopic {
        name: channel.topic.clone(),
        type_name: types.get(&channel.schema_id).cloned().unwrap_or_default(),
        messages: counts.get(&channel.id).copied().unwrap_or(0),
    });
    Some(Recording {
        messages: statistics.message_count,
        span: [statistics.message_start_time, statistics.message_end_time],
        topics: topics.collect(),
        omitted: channels.len().saturating_sub(TOPICS_MAX),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file() -> Vec<u8> {
        let mut file = std::io::Cursor::new(Vec::new());
        let mut writer = mcap::WriteOptions::new().compression(None).create(&mut file).unwrap();
        let schema = writer.add_schema("sensor_msgs/msg/Imu", "ros2msg", b"float64 x").unwrap();
        let imu = writer.add_channel(schema, "/imu", "cdr", &BTreeMap::new()).unwrap();
        let log = writer.add_channel(0, "/log", "json", &BTreeMap::new()).unwrap();
        for (sequence, channel) in [(0, imu), (1, imu), (2, log)] {
            let log_time = 1000 + u64::from(sequence);
            let header = mcap::records::MessageHeader {
                channel_id: channel,
                sequence,
                log_time,
                publish_time: log_time,
            };
            writer.write_to_known_channel(&header, b"data").unwrap();
        }
        writer.finish().unwrap();
        drop(writer);
        file.into_inner()
    }

    #[test]
    fn the_summary_has_topics_with_their_messages() {
        let file = file();
        let recording = parse(&file, 0).unwrap();
        let topics = recording.topics.iter().map(|it| (&*it.name, &*it.type_name, it.messages));
        let expected = [("/imu", "sensor_msgs/msg/Imu", 2), ("/log", "", 1)];
        assert_eq!(topics.collect::<Vec<_>>(), expected);
        assert_eq!((recording.messages, recording.span), (3, [1000, 1002]));
        // Without its first bytes, as of a large file.
        assert_eq!(parse(&file[8..], 8), Some(recording));
    }

    #[test]
    fn a_damaged_end_has_no_summary() {
        let file = file();
        assert_eq!(parse(&file[..file.len() - 1], 0), None);
        assert_eq!(parse(&file[file.len() - 40..], file.len() as u64 - 40), None, "too long");
        assert_eq!(parse(MAGIC, 0), None);
        // No change of a byte makes it panic.
        for index in file.len() - 600..file.len() {
            for change in [0x01, 0xff] {
                let mut damaged = file.clone();
                damaged[index] ^= change;
                parse(&damaged, 0);
            }
        }
    }
}
