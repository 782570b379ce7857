//! Fuzzes CDR messages, of the bundled types and of types that the input defines.
//!
//! An input is a byte for the mode, one for the byte order, the type (its index in [`TYPES`], or
//! its definition up to a byte 0), a path up to a byte 0, and the message. All fields of the type
//! are read, and the path.

use std::collections::VecDeque;
use std::sync::{Arc, OnceLock};

use gleaner_messages::{
    CdrError, CompressedView, Definitions, Endian, FieldPath, ImageView, MessageValue, PathError,
    Sources, ValueKind, header_stamp,
};

use crate::budget;
use crate::input::FuzzInput;

pub mod mode {
    /// A bundled type follows.
    pub const BUNDLED: u8 = 0;
    /// A definition follows.
    pub const DEFINED: u8 = 1;
}

/// Types of every shape: flat, nested, with arrays of structs, strings and arrays of strings.
pub const TYPES: [&str; 16] = [
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/NavSatFix",
    "std_msgs/msg/String",
    "std_msgs/msg/Header",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path",
    "tf2_msgs/msg/TFMessage",
    "diagnostic_msgs/msg/DiagnosticArray",
    "visualization_msgs/msg/MarkerArray",
    "rcl_interfaces/msg/ParameterEvent",
];

/// Maximum number of fields that are read of one type.
const PATHS_MAX: usize = 64;

/// Memory budget of a type and one path. A page of text may define 20,000 fields.
const DEFINITIONS_MEMORY: usize = 64 << 20;

/// Reads a message with every accessor. Returns whether any field could be read.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    let (mode, order) = (input.u8(), input.u8());
    let endian = if order & 1 == 0 { Endian::Little } else { Endian::Big };
    if mode == mode::DEFINED {
        let Ok(text) = std::str::from_utf8(input.until_zero()) else { return false };
        let path = input.until_zero();
        let parsed =
            budget::within(DEFINITIONS_MEMORY, || Definitions::parse("pkg/msg/Type", text));
        let Ok(definitions) = parsed else { return false };
        assert!(definitions.fields().next().is_some(), "a type without fields");
        let paths = budget::within(DEFINITIONS_MEMORY * 4, || all_paths(&definitions));
        return of_type(&definitions, &paths, path, input.0, endian);
    }
    let bundled = bundled();
    let place = usize::from(input.u8()) % bundled.len();
    let (definitions, paths) = &bundled[place];
    let path = input.until_zero();
    let valid = of_type(definitions, paths, path, input.0, endian);
    match place {
        0 => image_agrees(paths, input.0, endian),
        1 => compressed_agrees(paths, input.0, endian),
        _ => {}
    }
    valid
}

pub(crate) fn bundled_text(name: &str) -> Arc<str> {
    Sources::default().find(name).expect("bundled types are complete").expect("the type is bundled")
}

fn bundled() -> &'static [(Definitions, Vec<FieldPath>)] {
    static BUNDLED: OnceLock<Vec<(Definitions, Vec<FieldPath>)>> = OnceLock::new();
    BUNDLED.get_or_init(|| {
        let definitions = TYPES.map(|name| {
            Definitions::parse(name, &bundled_text(name)).expect("a bundled type parses")
        });
        definitions
            .into_iter()
            .map(|definitions| {
                let paths = all_paths(&definitions);
                (definitions, paths)
            })
            .collect()
    })
}

/// The first [`PATHS_MAX`] fields of a type; of an array of structs, those of the first and the
/// third element.
fn all_paths(definitions: &Definitions) -> Vec<FieldPath> {
    let mut open: VecDeque<String> = definitions.fields().map(str::to_owned).collect();
    let mut paths = Vec::new();
    while let Some(path) = open.pop_front().filter(|_| paths.len() < PATHS_MAX) {
        match FieldPath::compile(definitions, &path) {
            Ok(compiled) => {
                assert_eq!(
                    (compiled.path(), compiled.type_name()),
                    (path.as_str(), definitions.type_name())
                );
                paths.push(compiled);
            }
            Err(PathError::WholeStruct { fields, .. }) => {
                open.extend(fields.iter().take(PATHS_MAX).map(|field| format!("{path}.{field}")));
            }
            Err(PathError::NeedsIndex { .. }) => {
                open.extend([0, 2].map(|index| format!("{path}[{index}]")))
            }
            // An array of fixed length may be shorter.
            Err(PathError::WideText { .. } | PathError::OutOfRange { .. }) => {}
            Err(error) => panic!("`{path}` is a field: {error}"),
        }
        // Nested structs have exponentially many paths.
        open.truncate(4 * PATHS_MAX);
    }
    paths
}

fn of_type(
    definitions: &Definitions,
    paths: &[FieldPath],
    path: &[u8],
    cdr: &[u8],
    endian: Endian,
) -> bool {
    let written = std::str::from_utf8(path).ok().filter(|path| !path.is_empty());
    let written = written.and_then(|path| {
        budget::within(DEFINITIONS_MEMORY, || FieldPath::compile(definitions, path)).ok()
    });
    let longer = [cdr, &[0xa5; 9]].concat();
    stamp(definitions, cdr, endian);
    let read = paths.iter().chain(&written).filter(|path| field(path, cdr, &longer, endian));
    read.count() > 0
}

