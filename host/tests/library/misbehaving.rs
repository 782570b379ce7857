//! The WebAssembly guest with the lambda `misbehave`: every limit is hit, every cause is named, and
//! a fresh guest follows.

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::ByteSize;
use gleaner_compile::Nans;
use gleaner_host::api::Session;
use gleaner_host::api::data::{Topic, Wake};
use gleaner_host::guest::wasm::{Deadline, Loaded, WasmGuest};
use gleaner_host::guest::{Guest, WakeOutcome};
use gleaner_host::input::open_inputs;
use gleaner_lambda::FaultKind;
use gleaner_lambda::manifest::{ConfigValue, Limits, Manifest};
use gleaner_messages::transport::loopback::Loopback;
use gleaner_tests::{root, with_header};

use crate::meta;

const FUEL: u64 = 5_000_000;
const MEMORY: u64 = 16 << 20;
const IMU: &str = with_header!("std_msgs/Header header\nfloat64 x\n");

/// A misbehaving lambda and the transport that feeds it.
struct MisbehavingGuest {
    guest: WasmGuest,
    session: Session,
    transport: Loopback,
    topic: Arc<Topic>,
    sent: u64,
}

impl MisbehavingGuest {
    fn new(behaviour: &str, fuel: u64, deadline: Option<Duration>) -> Self {
        let lambda = root().join("tests/lambdas/misbehave/rust/build");
        let manifest = Manifest::load(&lambda).expect("misbehave is built; run: cargo xtask test");
        let mut transport = Loopback::new();
        transport.add_topic("/imu/data", "sensor_msgs/msg/Imu", IMU);
        let inputs = open_inputs(&manifest, &[], &mut transport).unwrap();
        let topic = Arc::clone(&inputs[0]);
        let config = vec![("behaviour".to_owned(), ConfigValue::Text(behaviour.to_owned()))];
        let mut limits = Limits::default();
        (limits.fuel, limits.memory) = (fuel, ByteSize::new(MEMORY));
        limits.deadline = deadline.unwrap_or(limits.deadline);
        let session = Session::new(inputs, config, &limits);
        let cache = root().join("target/test-cache/gleaner");
        let loaded = Loaded::open(
            &lambda.join("misbehave.wasm"),
            &cache,
            limits.stack.as_usize(),
            Nans::Native,
        )
        .unwrap();
        let deadline = deadline.map(|allowed| Deadline::new(loaded.engine(), allowed).unwrap());
        let guest = WasmGuest::new(loaded, session.clone(), &limits, deadline).unwrap();
        Self { guest, session, transport, topic, sent: 0 }
    }

    fn of(behaviour: &str) -> Self {
        let mut test = Self::new(behaviour, FUEL, None);
        test.guest.init().unwrap();
        test
    }

    fn wake(&mut self) -> WakeOutcome {
        self.sent += 1;
        let at_ns = self.sent as i64 * 1_000_000;
        self.transport.publish("/imu/data", &meta(at_ns, self.sent), &[0; 24]).unwrap();
        self.session.begin(at_ns);
        let sample = self.topic.newest().unwrap().unwrap();
        self.guest.wake(Wake::Event(sample))
    }

    /// Runs a wake; returns kind and message of its fault.
    fn fault(&mut self) -> (FaultKind, String) {
        let fault = self.wake().result.expect_err("a fault");
        (fault.kind, fault.message)
    }
}

#[test]
fn a_good_wake_uses_some_fuel_and_causes_nothing() {
    let mut test = MisbehavingGuest::of("ok");
    let outcome = test.wake();
    assert!(outcome.result.is_ok());
    assert!((1..100_000).contains(&outcome.fuel.unwrap()), "{:?}", outcome.fuel);
    assert!(test.session.end().is_empty());
}

#[test]
fn an_endless_loop_ends_with_its_fuel() {
    let outcome = MisbehavingGuest::of("endless").wake();
    let fault = outcome.result.unwrap_err();
    assert_eq!((fault.kind, fault.allowed), (FaultKind::Fuel, Some(FUEL)));
    let fuel = gleaner_base::grouped(FUEL);
    assert!(fault.message.ends_with(&format!("allows {fuel}: do less, or raise it")), "{fault:?}");
}

#[test]
fn an_endless_loop_of_host_calls_ends_as_well() {
    let (kind, _) = MisbehavingGuest::of("host_calls").fault();
    assert_eq!(kind, FaultKind::Fuel);
}

#[test]
fn the_same_wake_uses_the_same_fuel_also_after_a_trap() {
    let used = |test: &mut MisbehavingGuest| test.wake().fuel.unwrap();
    let mut test = MisbehavingGuest::of("ok");
    let (first, second) = (used(&mut test), used(&mut test));
    let mut again = MisbehavingGuest::of("ok");
    assert_eq!((used(&mut again), used(&mut again)), (first, second));
    let mut faulty = MisbehavingGuest::of("error");
    let faults =
        [faulty.wake(), faulty.wake()].map(|outcome| (outcome.result.is_err(), outcome.fuel));
    assert_eq!(faults[0], faults[1]);
}

#[test]
fn a_deadline_ends_what_fuel_would_allow() {
    let deadline = Duration::from_millis(20);
    let mut test = MisbehavingGuest::new("endless", 1_000_000_000_000, Some(deadline));
    test.guest.init().unwrap();
    let fault = test.wake().result.unwrap_err();
    assert_eq!((fault.kind, fault.allowed), (FaultKind::Deadline, Some(20_000_000)));
    assert!(fault.used.unwrap() >= 20_000_000, "{fault:?}");
    assert!(fault.message.contains("the deadline is 20.0 ms"), "{}", fault.message);
    // The next guest has a deadline of its own.
    assert_eq!(test.wake().result.unwrap_err().kind, FaultKind::Deadline);
}

