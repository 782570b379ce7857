//! Builds drives for tests: MCAP files with given messages, and the CDR of messages.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::PathBuf;

use mcap::records::MessageHeader;

use crate::peers::message::MessageType;
use crate::{TempFolder, sample_drive};

/// Completes the definition of a type with a header by the types to which a header refers.
#[macro_export]
macro_rules! with_header {
    ($definition:literal) => {
        concat!(
            $definition,
            "================================================================================\n\
             MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
             ================================================================================\n\
             MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        )
    };
}

/// `sensor_msgs/msg/Image` as ROS 2 defines it.
pub const IMAGE: &str = with_header!(
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n\
     uint8 is_bigendian\nuint32 step\nuint8[] data\n"
);

/// `sensor_msgs/msg/CompressedImage` as ROS 2 defines it.
pub const COMPRESSED: &str = with_header!("std_msgs/Header header\nstring format\nuint8[] data\n");

/// The part of `sensor_msgs/msg/Imu` that the lambda `ticker` reads.
pub const TICKER_IMU: &str = with_header!(
    "std_msgs/Header header\ngeometry_msgs/Vector3 linear_acceleration\n\
     ================================================================================\n\
     MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
);

pub struct TopicMessages {
    pub topic: String,
    pub type_name: String,
    /// Definition of the type.
    pub schema: String,
    /// Log time in nanoseconds of each message, and its CDR without the encapsulation header.
    pub messages: Vec<(u64, Vec<u8>)>,
}

impl TopicMessages {
    pub fn sample_imu() -> Self {
        let bytes = std::fs::read(sample_drive()).expect("the sample drive exists");
        let messages = mcap::MessageStream::new(&bytes)
            .expect("a drive")
            .map(|message| message.expect("a complete drive"));
        let imu =
            messages.filter(|message| message.channel.topic == "/imu/data").collect::<Vec<_>>();
        let schema = imu[0].channel.schema.clone().expect("a schema");
        let messages = imu.iter().map(|message| (message.log_time, message.data[4..].to_vec()));
        Self {
            topic: "/imu/data".to_owned(),
            type_name: schema.name.clone(),
            schema: String::from_utf8_lossy(&schema.data).into_owned(),
            messages: messages.collect(),
        }
    }
}

/// Writes a drive with one topic. Each of `messages` has a log time in nanoseconds and the CDR
/// without its encapsulation header.
pub fn one_topic(
    folder: &TempFolder,
    topic: &str,
    type_name: &str,
    schema: &str,
    messages: &[(u64, Vec<u8>)],
) -> PathBuf {
    let topic = TopicMessages {
        topic: topic.to_owned(),
        type_name: type_name.to_owned(),
        schema: schema.to_owned(),
        messages: messages.to_vec(),
    };
    of_topics(folder, &[topic])
}

/// Writes a drive with these topics, their messages in the order of time.
pub fn of_topics(folder: &TempFolder, topics: &[TopicMessages]) -> PathBuf {
    let mut file = Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().profile("ros2").compression(None);
    let mut writer = options.create(&mut file).expect("a drive in memory");
    let mut all = Vec::new();
    for TopicMessages { topic, type_name, schema, messages } in topics {
        let schema = writer.add_schema(type_name, "ros2msg", schema.as_bytes()).expect("a schema");
        let channel =
            writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).expect("a channel");
        all.extend((1..).zip(messages).map(|(sequence, message)| (channel, sequence, message)));
    }
    all.sort_by_key(|(_, _, (log_time, _))| *log_time);
    for (channel_id, sequence, (log_time, cdr)) in all {
        let header =
            MessageHeader { channel_id, sequence, log_time: *log_time, publish_time: *log_time };
        let data = [&[0, 1, 0, 0], cdr.as_slice()].concat();
        writer.write_to_known_channel(&header, &data).expect("a message");
    }
    writer.finish().expect("a complete drive");
    drop(writer);
    folder.write("made.mcap", file.into_inner())
}

