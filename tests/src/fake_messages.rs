//! Reads messages of a drive into the form of the fake host of `gleaner_sdk::testing`.

use std::path::Path;

use gleaner_messages::{Definitions, Endian, FieldPath, MessageValue};
use gleaner_pixels::{decode_rgb8, probe};
use gleaner_sdk::data::Encoding;
use gleaner_sdk::testing::{FieldValue, Message};

/// One message, with its input and log time.
pub struct FakeMessage {
    pub input: &'static str,
    /// Its log time.
    pub at_ns: i64,
    /// Its fields, bytes and pixels.
    pub message: Message,
}

/// Name and topic of an input, and the paths of the fields that a test needs.
pub type InputFields = (&'static str, &'static str, &'static [&'static str]);

/// Field paths of a header's stamp, for [`InputFields`].
pub const STAMP: [&str; 2] = ["header.stamp.sec", "header.stamp.nanosec"];

/// The messages of `drive`, an MCAP file, by log time. JPEG is decoded as by the host.
pub fn messages(drive: &Path, wanted: &[InputFields]) -> Vec<FakeMessage> {
    let bytes = std::fs::read(drive).expect("the drive exists");
    let mut last_seq = vec![0; wanted.len()];
    let mut found = Vec::new();
    for message in mcap::MessageStream::new(&bytes).expect("a drive") {
        let message = message.expect("a complete drive");
        let Some(number) = wanted.iter().position(|(_, topic, _)| *topic == message.channel.topic)
        else {
            continue;
        };
        let (input, _, paths) = wanted[number];
        // The host numbers messages in this way if their recorder did not.
        let seq = u64::from(message.sequence).max(last_seq[number] + 1);
        last_seq[number] = seq;
        let message_of_input =
            fake_message(&message, paths).numbered(seq).published(message.publish_time as i64);
        found.push(FakeMessage {
            input,
            at_ns: message.log_time as i64,
            message: message_of_input,
        });
    }
    found.sort_by_key(|message| message.at_ns);
    found
}

fn fake_message(message: &mcap::Message<'_>, paths: &[&str]) -> Message {
    let schema = message.channel.schema.as_ref().expect("a schema");
    let text = String::from_utf8_lossy(&schema.data);
    let definitions = Definitions::parse(&schema.name, &text).expect("definitions");
    let endian = if message.data[1] & 1 == 0 { Endian::Big } else { Endian::Little };
    let cdr = &message.data[4..];
    let read = |path: &str| {
        FieldPath::compile(&definitions, path).expect("a field").read(cdr, endian).map(owned)
    };
    let image = match schema.name.as_str() {
        "sensor_msgs/msg/CompressedImage" => picture(cdr, &definitions, endian),
        _ => Message::new(),
    };
    let with =
        |message: Message, path: &&str| message.with(path, read(path).expect("a complete message"));
    paths.iter().fold(image, with).cdr(message.data.to_vec())
}

/// Decodes a JPEG or PNG as the host does.
fn picture(cdr: &[u8], definitions: &Definitions, endian: Endian) -> Message {
    let data = FieldPath::compile(definitions, "data").expect("a field");
    let MessageValue::Bytes(data) = data.read(cdr, endian).expect("a complete message") else {
        panic!("no bytes")
    };
    let header = probe(data).expect("an image");
    let mut pixels = vec![0; header.rgb8_len().expect("an image of some size")];
    let room = pixels.len();
    decode_rgb8(data, &header, room, &mut pixels).expect("a complete image");
    Message::image(header.width, header.height, Encoding::Rgb8, pixels)
}

fn owned(value: MessageValue<'_>) -> FieldValue {
    match value {
        MessageValue::Bool(value) => value.into(),
        MessageValue::Signed(value) => value.into(),
        MessageValue::Unsigned(value) => value.into(),
        MessageValue::Real(value) => value.into(),
        MessageValue::Text(value) => value.into(),
        MessageValue::Bytes(value) => value.into(),
        MessageValue::Numbers(value) => value.into(),
        MessageValue::Texts(value) => value.as_slice().into(),
    }
}