/// Checks that all accessors read the same value of a field, and that bytes after the message do
/// not change it. Returns whether the field could be read.
fn field(path: &FieldPath, cdr: &[u8], longer: &[u8], endian: Endian) -> bool {
    // A number takes at least one byte in the message and eight in memory, a string four and
    // sixteen; a vector grows by doubling.
    let memory = (64 << 10) + 32 * cdr.len();
    let read = budget::within(memory, || path.read(cdr, endian));
    let number = budget::within(4096, || path.number(cdr, endian));
    let again = path.read(longer, endian);
    let Ok(value) = read else {
        assert!(number.is_err(), "{}: a number of an unreadable field", path.path());
        return false;
    };
    assert!(
        again.is_ok_and(|again| same(&value, &again)),
        "{}: bytes after the message change it",
        path.path()
    );
    let inside = |bytes: &[u8]| {
        let (all, part) = (cdr.as_ptr_range(), bytes.as_ptr_range());
        assert!(
            bytes.is_empty() || all.start <= part.start && part.end <= all.end,
            "bytes outside the message"
        );
    };
    let (kind, expected) = match &value {
        MessageValue::Bool(truth) => (ValueKind::Bool, Some(f64::from(u8::from(*truth)))),
        MessageValue::Signed(number) => (ValueKind::Signed, Some(*number as f64)),
        MessageValue::Unsigned(number) => (ValueKind::Unsigned, Some(*number as f64)),
        MessageValue::Real(number) => (ValueKind::Real, Some(*number)),
        MessageValue::Text(text) => {
            inside(text.as_bytes());
            (ValueKind::Text, None)
        }
        MessageValue::Bytes(bytes) => {
            inside(bytes);
            (ValueKind::Bytes, None)
        }
        MessageValue::Numbers(numbers) => {
            assert!(numbers.len() <= cdr.len());
            (ValueKind::Numbers, None)
        }
        MessageValue::Texts(texts) => {
            assert!(texts.len() <= cdr.len() / 4);
            texts.iter().for_each(|text| inside(text.as_bytes()));
            (ValueKind::Texts, None)
        }
    };
    assert_eq!(
        (path.kind(), path.kind().is_number()),
        (kind, expected.is_some()),
        "{}",
        path.path()
    );
    match (expected, number) {
        (Some(expected), Ok(number)) => {
            assert_eq!(expected.to_bits(), number.to_bits(), "{}", path.path())
        }
        (None, Err(CdrError::NotANumber)) => {}
        (_, number) => panic!("{}: {value:?} as a number is {number:?}", path.path()),
    }
    true
}

/// As `==`, but NaN equals itself.
fn same(a: &MessageValue, b: &MessageValue) -> bool {
    match (a, b) {
        (MessageValue::Real(a), MessageValue::Real(b)) => a.to_bits() == b.to_bits(),
        (MessageValue::Numbers(a), MessageValue::Numbers(b)) => {
            a.iter().map(|number| number.to_bits()).eq(b.iter().map(|number| number.to_bits()))
        }
        _ => a == b,
    }
}

/// Checks that the fast accessor of the header's stamp agrees with the field paths.
fn stamp(definitions: &Definitions, cdr: &[u8], endian: Endian) {
    let Some(quick) = header_stamp(definitions) else { return };
    let first = definitions.fields().next().expect("a type has fields");
    let part = |name: &str| {
        // A header may have fields of these names beside its stamp.
        let inside = [format!("{first}.stamp.{name}"), format!("{first}.{name}")];
        let path = inside.iter().find_map(|path| FieldPath::compile(definitions, path).ok());
        path.and_then(|path| match path.read(cdr, endian) {
            Ok(MessageValue::Signed(number)) => Some(number),
            Ok(MessageValue::Unsigned(number)) => i64::try_from(number).ok(),
            _ => None,
        })
    };
    let slow = part("sec")
        .zip(part("nanosec"))
        .map(|(sec, nanosec)| i128::from(sec) * 1_000_000_000 + i128::from(nanosec));
    assert_eq!(
        quick.read(cdr, endian).ok().map(i128::from),
        slow,
        "the stamp of {}",
        definitions.type_name()
    );
}

fn image_agrees(paths: &[FieldPath], cdr: &[u8], endian: Endian) {
    let Ok(view) = budget::within(4096, || ImageView::read(cdr, endian)) else { return };
    let expected = [
        ("width", MessageValue::Unsigned(view.width.into())),
        ("height", MessageValue::Unsigned(view.height.into())),
        ("encoding", MessageValue::Text(view.encoding)),
        ("step", MessageValue::Unsigned(view.step.into())),
        ("data", MessageValue::Bytes(view.data)),
    ];
    paths_agree(paths, cdr, endian, &expected);
}

fn compressed_agrees(paths: &[FieldPath], cdr: &[u8], endian: Endian) {
    let Ok(view) = budget::within(4096, || CompressedView::read(cdr, endian)) else { return };
    paths_agree(
        paths,
        cdr,
        endian,
        &[("format", MessageValue::Text(view.format)), ("data", MessageValue::Bytes(view.data))],
    );
}

fn paths_agree(paths: &[FieldPath], cdr: &[u8], endian: Endian, expected: &[(&str, MessageValue)]) {
    for (name, value) in expected {
        let path = paths.iter().find(|path| path.path() == *name).expect("an image has this field");
        assert_eq!(path.read(cdr, endian).as_ref(), Ok(value), "{name}");
    }
}
