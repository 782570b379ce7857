//! Messages of a drive, as the fake host of `gleaner_sdk::testing` takes them.

use std::path::Path;

use gleaner_image::{decode_rgb8, probe};
use gleaner_messages::{Definitions, Endian, FieldPath, Value};
use gleaner_sdk::data::Encoding;
use gleaner_sdk::testing::{FieldValue, Message};

/// One message, and when it was received.
pub struct Given {
    /// The input that it goes to.
    pub input: &'static str,
    /// Its log time.
    pub at_ns: i64,
    /// Its fields, bytes and pixels.
    pub message: Message,
}

/// An input: its name, its topic, and the paths of the fields that a test needs.
pub type Wanted = (&'static str, &'static str, &'static [&'static str]);

/// The stamp of a header, for [`Wanted`].
pub const STAMP: [&str; 2] = ["header.stamp.sec", "header.stamp.nanosec"];

/// The messages of `drive`, an MCAP file, by their log time. JPEG is decoded as by the host.
///
/// # Panics
///
/// If the drive cannot be read.
pub fn messages(drive: &Path, wanted: &[Wanted]) -> Vec<Given> {
    let bytes = std::fs::read(drive).expect("the drive is there");
    let mut last_seq = vec![0; wanted.len()];
    let mut given = Vec::new();
    for message in mcap::MessageStream::new(&bytes).expect("a drive") {
        let message = message.expect("a whole drive");
        let Some(number) = wanted.iter().position(|(_, topic, _)| *topic == message.channel.topic)
        else {
            continue;
        };
        let (input, _, paths) = wanted[number];
        // As the host numbers messages whose recorder did not.
        let seq = u64::from(message.sequence).max(last_seq[number] + 1);
        last_seq[number] = seq;
        let as_given =
            given_of(&message, paths).numbered(seq).published(message.publish_time as i64);
        given.push(Given { input, at_ns: message.log_time as i64, message: as_given });
    }
    given.sort_by_key(|given| given.at_ns);
    given
}

fn given_of(message: &mcap::Message<'_>, paths: &[&str]) -> Message {
    let schema = message.channel.schema.as_ref().expect("a schema");
    let text = String::from_utf8_lossy(&schema.data);
    let definitions = Definitions::parse(&schema.name, &text).expect("definitions");
    let endian = if message.data[1] & 1 == 0 { Endian::Big } else { Endian::Little };
    let cdr = &message.data[4..];
    let read = |path: &str| {
        FieldPath::compile(&definitions, path).expect("a field").read(cdr, endian).map(owned)
    };
    let pictured = match schema.name.as_str() {
        "sensor_msgs/msg/CompressedImage" => picture(cdr, &definitions, endian),
        _ => Message::new(),
    };
    let with =
        |message: Message, path: &&str| message.with(path, read(path).expect("a whole message"));
    paths.iter().fold(pictured, with).cdr(message.data.to_vec())
}

/// What the host makes of a JPEG or PNG.
fn picture(cdr: &[u8], definitions: &Definitions, endian: Endian) -> Message {
    let data = FieldPath::compile(definitions, "data").expect("a field");
    let Value::Bytes(data) = data.read(cdr, endian).expect("a whole message") else {
        panic!("no bytes")
    };
    let header = probe(data).expect("an image");
    let mut pixels = vec![0; header.rgb8_len().expect("an image of some size")];
    let room = pixels.len();
    decode_rgb8(data, &header, room, &mut pixels).expect("a whole image");
    Message::image(header.width, header.height, Encoding::Rgb8, pixels)
}

fn owned(value: Value<'_>) -> FieldValue {
    match value {
        Value::Bool(value) => value.into(),
        Value::Signed(value) => value.into(),
        Value::Unsigned(value) => value.into(),
        Value::Real(value) => value.into(),
        Value::Text(value) => value.into(),
        Value::Bytes(value) => value.into(),
        Value::Numbers(value) => value.into(),
        Value::Texts(value) => value.as_slice().into(),
    }
}
