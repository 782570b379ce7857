//! Guests under test: the lambda `greedy` or a hand-written component, with the transport that
//! feeds them.

use std::path::Path;
use std::sync::Arc;

use gleaner_base::ByteSize;
use gleaner_compile::Nans;
use gleaner_host::api::Session;
use gleaner_host::api::data::{Topic, Wake};
use gleaner_host::guest::wasm::{Deadline, Loaded, WasmGuest};
use gleaner_host::guest::{Guest, WakeOutcome};
use gleaner_host::input::open_inputs;
use gleaner_lambda::Fault;
use gleaner_lambda::manifest::{ConfigValue, Limits, Manifest};
use gleaner_messages::transport::loopback::Loopback;

use gleaner_tests::drive::{IMAGE, image};
use gleaner_tests::{TempFolder, root};

use crate::meta;

/// Fuel of a wake.
pub const FUEL: u64 = 5_000_000;
/// Memory, in bytes.
pub const MEMORY: u64 = 16 << 20;
/// Bytes of the pixels of each picture that wakes a guest: 400 by 250, rgb8.
pub const PICTURE: u32 = 300_000;

const CAMERA: &str = "/camera/front/image_raw";

/// Default limits of the guests.
pub fn limits() -> Limits {
    let mut limits = Limits::default();
    (limits.fuel, limits.init_fuel, limits.memory) = (FUEL, 20 * FUEL, ByteSize::new(MEMORY));
    limits
}

/// A guest, and the transport that feeds it.
pub struct TestGuest {
    /// The guest.
    pub guest: WasmGuest,
    /// Its session.
    pub session: Session,
    /// Its one input, a camera.
    pub topic: Arc<Topic>,
    transport: Loopback,
    picture: Vec<u8>,
    sent: u64,
}

impl TestGuest {
    /// The lambda `greedy`, with its configuration.
    pub fn greedy(behaviour: &str, bytes: u32) -> Self {
        Self::within(behaviour, bytes, &limits())
    }

    /// As [`TestGuest::greedy`], within `limits`.
    ///
    /// # Panics
    ///
    /// If `greedy` is not built.
    pub fn within(behaviour: &str, bytes: u32, limits: &Limits) -> Self {
        Self::new(&greedy(), config(behaviour, bytes), limits, false)
    }

    /// As [`TestGuest::within`], with the deadlines, which replays do not have.
    pub fn timed(behaviour: &str, bytes: u32, limits: &Limits) -> Self {
        Self::new(&greedy(), config(behaviour, bytes), limits, true)
    }

    /// A hand-written component, for code that no compiler generates.
    pub fn written(text: &str) -> Self {
        Self::written_within(text, &limits())
    }

    /// As [`TestGuest::written`], within `limits`.
    ///
    /// # Panics
    ///
    /// If `text` is no component.
    pub fn written_within(text: &str, limits: &Limits) -> Self {
        Self::of_text(text, limits, false)
    }

    /// As [`TestGuest::written_within`], with the deadlines, which replays do not have.
    ///
    /// # Panics
    ///
    /// If `text` is no component.
    pub fn written_timed(text: &str, limits: &Limits) -> Self {
        Self::of_text(text, limits, true)
    }

    fn of_text(text: &str, limits: &Limits, timed: bool) -> Self {
        let folder = TempFolder::new();
        let component = wat::parse_str(text).unwrap_or_else(|error| panic!("{error}"));
        Self::new(&folder.write("written.wasm", component), Vec::new(), limits, timed)
    }

    fn new(
        component: &Path,
        config: Vec<(String, ConfigValue)>,
        limits: &Limits,
        timed: bool,
    ) -> Self {
        let mut manifest = Manifest::load(root().join("tests/lambdas/greedy/rust"))
            .expect("greedy has a manifest");
        manifest.limits = *limits;
        let (transport, topic) = subscribed(&manifest, IMAGE);
        let session = Session::new(vec![Arc::clone(&topic)], config, limits);
        let cache = root().join("target/test-cache/gleaner");
        let loaded = Loaded::open(component, &cache, limits.stack.as_usize(), Nans::Native)
            .expect("a component of this world");
        let shortest = limits.deadline.min(limits.init_deadline);
        let deadline = timed
            .then(|| Deadline::new(loaded.engine(), shortest).expect("a thread can be started"));
        let guest =
            WasmGuest::new(loaded, session.clone(), limits, deadline).expect("a guest can be made");
        let picture = image(400, 250, "rgb8", 1200, &[9; PICTURE as usize]);
        Self { guest, session, topic, transport, picture, sent: 0 }
    }

