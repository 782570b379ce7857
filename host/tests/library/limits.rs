//! Default and maximum limits of a lambda: a greedy guest is stopped with the cause, and the host
//! stays small.

use std::sync::Arc;

use crate::greedy::{FUEL, MEMORY, PICTURE, TestGuest, component, publish, subscribed};
use gleaner_host::api::data::{DataError, PATH_BYTES, SAMPLES_PER_CALL, TEXTS_PER_FIELD, Topic};
use gleaner_host::guest::Guest;
use gleaner_lambda::FaultKind;
use gleaner_lambda::manifest::{Limits, Manifest};
use gleaner_protocol::process_stats::usage;
use gleaner_tests::drive::{COMPRESSED, CdrBuilder, IMAGE, image};

/// Maximum result of one call.
const BYTES_PER_CALL: usize = Limits::MAX.call_bytes.bytes() as usize;
const COLUMN_LEN: usize = Limits::MAX.call_items as usize;
const PAGE: u64 = 64 << 10;

#[test]
fn a_guest_that_keeps_handles_is_stopped_and_the_next_one_starts_with_none() {
    for behaviour in ["topics", "fields"] {
        let mut test = TestGuest::greedy(behaviour, 0);
        test.guest.init().unwrap();
        let owners = Arc::strong_count(&test.topic);
        let first = test.fault();
        assert_eq!(first.kind, FaultKind::HostCall, "{behaviour}: {first:?}");
        let allowed = Limits::DEFAULT.handles;
        let message = &first.message;
        assert!(message.contains(&format!("{allowed} handles")), "{behaviour}: {message}");
        assert_eq!((first.used, first.allowed), (Some(allowed + 1), Some(allowed)), "{behaviour}");
        // The guest released its handles, so the second one reaches the same number.
        assert!(Arc::strong_count(&test.topic) < owners, "{behaviour}");
        assert_eq!(test.fault(), first, "{behaviour}");
    }
}

#[test]
fn an_endless_init_ends_with_its_fuel() {
    let fault = TestGuest::greedy("endless_init", 0).guest.init().unwrap_err();
    let allowed = 20 * FUEL;
    assert_eq!((fault.kind, fault.allowed), (FaultKind::Fuel, Some(allowed)));
    let expected = "in init: used 100,000,000 units of fuel; [limits] allows 100,000,000: do less";
    assert!(fault.message.starts_with(expected), "{}", fault.message);
}

#[test]
fn the_work_of_the_host_costs_fuel_by_the_byte() {
    for behaviour in ["read_cdr", "read_frame"] {
        let [some, more, most] =
            [50_000, 100_000, 200_000].map(|bytes| TestGuest::greedy(behaviour, bytes).fuel());
        // One unit per eight bytes; the guest's own work does not depend on them.
        let near = |fuel: u64, bytes: u64| fuel.abs_diff(bytes / 8) < 500;
        assert!(
            near(more - some, 50_000) && near(most - more, 100_000),
            "{behaviour}: {some} {more} {most}"
        );
    }
    let (luma, idle) =
        (TestGuest::greedy("mean_luma", 0).fuel(), TestGuest::greedy("ok", 0).fuel());
    assert!(luma - idle >= u64::from(PICTURE) / 8, "{luma} and {idle}");
}

#[test]
fn a_long_text_is_refused_by_its_length_and_charged() {
    let mut test = TestGuest::greedy("long_label", 100_000);
    let outcome = test.wake();
    let fault = outcome.result.unwrap_err();
    assert_eq!(fault.kind, FaultKind::Exception);
    assert!(fault.message.contains("the label has 100000 bytes"), "{}", fault.message);
    assert!(outcome.fuel.unwrap() >= 100_000 / 8);
}

