//! Every limit of `[limits]`, lowered and then hit: the fault names the cause, the use and the
//! limit.

use std::sync::Arc;
use std::time::Duration;

use crate::greedy::{TestGuest, component, limits, publish, subscribed};
use gleaner_base::ByteSize;
use gleaner_host::api::data::{DataError, Topic};
use gleaner_host::guest::Guest;
use gleaner_lambda::manifest::{Limits, Manifest};
use gleaner_lambda::{Fault, FaultKind};
use gleaner_tests::drive::CdrBuilder;

/// The default limits of the suite, with a change.
fn with(change: impl FnOnce(&mut Limits)) -> Limits {
    let mut limits = limits();
    change(&mut limits);
    limits
}

#[track_caller]
fn is(fault: &Fault, kind: FaultKind, used: Option<u64>, allowed: u64) {
    assert_eq!(
        (fault.kind, fault.used, fault.allowed),
        (kind, used, Some(allowed)),
        "{}",
        fault.message
    );
}

#[test]
fn fuel_of_a_wake_and_of_init_are_two_limits() {
    let limits = with(|limits| (limits.fuel, limits.init_fuel) = (300_000, 200_000));
    is(&TestGuest::within("endless", 0, &limits).fault(), FaultKind::Fuel, Some(300_000), 300_000);
    let fault = TestGuest::within("endless_init", 0, &limits).guest.init().unwrap_err();
    is(&fault, FaultKind::Fuel, Some(200_000), 200_000);
}

#[test]
fn the_deadline_of_a_wake_and_of_init_are_two_limits() {
    let ms = Duration::from_millis;
    for [wake, init] in [[20, 10_000], [10_000, 20]] {
        let limits = with(|limits| {
            (limits.fuel, limits.init_fuel) = (Limits::MAX.fuel, Limits::MAX.fuel);
            (limits.deadline, limits.init_deadline) = (ms(wake), ms(init));
        });
        let behaviour = if wake < init { "endless" } else { "endless_init" };
        let mut test = TestGuest::timed(behaviour, 0, &limits);
        let fault = if wake < init { test.fault() } else { test.guest.init().unwrap_err() };
        assert_eq!(
            (fault.kind, fault.allowed),
            (FaultKind::Deadline, Some(20_000_000)),
            "{fault:?}"
        );
        assert!(fault.used >= fault.allowed && fault.used < Some(10_000_000_000), "{fault:?}");
    }
}

#[test]
fn a_call_that_does_not_end_in_time_ends_between_two_rows() {
    // 800 MB of pixels, for which no machine takes less than 150 ms; a check before the work would
    // let it begin.
    let limits = with(|limits| {
        (limits.fuel, limits.memory) = (Limits::MAX.fuel, ByteSize::mib(1024));
        limits.deadline = Duration::from_millis(150);
    });
    TestGuest::timed("mean_luma", 0, &limits).wake().result.unwrap();
    let fault = TestGuest::timed("huge", 0, &limits).fault();
    assert_eq!((fault.kind, fault.allowed), (FaultKind::Deadline, Some(150_000_000)), "{fault:?}");
    // It ended within the call, and was not only found late after it.
    assert!(fault.message.contains("a call into the host"), "{}", fault.message);
}

#[test]
fn memory_beyond_the_limit_is_a_fault_with_both_numbers() {
    let fault =
        TestGuest::within("memory", 0, &with(|limits| limits.memory = ByteSize::mib(4))).fault();
    assert_eq!((fault.kind, fault.allowed), (FaultKind::Memory, Some(4 << 20)), "{fault:?}");
    assert!(fault.used > fault.allowed, "{fault:?}");
}