/// Writes a drive with the latched topic `/imu`: messages 1 to `count` of [`MessageType::Imu`], one
/// each second from 1 s on, in a chunk each.
pub fn latched_imu(folder: &TempFolder, count: u32) -> PathBuf {
    let mut file = Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().compression(None);
    let mut writer = options.create(&mut file).expect("a drive in memory");
    let (type_name, text) = (MessageType::Imu.name(), TopicMessages::sample_imu().schema);
    let schema = writer.add_schema(&type_name, "ros2msg", text.as_bytes()).expect("a schema");
    let qos = "- depth: 100\n  durability: transient_local\n".to_owned();
    let qos = [("offered_qos_profiles".to_owned(), qos)].into();
    let channel_id = writer.add_channel(schema, "/imu", "cdr", &qos).expect("a channel");
    for sequence in 1..=count {
        let log_time = 1_000_000_000 * u64::from(sequence);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        let cdr = MessageType::Imu.message(sequence).cdr();
        let data = [&[0, 1, 0, 0], cdr.as_slice()].concat();
        writer.write_to_known_channel(&header, &data).expect("a message");
        writer.flush().expect("a chunk");
    }
    writer.finish().expect("a complete drive");
    drop(writer);
    folder.write("latched.mcap", file.into_inner())
}

/// Writes a drive with only the IMU of the sample drive, `times` times in a row, 40.1 s apart.
pub fn imu_only(folder: &TempFolder, times: u64) -> PathBuf {
    let mut imu = TopicMessages::sample_imu();
    let rounds = (0..times).flat_map(|round| {
        let after = round * 40_100_000_000;
        imu.messages.iter().map(move |(log_time, cdr)| (log_time + after, cdr.clone()))
    });
    imu.messages = rounds.collect();
    of_topics(folder, &[imu])
}

/// Writes a drive with the IMU of the sample drive and `topics` further topics, `/many/0` and so
/// on, each with ten of the IMU messages.
pub fn with_topics(folder: &TempFolder, topics: u16) -> PathBuf {
    let bytes = std::fs::read(sample_drive()).expect("the sample drive exists");
    let mut file = Cursor::new(Vec::new());
    let mut writer =
        mcap::WriteOptions::new().profile("ros2").create(&mut file).expect("a drive in memory");
    let messages = mcap::MessageStream::new(&bytes)
        .expect("a drive")
        .map(|message| message.expect("a complete drive"));
    let imu = messages.filter(|message| message.channel.topic == "/imu/data").collect::<Vec<_>>();
    let schema = imu[0].channel.schema.clone().expect("a schema");
    let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data).expect("a schema");
    let mut add = |topic: &str| {
        writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).expect("a channel")
    };
    let imu_channel = add("/imu/data");
    let others = (0..topics).map(|n| add(&format!("/many/{n}"))).collect::<Vec<_>>();
    let interval = imu.len() / 10;
    for (n, message) in imu.iter().enumerate() {
        let others = if n % interval == 0 { others.as_slice() } else { &[] };
        for channel_id in [imu_channel].iter().chain(others) {
            let (log_time, publish_time) = (message.log_time, message.publish_time);
            let header = MessageHeader {
                channel_id: *channel_id,
                sequence: message.sequence,
                log_time,
                publish_time,
            };
            writer.write_to_known_channel(&header, &message.data).expect("a message");
        }
    }
    writer.finish().expect("a complete drive");
    drop(writer);
    folder.write("many.mcap", file.into_inner())
}

/// A message of the sample drive that a test may change.
#[derive(Clone, Debug)]
pub struct DriveMessage {
    pub topic: String,
    /// Time in seconds after the drive's first message.
    pub at_s: f64,
    /// Log time in nanoseconds.
    pub log_time: u64,
    /// CDR of the message, with the encapsulation header.
    pub data: Vec<u8>,
}

impl DriveMessage {
    /// Offset in `data` of the first field after `header`, for types whose other fields are 64-bit
    /// floats.
    fn body(&self) -> usize {
        let length =
            u32::from_le_bytes(self.data[12..16].try_into().expect("a header has a frame_id"));
        // Alignment does not count the 4 bytes of encapsulation.
        (12 + length as usize).next_multiple_of(8) + 4
    }

    /// Sets the float with this index, from 0, after `header`, for types whose other fields are
    /// 64-bit floats.
    pub fn set(&mut self, index: usize, value: f64) {
        let at = self.body() + 8 * index;
        self.data[at..at + 8].copy_from_slice(&value.to_le_bytes());
    }