    /// Runs a wake.
    pub fn wake(&mut self) -> WakeOutcome {
        let at_ns = self.sent as i64 + 1;
        self.wake_at(at_ns)
    }

    /// Runs a wake at that time.
    ///
    /// # Panics
    ///
    /// If the ring has no room.
    pub fn wake_at(&mut self, at_ns: i64) -> WakeOutcome {
        self.sent += 1;
        publish(&mut self.transport, CAMERA, self.sent, &self.picture);
        self.session.begin(at_ns);
        self.guest.wake(Wake::Event(self.topic.newest().unwrap().expect("a picture")))
    }

    /// Runs a wake, and returns its fault.
    ///
    /// # Panics
    ///
    /// If there is none.
    pub fn fault(&mut self) -> Fault {
        self.wake().result.expect_err("a fault")
    }

    /// Runs two wakes, and returns the fuel of the second: in the first one the guest still grows.
    ///
    /// # Panics
    ///
    /// If there is a fault.
    pub fn fuel(&mut self) -> u64 {
        self.wake().result.expect("a good wake");
        let outcome = self.wake();
        outcome.result.expect("a good wake");
        outcome.fuel.expect("a component uses fuel")
    }
}

fn greedy() -> std::path::PathBuf {
    let component = root().join("tests/lambdas/greedy/rust/build/greedy.wasm");
    assert!(component.is_file(), "greedy is not built; run: cargo xtask test");
    component
}

fn config(behaviour: &str, bytes: u32) -> Vec<(String, ConfigValue)> {
    let behaviour = ("behaviour".to_owned(), ConfigValue::Text(behaviour.to_owned()));
    vec![behaviour, ("bytes".to_owned(), ConfigValue::Int(bytes.into()))]
}

/// Opens the one input of `manifest`, whose type has this definition; also returns the transport
/// that feeds it.
///
/// # Panics
///
/// If it has none.
pub fn subscribed(manifest: &Manifest, definition: &str) -> (Loopback, Arc<Topic>) {
    let (mut transport, input) = (Loopback::new(), &manifest.inputs[0]);
    transport.add_topic(input.topic.as_str(), input.type_name.as_str(), definition);
    let topic = open_inputs(manifest, &[], &mut transport).expect("an input").remove(0);
    (transport, topic)
}

/// Publishes a message; its time in ns equals its number.
///
/// # Panics
///
/// If there is no such topic.
pub fn publish(transport: &mut Loopback, topic: &str, seq: u64, cdr: &[u8]) {
    transport.publish(topic, &meta(seq as i64, seq), cdr).expect("a topic");
}

/// A hand-written component of this world. `parts` precede the module `lambda`, which has `body`
/// and is instantiated with `with`.
pub fn component(parts: &str, with: &str, body: &str) -> String {
    format!(
        r#"(component
            (import "gleaner:lambda/data@0.1.0" (instance $data
                (export "sample" (type $sample (sub resource)))
                (type $a-tick (record (field "at-ns" s64) (field "missed" u64)))
                (export "tick" (type $tick (eq $a-tick)))
                (type $a-wake (variant (case "event" (own $sample)) (case "tick" $tick)))
                (export "wake" (type (eq $a-wake)))))
            (alias export $data "wake" (type $wake))
            (type $a-value (variant (case "boolean" bool) (case "integer" s64) (case "real" f64) (case "text" string)))
            (import "config-value" (type $value (eq $a-value)))
            (type $an-entry (record (field "key" string) (field "value" $value)))
            (import "config-entry" (type $entry (eq $an-entry)))
            {parts}
            (core module $lambda
                {body}
                (memory (export "memory") 1)
                (func (export "realloc") (param i32 i32 i32 i32) (result i32) (i32.const 1024))
                ;; The result at 0 has no error, as long as nothing is written there.
                (func (export "init") (param i32 i32) (result i32) (i32.const 0))
                (func (export "on-wake") (param i32 i64 i64) (result i32) (call $wake) (i32.const 0)))
            (core instance $lambda (instantiate $lambda {with}))
            (alias core export $lambda "memory" (core memory $memory))
            (alias core export $lambda "realloc" (core func $realloc))
            (type $answer (result (error string)))
            (func (export "init") (param "config" (list $entry)) (result $answer)
                (canon lift (core func $lambda "init") (memory $memory) (realloc $realloc)))
            (func (export "on-wake") (param "wake" $wake) (result $answer)
                (canon lift (core func $lambda "on-wake") (memory $memory) (realloc $realloc))))"#
    )
}