#[test]
fn elements_of_tables_beyond_the_limit_are_a_fault_with_both_numbers() {
    let body = |elements: u32| {
        let grow = "(table.grow $t (ref.null func) (i32.const 100))";
        let wake = format!("(if (i32.eq (i32.const -1) {grow}) (then (unreachable)))");
        component("", "", &format!("(table $t {elements} funcref) (func $wake {wake})"))
    };
    let limits = with(|limits| limits.tables = 200);
    TestGuest::written_within(&body(100), &limits).wake().result.unwrap();
    is(&TestGuest::written_within(&body(101), &limits).fault(), FaultKind::Memory, Some(201), 200);
    let fault = TestGuest::written_within(&body(201), &limits).guest.init().unwrap_err();
    is(&fault, FaultKind::Memory, Some(201), 200);
    assert_eq!(fault.message, "in init: asked for 201; `tables` in [limits] allows 200");
}

#[test]
fn a_smaller_stack_is_full_earlier() {
    // Each call takes some stack and a little fuel, and nothing else.
    let endless = component("", "", "(func $wake (call $wake) (call $wake))");
    let deep = |stack: ByteSize| {
        let fuel_lasts = |fuel: &u64| {
            let outcome = TestGuest::written_within(
                &endless,
                &with(|limits| (limits.stack, limits.fuel) = (stack, *fuel)),
            )
            .wake();
            let fault = outcome.result.unwrap_err();
            if fault.kind == FaultKind::Stack {
                is(&fault, FaultKind::Stack, None, stack.bytes());
                // The fuel differs between processors, whose code needs different amounts of stack.
                assert_eq!(outcome.fuel, None);
            }
            fault.kind == FaultKind::Stack
        };
        (0..24)
            .map(|power| 64 << power)
            .find(fuel_lasts)
            .expect("some fuel lasts until the stack is full")
    };
    let (least, most) = (deep(Limits::MIN.stack), deep(Limits::MAX.stack));
    assert!((16..=64).contains(&(most / least)), "{least} and {most}");
}

#[test]
fn an_access_outside_of_memory_names_the_stack_as_a_possible_cause() {
    // Like a compiler's stack, which is at the low end of memory, when a recursion goes below it.
    let fault =
        TestGuest::written(&component("", "", "(func $wake (drop (i32.load (i32.const -8))))"))
            .fault();
    assert_eq!(fault.kind, FaultKind::Trap, "{}", fault.message);
    assert!(
        fault.message.contains(
            "out of bounds memory access; perhaps its stack is full: a deep recursion, or "
        ),
        "{}",
        fault.message
    );
}

#[test]
fn a_fault_for_too_many_handles_names_the_limit() {
    let limits = with(|limits| limits.handles = 64);
    is(&TestGuest::within("fields", 0, &limits).fault(), FaultKind::HostCall, Some(65), 64);
}

#[test]
fn a_lambda_that_keeps_frames_is_refused_the_next_one() {
    let limits = with(|limits| limits.frames = 3);
    for behaviour in ["frames", "resized"] {
        let mut test = TestGuest::within(behaviour, 0, &limits);
        for _ in 0..3 {
            // They were released with the lambda that held them: the next one reaches the same
            // number.
            let fault = test.fault();
            assert_eq!(fault.kind, FaultKind::Exception);
            let expected = "the lambda holds 3 frames and tensors; drop frames and tensors that are \
                            not needed, or raise `frames` in [limits]";
            assert!(fault.message.contains(expected), "{behaviour}: {}", fault.message);
        }
    }
}

#[test]
fn the_arguments_of_one_call_are_limited() {
    let limits = with(|limits| limits.call_bytes = ByteSize::kib(64));
    let fault = TestGuest::within("long_label", 60_000, &limits).fault();
    assert!(fault.message.contains("the label has 60000 bytes"), "{}", fault.message);
    is(
        &TestGuest::within("long_label", 70_000, &limits).fault(),
        FaultKind::HostCall,
        None,
        64 << 10,
    );
}