    /// Adds seconds to `header.stamp`.
    pub fn shift_stamp(&mut self, seconds: i32) {
        let stamp = i32::from_le_bytes(self.data[4..8].try_into().expect("a stamp")) + seconds;
        self.data[4..8].copy_from_slice(&stamp.to_le_bytes());
    }
}

/// Writes the sample drive with each message changed by `change`, which returns `false` to leave a
/// message out.
pub fn changed(folder: &TempFolder, mut change: impl FnMut(&mut DriveMessage) -> bool) -> PathBuf {
    let bytes = std::fs::read(sample_drive()).expect("the sample drive exists");
    let mut file = Cursor::new(Vec::new());
    let mut writer = mcap::WriteOptions::new()
        .profile("ros2")
        .compression(None)
        .create(&mut file)
        .expect("a drive");
    let mut start = None;
    for message in mcap::MessageStream::new(&bytes)
        .expect("a drive")
        .map(|message| message.expect("a complete drive"))
    {
        let (topic, log_time, data) =
            (message.channel.topic.clone(), message.log_time, message.data.to_vec());
        let at_s = (log_time - *start.get_or_insert(log_time)) as f64 / 1e9;
        let mut changed = DriveMessage { topic, at_s, log_time, data };
        if change(&mut changed) {
            let (publish_time, data) = (message.publish_time, changed.data.into());
            let message =
                mcap::Message { log_time: changed.log_time, publish_time, data, ..message };
            writer.write(&message).expect("a message");
        }
    }
    writer.finish().expect("a complete drive");
    drop(writer);
    folder.write("changed.mcap", file.into_inner())
}

/// Encodes a message as little-endian CDR, field by field.
#[derive(Default)]
pub struct CdrBuilder(Vec<u8>);

impl CdrBuilder {
    /// Begins with a `std_msgs/msg/Header` with stamp 0 and an empty `frame_id`.
    pub fn header() -> Self {
        Self::default().u32(0).u32(0).text("")
    }

    /// Appends a 32-bit number.
    pub fn u32(mut self, value: u32) -> Self {
        self.0.resize(self.0.len().next_multiple_of(4), 0);
        self.0.extend(value.to_le_bytes());
        self
    }

    /// Appends a byte.
    pub fn u8(mut self, value: u8) -> Self {
        self.0.push(value);
        self
    }

    pub fn text(self, text: &str) -> Self {
        let mut cdr = self.u32(text.len() as u32 + 1);
        cdr.0.extend(text.as_bytes());
        cdr.u8(0)
    }

    /// Appends a sequence of bytes.
    pub fn bytes(self, bytes: &[u8]) -> Self {
        let mut cdr = self.u32(bytes.len() as u32);
        cdr.0.extend(bytes);
        cdr
    }

    /// Returns the CDR, without an encapsulation header.
    pub fn done(self) -> Vec<u8> {
        self.0
    }
}

/// Encodes an image message with the given fields, which may contradict each other.
pub fn image(width: u32, height: u32, encoding: &str, step: u32, data: &[u8]) -> Vec<u8> {
    CdrBuilder::header().u32(height).u32(width).text(encoding).u8(0).u32(step).bytes(data).done()
}

/// Encodes a compressed image message of format `jpeg`.
pub fn compressed(data: &[u8]) -> Vec<u8> {
    CdrBuilder::header().text("jpeg").bytes(data).done()
}

/// Writes the sample drive, truncated to the fraction `part` of its bytes.
pub fn truncated(folder: &TempFolder, part: f64) -> PathBuf {
    let whole = std::fs::read(sample_drive()).expect("the sample drive exists");
    let len = (whole.len() as f64 * part) as usize;
    folder.write("truncated.mcap", &whole[..len])
}

/// Writes the sample drive with the byte in its middle changed.
pub fn corrupted(folder: &TempFolder) -> PathBuf {
    let mut whole = std::fs::read(sample_drive()).expect("the sample drive exists");
    let middle = whole.len() / 2;
    whole[middle] ^= 0x55;
    folder.write("corrupted.mcap", whole)
}
