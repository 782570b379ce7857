//! Tests definitions and field paths against bytes put together by hand.

use std::sync::Arc;

use gleaner_drives::Replay;
use gleaner_messages::transport::Transport;
use gleaner_messages::{
    CdrError, CompressedView, Definitions, Endian, FieldPath, ImageView, MessageValue, PathError,
    ValueKind, header_stamp,
};
use gleaner_test_support::drives::sample_drive;

macro_rules! numbers {
    ($($name:ident)*) => {$(
        fn $name(self, value: $name) -> Self {
            self.put(value.to_le_bytes())
        }
    )*};
}

/// Writes CDR as a ROS 2 node does, implemented independently of the parser under test.
struct CdrBytes {
    bytes: Vec<u8>,
    endian: Endian,
}

impl CdrBytes {
    fn new(endian: Endian) -> Self {
        Self { bytes: Vec::new(), endian }
    }

    fn put<const N: usize>(mut self, mut little: [u8; N]) -> Self {
        while !self.bytes.len().is_multiple_of(N) {
            self.bytes.push(0xAA);
        }
        if self.endian == Endian::Big {
            little.reverse();
        }
        self.bytes.extend(little);
        self
    }

    numbers! { u8 i16 u16 i32 u32 i64 f32 f64 }

    fn text(self, value: &str) -> Self {
        let mut cdr = self.u32(value.len() as u32 + 1);
        cdr.bytes.extend(value.as_bytes());
        cdr.bytes.push(0);
        cdr
    }

    fn blob(self, value: &[u8]) -> Self {
        let mut cdr = self.u32(value.len() as u32);
        cdr.bytes.extend(value);
        cdr
    }
}

const MIXED: &str = "\
bool flag
uint8 KIND_A=1
string name \"# not a comment\"
Item[] items
Item[2] pair
float64[] numbers
byte[] blob
string[] labels
Corner[] corners
float64[3] k
int16[<=4] shorts
Empty nothing
int64 last
================================================================================
MSG: test_msgs/Item
uint8 id
string<=40 text
float64 weight
uint16[] codes
================================================================================
MSG: test_msgs/msg/Corner
float32 x
float64 y
uint8 tag
===
MSG: test_msgs/Empty
int32 NO_FIELDS=7
";

/// Encodes a message of the type above; `pad` shifts everything after its name.
fn mixed(endian: Endian, pad: usize, items: usize) -> Vec<u8> {
    let item = |cdr: CdrBytes, n: usize| {
        let mut cdr = cdr.u8(n as u8).text(&"t".repeat(n)).f64(n as f64 + 0.5).u32(n as u32);
        for code in 0..n {
            cdr = cdr.u16(code as u16 + 100);
        }
        cdr
    };
    let mut cdr = CdrBytes::new(endian).u8(1).text(&"p".repeat(pad)).u32(items as u32);
    for n in 0..items {
        cdr = item(cdr, n);
    }
    cdr = item(item(cdr, 1), 2);
    cdr = cdr.u32(2).f64(1.25).f64(-2.5).blob(b"blob").u32(2).text("one").text("two").u32(3);
    for n in 0..3 {
        cdr = cdr.f32(n as f32).f64(n as f64 * 10.0).u8(n as u8);
    }
    cdr.f64(7.0).f64(8.0).f64(9.0).u32(3).i16(-1).i16(-2).i16(-3).u8(0).i64(-99).bytes
}

fn definitions() -> Definitions {
    Definitions::parse("test_msgs/msg/Mixed", MIXED).unwrap()
}

fn path(path: &str) -> FieldPath {
    FieldPath::compile(&definitions(), path).unwrap()
}

