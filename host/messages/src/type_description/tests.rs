//! Tests with responses made by hand.

use sha2::{Digest, Sha256};

use super::*;

const STRING: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
const HEADER: &str = "RIHS01_f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01";

/// Name, kind and nested type of each field, by type.
type Types<'a> = &'a [(&'a str, &'a [(&'a str, u8, &'a str)])];

const HEADER_TYPES: Types<'_> = &[
    ("std_msgs/msg/Header", &[("stamp", 1, "builtin_interfaces/msg/Time"), ("frame_id", 17, "")]),
    ("builtin_interfaces/msg/Time", &[("sec", 6, ""), ("nanosec", 7, "")]),
];
const TEXTS: &[(&str, &str, &str)] = &[
    (
        "std_msgs/msg/Header",
        "msg",
        "# When and where.\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
    ),
    ("builtin_interfaces/msg/Time", "msg", "int32 sec\nuint32 nanosec\n"),
];

fn response(types: Types<'_>, texts: &[(&str, &str, &str)]) -> Vec<u8> {
    let mut cdr = CdrWriter::new();
    cdr.u8(1).string("");
    for (n, (name, fields)) in types.iter().enumerate() {
        if n == 1 {
            cdr.u32(types.len() as u32 - 1);
        }
        cdr.string(name).u32(fields.len() as u32);
        for (name, kind, nested) in *fields {
            cdr.string(name).u8(*kind).u64(0).u64(0).string(nested).string("");
        }
    }
    if types.len() == 1 {
        cdr.u32(0);
    }
    cdr.u32(texts.len() as u32);
    for (name, encoding, text) in texts {
        cdr.string(name).string(encoding).string(text);
    }
    cdr.u32(0);
    cdr.bytes().to_vec()
}

fn read(type_name: &str, hash: &str, cdr: &[u8]) -> Result<DescribedDefinitions, String> {
    DescribedDefinitions::read(type_name, hash, cdr, Endian::Little).map_err(|error| chain(&error))
}

#[test]
fn the_hashes_are_those_of_ros_2() {
    let string = response(&[("std_msgs/msg/String", &[("data", 17, "")])], &[]);
    assert_eq!(&*read("std_msgs/msg/String", STRING, &string).unwrap().text, "string data\n");
    assert!(read("std_msgs/msg/Header", HEADER, &response(HEADER_TYPES, &[])).is_ok());
}

/// The published hashes: those of `test_msgs`, as rosidl of Kilted generated them, and of
/// `sensor_msgs` of Humble and Jazzy.
#[test]
fn the_hashes_of_texts_are_those_that_nodes_announce() {
    let with_defaults = |ty: &str, name: &str, count: usize| {
        let line = |n| format!("{ty} {name}_default{n} \"a=b # c\" # d\n");
        format!("{ty} {name}\n") + &(1..=count).map(line).collect::<String>()
    };
    let strings = "\u{feff}".to_owned()
        + &with_defaults("string", "string_value", 5)
        + "string CONST=\"=\"\n"
        + &with_defaults("string<=22", "bounded_string_value", 5);
    let wide = with_defaults("wstring", "wstring_value", 3)
        + "wstring[3] array_of_wstrings\nwstring[<=3] bounded_sequence_of_wstrings\n"
        + "wstring[] unbounded_sequence_of_wstrings";
    let types = "bool byte char float32 float64 int8 uint8 int16 uint16 int32 uint32 int64 uint64";
    let numbers: String = types.split(' ').map(|ty| format!("{ty} {ty}_value 1\n")).collect();
    let range = crate::Sources::default().find("sensor_msgs/Range").unwrap().unwrap();
    let newer = range.replacen("float32 range\n", "float32 range\nfloat32 variance\n", 1);
    let types = [
        ("test_msgs/Strings", strings.as_str()),
        ("test_msgs/msg/WStrings", &wide),
        ("test_msgs/Defaults", &numbers),
        ("test_msgs/Constants", "uint8 A=1"),
        ("sensor_msgs/Range", &range),
        ("sensor_msgs/Range", &newer),
    ];
    let hashes = [
        "eee55533636293ac7c94c62432eedb5777eb849847d2a17b4dcead8c4a20ab32",
        "5a2c8ddb2054600023b9a180652f2ba895373217cad4b1f0fc1258c9e4424a79",
        "a725ee02bf25a224cb7d14015a0245b6654ff591ae1ac277e2a2673f013ea6d2",
        "983e7ae7099d65b3030c31c2890b0ec2b332484fae9f28c68e01340c8f61edcf",
        "9430b1915b94d4268ff903679e8ecd09b6a67d331bd028738ec1eeb592891ebd",
        "b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a",
    ];
    for ((name, text), hash) in types.into_iter().zip(hashes) {
        assert_eq!(type_hash(name, text).unwrap(), format!("RIHS01_{hash}"), "{name}");
    }
    assert!(type_hash("car_msgs/action/Spin", "uint8 a").is_err());
    assert!(type_hash("car_msgs/Spin", "what is this").is_err());
}