/// An input with `messages` copies of a message in its ring, for a lambda with these limits.
fn topic(definition: &str, limits: &str, messages: u64, cdr: &[u8]) -> Arc<Topic> {
    let manifest = format!(
        "[lambda]\nname = \"many\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"many.wasm\"\n\
         [schedule]\nevent = \"many\"\nbacklog = \"each\"\n\
         [[input]]\nname = \"many\"\ntopic = \"/many\"\ntype = \"test_msgs/msg/Only\"\ndepth = 100\nmax_size = \"1 MiB\"\n\
         [limits]\n{limits}"
    );
    let (mut transport, topic) =
        subscribed(&Manifest::parse(&manifest, "lambda.toml").unwrap(), definition);
    (1..=messages).for_each(|seq| publish(&mut transport, "/many", seq, cdr));
    topic
}

#[test]
fn the_bytes_that_one_call_returns_are_limited() {
    let bytes = vec![7; 100_000];
    let topic = topic(
        "uint8[] x\n",
        "call_bytes = \"64 KiB\"",
        1,
        &CdrBuilder::default().bytes(&bytes).done(),
    );
    let sample = topic.newest().unwrap().unwrap();
    assert_eq!(sample.cdr(9, 64 << 10).unwrap().len(), 64 << 10);
    let Err(error) = sample.cdr(0, u32::MAX) else { panic!("a part is returned") };
    assert!(error.to_string().contains("one call returns at most 65536: read it"), "{error}");
    let error = sample.get(&topic.field("x").unwrap()).map(drop).unwrap_err();
    assert!(
        error.to_string().contains("has 100000 items; one call returns at most 65536"),
        "{error}"
    );
}

#[test]
fn the_items_that_one_call_returns_are_limited() {
    let few = "call_items = 20";
    let one = topic("uint8 x\n", few, 100, &[7]);
    let field = one.field("x").unwrap();
    let lists = [one.last(usize::MAX).unwrap().len(), one.since(0).unwrap().len()];
    let columns = [one.column(&field, usize::MAX).unwrap(), one.column_since(&field, 0).unwrap()];
    assert_eq!((lists, columns.map(|column| column.values.len())), ([20; 2], [20; 2]));
    let texts =
        |n: usize| (0..n).fold(CdrBuilder::default().u32(n as u32), |cdr, _| cdr.text("x")).done();
    let numbers = |n: usize| [&(n as u32).to_le_bytes(), vec![0_u8; 2 * n].as_slice()].concat();
    let get = |definition, cdr: &[u8]| {
        let topic = topic(definition, few, 1, cdr);
        topic.newest().unwrap().unwrap().get(&topic.field("x").unwrap()).map(drop)
    };
    get("string[] x\n", &texts(20)).unwrap();
    get("uint16[] x\n", &numbers(20)).unwrap();
    for error in [get("string[] x\n", &texts(21)), get("uint16[] x\n", &numbers(21))] {
        assert!(
            matches!(&error, Err(DataError::WrongField(refusal)) if refusal.to_string().contains("returns at most 20")),
            "{error:?}"
        );
    }
}

#[test]
fn log_lines_and_their_bytes_are_two_limits() {
    let logged = |length: u32, change: fn(&mut Limits)| {
        let mut test = TestGuest::within("log", length, &with(change));
        test.wake().result.unwrap();
        (test.session.take_log().0.len(), test.session.log_dropped())
    };
    assert_eq!(logged(1, |limits| limits.log_lines = 30), (30, 970));
    assert_eq!(logged(1000, |limits| limits.log_bytes = ByteSize::kib(8)), (8, 992));
}

#[test]
fn triggers_beyond_the_limit_per_minute_are_refused_and_counted() {
    let mut test = TestGuest::within("events", 3, &with(|limits| limits.events_per_minute = 5));
    test.wake().result.unwrap();
    assert_eq!(test.session.end().len(), 3);
    let fault = test.fault();
    assert!(
        fault.message.contains("the lambda has caused 5 triggers in this minute already"),
        "{}",
        fault.message
    );
    // Earlier ones count, and in the next minute triggers are accepted again.
    assert_eq!((test.session.end().len(), test.session.triggers_refused()), (2, 1));
    test.wake_at(60_000_000_000).result.unwrap();
    assert_eq!((test.session.end().len(), test.session.triggers_refused()), (3, 1));
}