/// A component with two more memories or tables, each in its own module; `$a` and `$b` grow them.
fn two_stores([a, b]: [&str; 2], wake: &str) -> String {
    let parts = format!(
        r#"(core module $a {a}) (core instance $a (instantiate $a))
           (core module $b {b}) (core instance $b (instantiate $b))"#
    );
    let body = format!(
        r#"(import "a" "grow" (func $a (param i32) (result i32)))
           (import "b" "grow" (func $b (param i32) (result i32)))
           (func $wake {wake})"#
    );
    component(&parts, r#"(with "a" (instance $a)) (with "b" (instance $b))"#, &body)
}

/// A module with a memory of `pages`, as in `1` or `1 2`.
fn memory(pages: &str) -> String {
    format!(
        r#"(memory {pages}) (func (export "grow") (param i32) (result i32) (memory.grow (local.get 0)))"#
    )
}

/// A module with a table of `elements`, likewise.
fn table(elements: &str) -> String {
    let grow = "(param i32) (result i32) (table.grow (ref.null func) (local.get 0))";
    format!(r#"(table {elements} funcref) (func (export "grow") {grow})"#)
}

/// Traps if a growth was refused, or if it was not.
const MUST: &str = "(if (i32.eq (i32.const -1)) (then (unreachable)))";
const MUST_NOT: &str = "(if (i32.ne (i32.const -1)) (then (unreachable)))";

#[test]
fn the_memories_of_a_component_count_together() {
    // 100 pages for each are within the cap of 256; 200 for each are not.
    let grow = |pages| {
        format!("(call $a (i32.const {pages})) {MUST} (call $b (i32.const {pages})) {MUST}")
    };
    let stores = [memory("1"), memory("1")];
    let wake = |pages| {
        TestGuest::written(&two_stores(stores.each_ref().map(String::as_str), &grow(pages))).wake()
    };
    wake(100).result.unwrap();
    let fault = wake(200).result.unwrap_err();
    let asked = (200 + 200 + 3) * PAGE;
    assert_eq!(
        (fault.kind, fault.used, fault.allowed),
        (FaultKind::Memory, Some(asked), Some(MEMORY))
    );
}

#[test]
fn a_component_that_starts_with_more_memory_than_it_may_have_does_not_start() {
    let large = memory("200");
    let fault = TestGuest::written(&two_stores([&large, &large], "")).guest.init().unwrap_err();
    assert_eq!(
        (fault.kind, fault.used, fault.allowed),
        (FaultKind::Memory, Some(400 * PAGE), Some(MEMORY))
    );
    let message = &fault.message;
    assert!(message.starts_with("in init: asked for 25.0 MiB; `memory` in [limits]"), "{message}");
}

#[test]
fn memory_that_was_asked_for_and_not_given_is_not_counted() {
    // A memory does not grow beyond its own maximum, whatever the cap: 250 pages remain for the
    // other.
    let wake = format!("(call $a (i32.const 200)) {MUST_NOT} (call $b (i32.const 250)) {MUST}");
    TestGuest::written(&two_stores([&memory("1 2"), &memory("1")], &wake)).wake().result.unwrap();
}

#[test]
fn the_tables_of_a_component_count_together() {
    let grow = |n| format!("(call $a (i32.const {n})) {MUST} (call $b (i32.const {n}))");
    let wake = |wake: String| {
        TestGuest::written(&two_stores([&table("1"), &table("1")], &wake)).wake().result
    };
    wake(grow(9000) + MUST).unwrap();
    wake(grow(15_000) + MUST_NOT).unwrap();
}

#[test]
fn elements_that_were_asked_for_and_not_given_are_not_counted() {
    let wake = format!("(call $a (i32.const 15000)) {MUST_NOT} (call $b (i32.const 15000)) {MUST}");
    TestGuest::written(&two_stores([&table("1 2"), &table("1")], &wake)).wake().result.unwrap();
}

/// A component that at each wake runs `first`, and then triggers an event with 4,096 attributes
/// with the same key: the second mebibyte of a zeroed memory.
fn four_gibibytes(first: &str) -> String {
    let parts = r#"
        (import "gleaner:lambda/trigger@0.1.0" (instance $trigger
            (type $a-value (variant (case "boolean" bool) (case "signed" s64) (case "real" f64) (case "text" string)))
            (export "attribute-value" (type $value (eq $a-value)))
            (type $an-attribute (record (field "key" string) (field "value" $value)))
            (export "attribute" (type $attribute (eq $an-attribute)))
            (type $an-error (variant (case "invalid" string) (case "too-many" string)))
            (export "trigger-error" (type $error (eq $an-error)))
            (export "event" (func (param "label" string) (param "score" f64) (param "attributes" (list $attribute))
                (result (result (error $error)))))))
        (core module $heap
            (memory (export "memory") 32)
            (func (export "realloc") (param i32 i32 i32 i32) (result i32) (i32.const 1024)))
        (core instance $heap (instantiate $heap))
        (alias core export $heap "memory" (core memory $heap-memory))
        (alias core export $heap "realloc" (core func $heap-realloc))
        (core func $event (canon lower (func $trigger "event") (memory $heap-memory) (realloc $heap-realloc)))
        (core instance $host (export "event" (func $event)))"#;
    let body = format!(
        r#"(import "heap" "memory" (memory $heap 32))
        (import "host" "event" (func $event (param i32 i32 f64 i32 i32 i32)))
        (func $wake (local $at i32)
            {first}
            (local.set $at (i32.const 4096))
            (loop $next
                (i32.store $heap (local.get $at) (i32.const 0x100000))
                (i32.store $heap offset=4 (local.get $at) (i32.const 0x100000))
                (local.set $at (i32.add (local.get $at) (i32.const 24)))
                (br_if $next (i32.lt_u (local.get $at) (i32.const 102400))))
            (call $event (i32.const 0) (i32.const 1) (f64.const 0) (i32.const 4096) (i32.const 4096) (i32.const 16)))"#
    );
    component(parts, r#"(with "heap" (instance $heap)) (with "host" (instance $host))"#, &body)
}

#[test]
fn one_mebibyte_named_four_thousand_times_never_becomes_four_gibibytes() {
    let mut test = TestGuest::written(&four_gibibytes(""));
    test.guest.init().unwrap();
    // Peak of the whole process; other tests run in it too, and none uses a gigabyte.
    let before = usage::peak_resident();
    let fault = test.fault();
    assert_eq!(fault.kind, FaultKind::HostCall);
    assert!(fault.message.contains("too much data"), "{}", fault.message);
    assert!(before > 0 && usage::peak_resident() - before < 1 << 30);
    assert_eq!(test.fault(), fault);
}

#[test]
fn a_survived_refusal_of_memory_is_not_the_cause_of_a_later_refusal() {
    let refused = format!("(memory.grow $heap (i32.const 1000)) {MUST_NOT}");
    let fault = TestGuest::written(&four_gibibytes(&refused)).fault();
    assert_eq!(fault.kind, FaultKind::HostCall, "{}", fault.message);
}

/// An input without a guest, with `messages` copies of a message in its ring. The type is given by
/// name and definition.
fn topic(
    definition: (&str, &str),
    depth: usize,
    max_size: &str,
    messages: u64,
    cdr: &[u8],
) -> Arc<Topic> {
    topic_of(definition, depth, max_size, (0..messages).map(|_| cdr))
}

/// As [`topic`], with these messages.
fn topic_of<'a>(
    (name, text): (&str, &str),
    depth: usize,
    max_size: &str,
    samples: impl Iterator<Item = &'a [u8]>,
) -> Arc<Topic> {
    let manifest = format!(
        "[lambda]\nname = \"many\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"many.wasm\"\n\
         [schedule]\nevent = \"many\"\nbacklog = \"each\"\n\
         [[input]]\nname = \"many\"\ntopic = \"/many\"\ntype = \"{name}\"\ndepth = {depth}\nmax_size = \"{max_size}\"\n"
    );
    let manifest = Manifest::parse(&manifest, "lambda.toml").unwrap();
    let (mut transport, topic) = subscribed(&manifest, text);
    (1..).zip(samples).for_each(|(seq, cdr)| publish(&mut transport, "/many", seq, cdr));
    topic
}

/// A type with one field, `x`.
fn only(definition: &str) -> (&str, &str) {
    ("test_msgs/msg/Only", definition)
}

#[test]
fn one_call_hands_out_the_newest_256_samples() {
    let topic = topic(only("uint8 x\n"), 300, "16 B", 300, &[7]);
    let newest: Vec<_> = (300 - SAMPLES_PER_CALL as u64 + 1..=300).collect();
    for samples in [topic.last(usize::MAX).unwrap(), topic.since(0).unwrap()] {
        assert_eq!(samples.iter().map(|sample| sample.identity().seq).collect::<Vec<_>>(), newest);
    }
}

#[test]
fn a_column_has_the_newest_65_536_values() {
    let sent = COLUMN_LEN as u64 + 100;
    let topic = topic(only("uint8 x\n"), COLUMN_LEN, "16 B", sent, &[7]);
    let field = topic.field("x").unwrap();
    for column in
        [topic.column(&field, usize::MAX).unwrap(), topic.column_since(&field, 0).unwrap()]
    {
        assert_eq!((column.values.len(), column.at_ns.len()), (COLUMN_LEN, COLUMN_LEN));
        assert_eq!((column.at_ns[0], column.at_ns[COLUMN_LEN - 1]), (101, sent as i64));
    }
}

#[test]
fn the_error_of_a_column_is_that_of_its_oldest_unreadable_sample() {
    let samples: [&[u8]; 4] = [&[1, 0, 0, 0], &[1, 0], &[1, 0, 0], &[2, 0, 0, 0]];
    let topic = topic_of(only("uint32 x\n"), 4, "16 B", samples.into_iter());
    let field = topic.field("x").unwrap();
    let errors: Vec<_> = topic.last(4).unwrap().iter().map(|it| it.number(&field).err()).collect();
    let [None, Some(older), Some(newer), None] = &errors[..] else { panic!("{errors:?}") };
    assert_ne!(older.to_string(), newer.to_string());
    for column in [topic.column(&field, 4), topic.column_since(&field, 0)] {
        assert_eq!(column.unwrap_err().to_string(), older.to_string());
    }
    assert_eq!(topic.column(&field, 2).unwrap_err().to_string(), newer.to_string());
    assert_eq!(topic.column(&field, 1).unwrap().values, [2.0]);
}

#[test]
fn a_call_that_would_hand_out_more_than_one_mebibyte_of_a_message_is_refused() {
    let bytes = vec![7; BYTES_PER_CALL + 1];
    let topic =
        topic(only("uint8[] x\n"), 1, "2 MiB", 1, &CdrBuilder::default().bytes(&bytes).done());
    let sample = topic.newest().unwrap().unwrap();
    let size = sample.bytes().len() as u64;
    let most = BYTES_PER_CALL as u32;
    assert_eq!(sample.cdr(1, most).unwrap().len(), BYTES_PER_CALL);
    for len in [most + 1, u32::MAX] {
        let Err(error) = sample.cdr(0, len) else { panic!("{len} bytes are returned") };
        assert!(error.to_string().contains("of a sample of `/many` are requested"), "{error}");
        assert!(error.to_string().contains("at most 1048576: read it in pieces"), "{error}");
    }
    for (offset, left) in [(size - 3, 3), (size, 0), (size + 1, 0), (u64::MAX, 0)] {
        assert_eq!(sample.cdr(offset, u32::MAX).unwrap().len(), left);
    }
    refused(
        &sample.get(&topic.field("x").unwrap()),
        "has 1048577 items; one call returns at most 1048576",
    );
}

#[test]
fn a_call_that_would_hand_out_more_than_one_mebibyte_of_a_frame_is_refused() {
    let cdr = image(700, 600, "rgb8", 2100, &vec![9; 1_260_000]);
    let frame = topic(("sensor_msgs/msg/Image", IMAGE), 1, "2 MiB", 1, &cdr)
        .newest()
        .unwrap()
        .unwrap()
        .as_frame()
        .unwrap();
    let size = 1_260_000;
    assert_eq!(frame.read(7, BYTES_PER_CALL as u32).unwrap().len(), BYTES_PER_CALL);
    let Err(error) = frame.read(0, u32::MAX) else { panic!("a part is returned") };
    assert!(error.to_string().starts_with("1260000 bytes of a frame of `/many`"), "{error}");
    for (offset, left) in [(size - 3, 3), (size, 0), (u64::MAX, 0)] {
        assert_eq!(frame.read(offset, u32::MAX).unwrap().len(), left);
    }
}

#[test]
fn depth_keeps_its_16_bits_from_the_message_to_the_frame() {
    // PNG of 16-bit grey, 4x2 pixels, by Pillow.
    let file = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x04\0\0\0\x02\x10\0\0\0\0\nS\xfe\xfc\0\0\0\
        \x1aIDATx\xdac````d\xf8\xcf\xc8\xc0\xc0\xfc\x82\x93e\x8e\xc3\xff\xff\0\x19\x06\x04\xd4\x0c\
        \xa7\xf5\xe7\0\0\0\0IEND\xaeB`\x82";
    let values: Vec<u8> =
        [0, 1, 255, 256, 1_000, 2_308, 40_000, 65_535_u16].map(u16::to_le_bytes).concat();
    let frame = |format: &str, data: &[u8]| {
        let cdr = CdrBuilder::header().text(format).bytes(data).done();
        let definition = ("sensor_msgs/msg/CompressedImage", COMPRESSED);
        topic(definition, 1, "1 MiB", 1, &cdr).newest().unwrap().unwrap().as_frame()
    };
    let after = [&[0; 12], &file[..]].concat();
    for (format, data) in [
        ("16UC1; png compressed ", &file[..]),
        ("16UC1; compressedDepth", &after),
        ("16UC1; compressedDepth png", &after),
    ] {
        let frame = frame(format, data).unwrap();
        assert_eq!(frame.info().encoding, gleaner_pixels::Encoding::Mono16, "{format}");
        assert_eq!(frame.bytes(), values, "{format}");
        let error = frame.resize(2, 1).err().unwrap().to_string();
        assert!(error.contains("resize of mono16 would keep 8 of its 16 bits"), "{error}");
        assert_eq!(frame.to_gray().unwrap().bytes(), [0, 0, 0, 1, 3, 9, 156, 255]);
    }
    for (format, why) in [
        ("32FC1; compressedDepth png", "32FC1 has 32 bits per value, and the PNG has 16"),
        ("compressedDepth", "name the encoding, as in `16UC1; compressedDepth png`"),
        ("png", "publish JPEG or PNG, depth as `16UC1; compressedDepth png`"),
    ] {
        let error = frame(format, &after).err().unwrap().to_string();
        assert!(error.contains(why), "{error}");
    }
}

#[test]
fn a_list_that_is_longer_than_one_call_hands_out_is_refused_and_not_cut() {
    let texts =
        |n: usize| (0..n).fold(CdrBuilder::default().u32(n as u32), |cdr, _| cdr.text("x")).done();
    let numbers = |n: usize| [&(n as u32).to_le_bytes(), vec![0_u8; 2 * n].as_slice()].concat();
    let get = |definition, cdr: &[u8]| {
        let topic = topic(only(definition), 1, "1 MiB", 1, cdr);
        let (field, sample) = (topic.field("x").unwrap(), topic.newest().unwrap().unwrap());
        sample.get(&field).map(drop)
    };
    get("string[] x\n", &texts(TEXTS_PER_FIELD)).unwrap();
    refused(
        &get("string[] x\n", &texts(TEXTS_PER_FIELD + 1)),
        "has 4097 items; one call returns at most 4096",
    );
    get("uint16[] x\n", &numbers(COLUMN_LEN)).unwrap();
    refused(
        &get("uint16[] x\n", &numbers(COLUMN_LEN + 1)),
        "has 65537 items; one call returns at most 65536",
    );
}

#[test]
fn a_path_is_not_read_if_it_is_too_long() {
    let topic = topic(only("uint8 x\n"), 1, "16 B", 0, &[]);
    let path = "x".repeat(PATH_BYTES + 1);
    refused(&topic.field(&path), "has 1025 bytes; a path has at most 1024");
    assert!(matches!(topic.field(&path[1..]), Err(DataError::NoSuchField(_))));
}

fn refused<T>(answer: &Result<T, DataError>, why: &str) {
    match answer {
        Err(error @ DataError::WrongField { .. }) => {
            assert!(error.to_string().contains(why), "{error}")
        }
        Err(error) => panic!("{error}"),
        Ok(_) => panic!("an answer"),
    }
}