/// The digest of the lines `TYPE HASH` of all bundled types, sorted, with the hashes of rosbags
/// 0.11.9 (`Typestore.hash_rihs01`); only of `std_msgs/msg/Char` that of rosidl, since rosbags does
/// not take `char` for `uint8`.
#[test]
fn the_hashes_of_all_bundled_types_are_those_of_another_program() {
    let bundled = include_str!("../bundled.msgs");
    let names = bundled.split("MSG: ").skip(1).filter_map(|part| part.split_once('\n'));
    let line = |(name, _): (&str, &str)| {
        let text = crate::Sources::default().find(name).unwrap().unwrap();
        format!("{} {}\n", full_name(name), type_hash(name, &text).unwrap())
    };
    let mut lines: Vec<String> = names.map(line).collect();
    lines.sort_unstable();
    let digest = Sha256::digest(lines.concat());
    let expected = "01b04e8607bf7889b5f3ebdec8bcc49e8626dba202a21973a21599aacc9746e2";
    assert_eq!((lines.len(), format!("{digest:x}").as_str()), (143, expected), "{lines:#?}");
}

#[test]
fn texts_are_used_if_they_are_equivalent_to_the_fields() {
    let described = read("std_msgs/Header", HEADER, &response(HEADER_TYPES, TEXTS)).unwrap();
    assert_eq!(described.without_texts, None);
    assert!(described.text.starts_with("# When and where.\n"), "{}", described.text);
    let nested = "MSG: builtin_interfaces/Time\nint32 sec\n";
    assert!(described.text.contains(nested), "{}", described.text);
}

#[test]
fn missing_invalid_or_wrong_texts_are_replaced_by_the_fields() {
    let root = |encoding: &'static str, text: &'static str| {
        [("std_msgs/msg/Header", encoding, text), TEXTS[1]]
    };
    let plain = "builtin_interfaces/Time stamp\nstring frame_id\n";
    for (texts, why) in [
        (&[][..], "no `.msg` text"),
        (&root("idl", "module std_msgs {};")[..], "no `.msg` text"),
        (&root("msg", "builtin_interfaces/Time stamp\nuint8[] frame_id\n"), "differs from"),
        (&root("msg", "what is this"), "cannot be used"),
        (&root("msg", "p/Gone stamp\nstring frame_id\n"), "cannot be found"),
        (&root("msg", "string a\n===\nMSG: std_msgs/Other\nstring b\n"), "more than one type"),
    ] {
        let described = read("std_msgs/Header", HEADER, &response(HEADER_TYPES, texts)).unwrap();
        assert!(described.text.starts_with(plain), "{}", described.text);
        let stated = described.without_texts.unwrap();
        assert!(stated.contains(why), "{stated:?} is not {why}");
    }
}

#[test]
fn a_response_with_another_hash_or_type_is_refused() {
    let another = HEADER.replace('f', "0");
    let error = read("std_msgs/Header", &another, &response(HEADER_TYPES, TEXTS)).unwrap_err();
    assert!(error.contains("hash"), "{error}");
    let error = read("std_msgs/msg/String", HEADER, &response(HEADER_TYPES, TEXTS)).unwrap_err();
    assert!(error.contains("describes `std_msgs/Header`"), "{error}");
}