/// Each path with its value in `mixed(_, pad, 3)`.
fn truths() -> Vec<(&'static str, MessageValue<'static>)> {
    vec![
        ("flag", MessageValue::Bool(true)),
        ("items[0].id", MessageValue::Unsigned(0)),
        ("items[2].text", MessageValue::Text("tt")),
        ("items[2].weight", MessageValue::Real(2.5)),
        ("items[2].codes", MessageValue::Numbers(vec![100.0, 101.0])),
        ("items[2].codes[1]", MessageValue::Unsigned(101)),
        ("pair[1].weight", MessageValue::Real(2.5)),
        ("pair[1].codes[0]", MessageValue::Unsigned(100)),
        ("numbers", MessageValue::Numbers(vec![1.25, -2.5])),
        ("numbers[1]", MessageValue::Real(-2.5)),
        ("blob", MessageValue::Bytes(b"blob")),
        ("blob[3]", MessageValue::Unsigned(b'b'.into())),
        ("labels", MessageValue::Texts(vec!["one", "two"])),
        ("labels[1]", MessageValue::Text("two")),
        ("corners[2].x", MessageValue::Real(2.0)),
        ("corners[2].y", MessageValue::Real(20.0)),
        ("corners[1].tag", MessageValue::Unsigned(1)),
        ("k", MessageValue::Numbers(vec![7.0, 8.0, 9.0])),
        ("k[2]", MessageValue::Real(9.0)),
        ("shorts", MessageValue::Numbers(vec![-1.0, -2.0, -3.0])),
        ("shorts[2]", MessageValue::Signed(-3)),
        ("nothing.structure_needs_at_least_one_member", MessageValue::Unsigned(0)),
        ("last", MessageValue::Signed(-99)),
    ]
}

#[test]
fn every_field_is_found_behind_strings_of_every_length_in_both_byte_orders() {
    for endian in [Endian::Little, Endian::Big] {
        for pad in 0..17 {
            let bytes = mixed(endian, pad, 3);
            for (name, truth) in truths() {
                let read = path(name).read(&bytes, endian);
                assert_eq!(read, Ok(truth), "{name}, {endian:?}, name of {pad} letters");
            }
        }
    }
}

#[test]
fn every_prefix_of_a_message_gives_the_value_or_an_error() {
    let bytes = mixed(Endian::Little, 5, 3);
    for (name, truth) in truths() {
        let path = path(name);
        let mut complete = false;
        for end in 0..=bytes.len() {
            match path.read(&bytes[..end], Endian::Little) {
                Ok(value) => {
                    assert_eq!(value, truth, "{name} in the first {end} bytes");
                    complete = true;
                }
                Err(_) => assert!(!complete, "{name} cannot be read any more at {end} bytes"),
            }
        }
        assert!(complete, "{name}");
    }
}

#[test]
fn any_value_of_any_byte_is_harmless() {
    let bytes = mixed(Endian::Little, 5, 3);
    let paths: Vec<_> = truths().iter().map(|(name, _)| path(name)).collect();
    for at in 0..bytes.len() {
        for value in [0, 1, 0x7f, 0x80, 0xff] {
            let mut bytes = bytes.clone();
            bytes[at] = value;
            for path in &paths {
                // Reading may fail or succeed; it ends, and allocates no more than the message.
                if let Ok(MessageValue::Numbers(numbers)) = path.read(&bytes, Endian::Little) {
                    assert!(numbers.len() <= bytes.len());
                }
            }
        }
    }
}

#[test]
fn numbers_are_read_from_every_scalar() {
    let bytes = mixed(Endian::Big, 3, 3);
    let number = |name: &str| path(name).number(&bytes, Endian::Big);
    assert_eq!(number("flag"), Ok(1.0));
    assert_eq!(number("shorts[0]"), Ok(-1.0));
    assert_eq!(number("items[1].codes[0]"), Ok(100.0));
    assert_eq!(number("last"), Ok(-99.0));
    assert_eq!(number("name"), Err(CdrError::NotANumber));
    assert!(!path("name").kind().is_number());
    assert_eq!(path("labels").kind(), ValueKind::Texts);
}

#[test]
fn an_empty_sequence_needs_no_padding() {
    let text = "float64[] empty\nuint8 next";
    let definitions = Definitions::parse("p/T", text).unwrap();
    let next = FieldPath::compile(&definitions, "next").unwrap();
    assert_eq!(next.number(&[0, 0, 0, 0, 42], Endian::Little), Ok(42.0));
}

#[test]
fn the_error_names_a_missing_element() {
    let bytes = mixed(Endian::Little, 0, 1);
    let error = path("items[4].id").read(&bytes, Endian::Little).unwrap_err();
    assert!(matches!(error, CdrError::Index { index: 4, count: 1, .. }));
}

#[test]
fn a_claimed_count_allocates_nothing() {
    let definitions = Definitions::parse("p/T", "float64[] values").unwrap();
    let values = FieldPath::compile(&definitions, "values").unwrap();
    let claim = [0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0];
    let error = values.read(&claim, Endian::Little).unwrap_err();
    assert_eq!(error, CdrError::Count { offset: 0, count: u32::MAX as usize, have: 4 });
}

