//! Runs the bench lambda in the host, with a frame in its ring.

use std::sync::Arc;

use gleaner_compile::Nans;
use gleaner_host::api::Session;
use gleaner_host::api::data::{Tick, Topic, Wake};
use gleaner_host::guest::Guest;
use gleaner_host::guest::wasm::{Loaded, WasmGuest};
use gleaner_host::input::open_inputs;
use gleaner_lambda::manifest::{ConfigValue, Limits, Manifest};
use gleaner_messages::Endian;
use gleaner_tests::drive::{IMAGE, image};
use gleaner_tests::root;
use gleaner_transport::loopback::Loopback;
use gleaner_transport::{Guid, SampleMeta};

/// Bytes of the frame's pixels.
pub const FRAME_BYTES: usize = 1920 * 1080 * 3;

const TOPIC: &str = "/camera/front/image_raw";

/// A guest that does one kind of work.
pub struct HostedKernel {
    guest: WasmGuest,
    session: Session,
    topic: Arc<Topic>,
    rounds: u64,
    // The ring receives samples as long as this lives.
    _transport: Loopback,
}

impl HostedKernel {
    /// The lambda after `init`, configured to do `work` `rounds` times in a wake by a frame.
    pub fn new(work: &str, rounds: u64) -> Self {
        let lambda = root().join("bench/lambdas/kernels/rust/build");
        let manifest =
            Manifest::load(&lambda).expect("the lambda is built; run: cargo xtask bench");
        let mut transport = Loopback::new();
        transport.add_topic(TOPIC, "sensor_msgs/msg/Image", IMAGE);
        let inputs = open_inputs(&manifest, &[], &mut transport).expect("memory for the frame");
        let topic = Arc::clone(&inputs[0]);
        let meta = SampleMeta {
            at_ns: 1,
            publish_ns: 1,
            writer: Guid::default(),
            seq: 1,
            endian: Endian::Little,
            options: [0; 2],
        };
        let frame = image(1920, 1080, "bgr8", 5760, &vec![99; FRAME_BYTES]);
        transport.publish(TOPIC, &meta, &frame).expect("the frame fits");
        let config = vec![
            ("work".to_owned(), ConfigValue::Text(work.to_owned())),
            ("rounds".to_owned(), ConfigValue::Int(rounds.cast_signed())),
        ];
        let mut limits = Limits::default();
        limits.fuel = u64::MAX / 1000;
        let session = Session::new(inputs, config, &limits);
        let cache = root().join("target/test-cache/gleaner");
        let loaded = Loaded::open(
            &lambda.join("bench_kernels.wasm"),
            &cache,
            limits.stack.as_usize(),
            Nans::Native,
        );
        let loaded = loaded.expect("a component");
        let mut guest = WasmGuest::new(loaded, session.clone(), &limits, None).expect("a guest");
        guest.init().expect("init");
        let mut hosted = Self { guest, session, topic, rounds, _transport: transport };
        // The first wake grows the guest's memory.
        hosted.frame();
        hosted
    }

    /// Repetitions of the work in [`frame`](Self::frame).
    pub fn rounds(&self) -> u64 {
        self.rounds
    }

    /// A wake by the frame.
    pub fn frame(&mut self) {
        let sample = self.topic.newest().unwrap().expect("the frame was published");
        self.wake(Wake::Event(sample));
    }

    /// A wake by a tick, which does nothing.
    pub fn tick(&mut self) {
        self.wake(Wake::Tick(Tick { at_ns: 1, missed: 0 }));
    }

    fn wake(&mut self, wake: Wake) {
        self.session.begin(1);
        let outcome = self.guest.wake(wake);
        assert!(outcome.result.is_ok(), "{:?}", outcome.result);
        self.session.end();
    }
}