#[test]
fn the_error_quotes_the_reason_of_the_node() {
    let mut cdr = CdrWriter::new();
    cdr.u8(0).string("TypeFields not in use\n");
    let error = read("std_msgs/Header", HEADER, cdr.bytes()).unwrap_err();
    assert_eq!(error, "the node refuses: \"TypeFields not in use\\n\"");
}

#[test]
fn invalid_names_and_kinds_are_refused() {
    for name in ["", "a b", "a\nuint8 b", "a\"", "é"] {
        let types: Types<'_> = &[("p/msg/T", &[(name, 3, "")])];
        let error = read("p/T", "", &response(types, &[])).unwrap_err();
        assert!(error.contains("invalid name"), "{name}: {error}");
    }
    for nested in ["", "T", "../T", "p/msg/a/b", "p/T\n"] {
        let types: Types<'_> = &[("p/msg/T", &[("a", 1, nested)])];
        let error = match read("p/T", "", &response(types, &[])).unwrap_err() {
            // The right hash is in the error.
            error if error.contains("with hash RIHS01_") => {
                let hash =
                    error.split_whitespace().find(|word| word.starts_with("RIHS01_")).unwrap();
                read("p/T", hash.trim_end_matches(','), &response(types, &[])).unwrap_err()
            }
            error => error,
        };
        assert!(error.contains("invalid name"), "{nested}: {error}");
    }
    for kind in [0, 12, 14, 19, 20, 23, 47, 48, 60, 192, 255] {
        let field = TypeField { name: "a", kind, capacity: 1, text_capacity: 1, nested: "".into() };
        assert!(matches!(in_msg(&field), Err(TypeDescriptionError::Kind { .. })), "{kind}");
    }
}

#[test]
fn every_kind_that_a_file_can_express_is_generated() {
    for (kind, nested, expected) in [
        (3, "", "uint8"),
        (11, "", "float64"),
        (1, "p/msg/T", "p/T"),
        (21, "", "string<=5"),
        (49, "p/msg/T", "p/T[9]"),
        (48 + 10, "", "float32[9]"),
        (96 + 22, "", "wstring<=5[<=9]"),
        (144 + 16, "", "byte[]"),
    ] {
        let (name, nested) = ("a", nested.into());
        let field = TypeField { name, kind, capacity: 9, text_capacity: 5, nested };
        assert_eq!(in_msg(&field).unwrap(), expected);
    }
}

#[test]
fn a_truncated_or_damaged_response_is_refused_or_read() {
    let whole = response(HEADER_TYPES, TEXTS);
    for length in 0..whole.len() - 8 {
        assert!(read("std_msgs/Header", HEADER, &whole[..length]).is_err(), "{length} bytes");
    }
    for at in 0..whole.len() {
        for value in [0, 1, 0x7f, 0xff] {
            let mut broken = whole.clone();
            broken[at] = value;
            // A parsed response has the right hash, so only its texts can differ.
            if let Ok(described) = read("std_msgs/Header", HEADER, &broken) {
                assert!(Definitions::parse("std_msgs/Header", &described.text).is_ok());
            }
        }
    }
    assert!(read("std_msgs/Header", HEADER, &[0xff; 4096]).is_err());
}

#[test]
fn a_request_has_the_form_of_the_service_after_its_header() {
    let plain = request("std_msgs/String", "H", None);
    assert_eq!(plain, b"\x14\0\0\0std_msgs/msg/String\0\x02\0\0\0H\0\x01");
    let headed = request("std_msgs/String", "H", Some(RequestHeader([1, 2])));
    assert_eq!(headed[16..], plain);
    let (header, rest) = RequestHeader::split(&headed, Endian::Little).unwrap();
    assert_eq!((header, rest), (RequestHeader([1, 2]), plain.as_slice()));
    assert_eq!(RequestHeader::split(&headed[..15], Endian::Little), None);
}
