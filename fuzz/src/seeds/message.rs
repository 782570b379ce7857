//! Seeds: messages full of ones, which are valid lengths too, of every type.

use gleaner_messages::CdrWriter;

use crate::message::{TYPES, bundled_text, mode};

/// Dictionary of definitions and paths.
pub const WORDS: &[&str] = &[
    "bool",
    "byte",
    "char",
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
    "float32",
    "float64",
    "string",
    "wstring",
    "string<=5",
    "[]",
    "[3]",
    "[<=3]",
    "[0]",
    "[2]",
    "Header header",
    "std_msgs/Header",
    "builtin_interfaces/Time stamp",
    "\n===\nMSG: pkg/Other\n",
    "pkg/Other",
    "Other x",
    "rgb8",
    "header.stamp.sec",
    "frame_id",
    "# ",
    " = 1",
    "=\"a\"",
];

/// Definitions of every kind of field.
const DEFINED: [&str; 4] = [
    "bool a\nint8 b\nuint16 c\nfloat64 d\nstring e\nint32[3] f\nuint8[] g\nfloat32[<=4] h\n\
     string[] i\nstring<=8[2] j\nint8 K=3\n",
    "Header header\nOther[] others\nOther[2] two\n===\nMSG: pkg/Other\nstring name\n\
     int64[] numbers\n===\nMSG: std_msgs/Header\n\
     builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time stamp\nEmpty nothing\nEmpty[3] more\nwstring wide\nint8 behind\n\
     ===\nMSG: pkg/Empty\n",
    "pkg/msg/A a\n===\nMSG: pkg/A\nB[4] b\n===\nMSG: pkg/B\nC[] c\n===\nMSG: pkg/C\n\
     string[2] d\nfloat64 e # with a comment\n",
];

pub fn all() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    let ones = |order: u8| if order == 0 { [1, 0, 0, 0] } else { [0, 0, 0, 1] }.repeat(80);
    for (place, order) in (0..TYPES.len()).flat_map(|place| [(place, 0), (place, 1)]) {
        seeds.push([&[mode::BUNDLED, order, place as u8, 0][..], &ones(order)].concat());
    }
    let defined = |text: &str, body: &[u8]| {
        [&[mode::DEFINED, 0][..], text.as_bytes(), &[0, 0], body].concat()
    };
    for text in DEFINED {
        seeds.push(defined(text, &ones(0)));
    }
    for name in
        ["sensor_msgs/msg/Imu", "diagnostic_msgs/msg/DiagnosticArray", "tf2_msgs/msg/TFMessage"]
    {
        seeds.push(defined(&bundled_text(name), &ones(0)));
    }
    seeds.extend([image(), compressed()]);
    seeds
}

fn image() -> Vec<u8> {
    let mut cdr = CdrWriter::new();
    cdr.time(5_000_000_007).string("camera").u32(2).u32(4).string("mono8").u32(4 << 8).u32(8);
    [&[mode::BUNDLED, 0, 0][..], b"data\0", cdr.bytes(), &[7; 8]].concat()
}

fn compressed() -> Vec<u8> {
    let mut cdr = CdrWriter::new();
    cdr.time(5_000_000_007).string("camera").string("jpeg").u32(6);
    [&[mode::BUNDLED, 0, 1][..], b"header.frame_id\0", cdr.bytes(), &[7; 6]].concat()
}