#[test]
fn errors_of_paths_name_the_valid_ones() {
    let refuse = |path: &str| FieldPath::compile(&definitions(), path).unwrap_err();
    assert_eq!(
        refuse("items[0].wieght").to_string(),
        "type `test_msgs/msg/Item` has no field `wieght` (did you mean `weight`?); \
         it has: id, text, weight, codes"
    );
    assert_eq!(
        refuse("pair[0]").to_string(),
        "`pair[0]` is a whole `test_msgs/msg/Item`; name one of its fields: id, text, weight, codes"
    );
    assert!(matches!(refuse("items"), PathError::NeedsIndex { .. }));
    assert!(matches!(refuse("items.id"), PathError::NeedsIndex { .. }));
    assert!(matches!(refuse("pair[2].id"), PathError::OutOfRange { len: 2, .. }));
    assert!(matches!(refuse("items[99999999999].id"), PathError::OutOfRange { .. }));
    assert!(matches!(refuse("flag.x"), PathError::NothingInside { .. }));
    assert!(matches!(refuse("flag[0]"), PathError::NothingInside { .. }));
    for malformed in
        ["", ".", "a.", "a..b", "a[", "a[x]", "a[-1]", "a[+1]", "a[]", "a]", "[0]", "a[0]b"]
    {
        assert!(matches!(refuse(malformed), PathError::Syntax { .. }), "`{malformed}`");
    }
}

#[test]
fn a_wstring_blocks_only_later_fields() {
    let definitions = Definitions::parse("p/T", "int8 before\nwstring w\nint8 behind").unwrap();
    assert!(FieldPath::compile(&definitions, "before").is_ok());
    for blocked in ["w", "behind"] {
        let error = FieldPath::compile(&definitions, blocked).unwrap_err();
        assert!(matches!(error, PathError::WideText { .. }));
    }
}

const IMAGE: &str = "\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
===
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
";

#[test]
fn the_image_view_agrees_with_the_field_paths() {
    let definitions = Definitions::parse("sensor_msgs/msg/Image", IMAGE).unwrap();
    for endian in [Endian::Little, Endian::Big] {
        for frame in ["", "c", "camera", "camera_front"] {
            let cdr = CdrBytes::new(endian).i32(5).u32(7).text(frame).u32(2).u32(3).text("bgr8");
            let bytes = cdr.u8(0).u32(9).blob(&[1; 18]).bytes;
            let view = ImageView::read(&bytes, endian).unwrap();
            assert_eq!((view.width, view.height, view.step), (3, 2, 9));
            assert_eq!((view.encoding, view.is_bigendian), ("bgr8", false));
            assert_eq!(view.data, [1; 18]);
            for (name, value) in [("width", 3.0), ("step", 9.0), ("header.stamp.nanosec", 7.0)] {
                let path = FieldPath::compile(&definitions, name).unwrap();
                assert_eq!(path.number(&bytes, endian), Ok(value));
            }
            let stamp = header_stamp(&definitions).unwrap();
            assert_eq!(stamp.read(&bytes, endian), Ok(5_000_000_007));
            for end in 0..bytes.len() {
                assert!(ImageView::read(&bytes[..end], endian).is_err());
                assert!(CompressedView::read(&bytes[..end], endian).is_err() || end > 0);
            }
        }
    }
}

#[test]
fn the_definitions_of_the_sample_drive_are_parsed() {
    let replay = Replay::open(&[sample_drive()]).unwrap();
    let of = |topic: &str| -> Arc<Definitions> { replay.definitions(topic).unwrap() };
    for (topic, type_name, number) in [
        ("/imu/data", "sensor_msgs/msg/Imu", "linear_acceleration_covariance[8]"),
        ("/vehicle/speed", "geometry_msgs/msg/TwistStamped", "twist.linear.x"),
        ("/camera/front/compressed", "sensor_msgs/msg/CompressedImage", "header.stamp.sec"),
    ] {
        let definitions = of(topic);
        assert_eq!(definitions.type_name(), type_name);
        assert!(FieldPath::compile(&definitions, number).unwrap().kind().is_number());
        assert!(header_stamp(&definitions).is_some());
    }
    let fields: Vec<_> = of("/camera/front/compressed").fields().map(str::to_owned).collect();
    assert_eq!(fields, ["header", "format", "data"]);
    assert!(Arc::ptr_eq(&of("/imu/data"), &of("/imu/data")));
}