#[test]
fn memory_beyond_the_cap_is_named_with_both_numbers() {
    let fault = MisbehavingGuest::of("memory").wake().result.unwrap_err();
    assert_eq!((fault.kind, fault.allowed), (FaultKind::Memory, Some(MEMORY)));
    assert!(fault.used.unwrap() > MEMORY, "{fault:?}");
}

#[test]
fn a_panic_says_what_and_where() {
    let (kind, message) = MisbehavingGuest::of("panic").fault();
    assert_eq!(kind, FaultKind::Trap);
    assert!(
        message.starts_with("panicked at ") && message.ends_with(": wake 1 is one too many"),
        "{message}"
    );
    assert!(!message.contains('\n'), "{message}");
}

#[test]
fn deep_recursion_ends_as_a_fault() {
    let (kind, message) = MisbehavingGuest::of("recurse").fault();
    assert_eq!((kind, message.as_str()), (FaultKind::Stack, "the call stack is full"));
}

#[test]
fn exit_and_sleep_are_faults_with_their_names() {
    assert_eq!(
        MisbehavingGuest::of("exit").fault(),
        (FaultKind::Trap, "the lambda called exit".to_owned())
    );
    let asleep = "a lambda cannot sleep: it is woken by samples or by a period".to_owned();
    assert_eq!(MisbehavingGuest::of("sleep").fault(), (FaultKind::HostCall, asleep));
}

#[test]
fn files_and_sockets_do_not_exist() {
    for behaviour in ["read_file", "connect"] {
        let (kind, message) = MisbehavingGuest::of(behaviour).fault();
        assert_eq!(kind, FaultKind::Exception, "{behaviour}: {message}");
    }
}

#[test]
fn refusals_of_the_host_reach_the_lambda_as_errors() {
    for (behaviour, expected) in [
        ("error", "I do not want to"),
        ("huge_label", "the label has 1000 bytes; at most 128 are allowed"),
        ("nan_score", "the score of `x` is NaN; it must be finite"),
        ("too_many_triggers", "this wake has caused 16 triggers already; further ones are refused"),
        (
            "not_a_frame",
            "a sample of `/imu/data` is not an image: its type is `sensor_msgs/msg/Imu`",
        ),
    ] {
        let (kind, message) = MisbehavingGuest::of(behaviour).fault();
        assert_eq!(kind, FaultKind::Exception);
        assert!(message.contains(expected), "{behaviour}: {message}");
    }
}

#[test]
fn a_refusal_in_init_ends_the_start() {
    for (behaviour, expected) in [
        ("error_in_init", "in init: no, not today"),
        ("bad_input", "no input `imo`; the manifest has `imu`"),
        ("bad_field", "linear_acceleration"),
        ("event_in_init", "triggers belong to a wake"),
    ] {
        let fault = MisbehavingGuest::new(behaviour, FUEL, None).guest.init().unwrap_err();
        assert_eq!(fault.kind, FaultKind::Exception);
        assert!(fault.message.contains(expected), "{behaviour}: {}", fault.message);
    }
    let fault = MisbehavingGuest::new("panic_in_init", FUEL, None).guest.init().unwrap_err();
    assert_eq!(fault.kind, FaultKind::Trap);
    let message = &fault.message;
    assert!(message.starts_with("in init: ") && message.contains("no, not today"), "{message}");
}

#[test]
fn a_trigger_before_a_panic_still_counts() {
    let mut test = MisbehavingGuest::of("event_then_panic");
    assert_eq!(test.fault().0, FaultKind::Trap);
    assert_eq!(test.session.end()[0].label, "seen");
}

#[test]
fn a_fresh_guest_follows_each_fault_and_nothing_stays_held() {
    let mut test = MisbehavingGuest::of("panic");
    for _ in 0..1000 {
        // The count restarts with each guest.
        assert!(test.fault().1.contains("wake 1 is one too many"));
    }
    assert_eq!(test.topic.counts().no_slot, 0);
}

#[test]
fn a_guest_that_keeps_every_sample_makes_the_ring_refuse_and_count() {
    let mut test = MisbehavingGuest::of("hold");
    // depth 16 and hold 8, and one slot to write into: the 26th sample is refused.
    for _ in 0..40 {
        assert!(test.wake().result.is_ok());
    }
    let counts = test.topic.counts();
    assert_eq!((counts.received, counts.no_slot), (25, 15));
}

#[test]
fn what_a_lambda_prints_becomes_log_lines_and_a_flood_is_counted() {
    let mut test = MisbehavingGuest::of("print");
    assert!(test.wake().result.is_ok());
    assert_eq!(test.session.take_log().0[0].message, "hello from 1");
    let mut test = MisbehavingGuest::of("print_in_pieces");
    assert!(test.wake().result.is_ok());
    let lines = test.session.take_log().0.into_iter().map(|line| line.message).collect::<Vec<_>>();
    assert_eq!(lines, ["wake 1 of print_in_pieces"]);
    let mut test = MisbehavingGuest::of("log_flood");
    assert!(test.wake().result.is_ok());
    assert_eq!((test.session.take_log().0.len(), test.session.log_dropped()), (100, 900));
}
