//! Runs the bench lambda in the host, with a frame and samples of an IMU in its rings.

use std::sync::Arc;

use gleaner_compile::Nans;
use gleaner_host::api::Session;
use gleaner_host::api::data::{Tick, Topic, Wake};
use gleaner_host::guest::Guest;
use gleaner_host::guest::wasm::{Loaded, WasmGuest};
use gleaner_host::input::open_inputs;
use gleaner_lambda::manifest::{ConfigValue, Limits, Manifest};
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{Guid, SampleMeta};
use gleaner_tests::drive::{IMAGE, TopicMessages};
use gleaner_tests::root;

use super::drives;

/// Number of samples of the IMU.
pub(super) const COLUMN: usize = 256;

const CAMERA: &str = "/camera/front/image_raw";

/// Rings that have received a frame and samples of an IMU.
pub(super) struct FilledInputs {
    pub(super) camera: Arc<Topic>,
    pub(super) imu: Arc<Topic>,
    pub(super) session: Session,
    limits: Limits,
    // The rings receive samples as long as this lives.
    _transport: Loopback,
}

/// A guest that does one kind of work.
pub(super) struct HostedKernel {
    guest: WasmGuest,
    inputs: FilledInputs,
}

impl FilledInputs {
    /// The rings of the bench lambda, and its session with this configuration.
    pub(super) fn new(config: Vec<(String, ConfigValue)>) -> Self {
        let lambda = root().join("bench/lambdas/kernels/rust/build");
        let manifest =
            Manifest::load(&lambda).expect("the lambda is built; run: cargo xtask bench");
        let mut transport = Loopback::new();
        let imu = TopicMessages::sample_imu();
        transport.add_topic(CAMERA, "sensor_msgs/msg/Image", IMAGE);
        transport.add_topic(&imu.topic, &imu.type_name, &imu.schema);
        let inputs = open_inputs(&manifest, &[], &mut transport).expect("memory for the frame");
        let [camera_ring, imu_ring] = [0, 1].map(|index| Arc::clone(&inputs[index]));
        let mut seq = 0_u64;
        let mut publish = |topic: &str, cdr: &[u8]| {
            seq += 1;
            let meta = SampleMeta::new(seq.cast_signed(), Guid::default(), seq);
            transport.publish(topic, &meta, cdr).expect("the sample fits");
        };
        imu.messages.iter().take(COLUMN).for_each(|(_, cdr)| publish(&imu.topic, cdr));
        publish(CAMERA, &drives::frame());
        let mut limits = Limits::default();
        limits.fuel = u64::MAX / 1000;
        let session = Session::new(inputs, config, &limits);
        Self { camera: camera_ring, imu: imu_ring, session, limits, _transport: transport }
    }
}

impl HostedKernel {
    /// The lambda after `init`, configured to do `work` `rounds` times in a wake by a frame.
    pub(super) fn new(work: &str, rounds: u64) -> Self {
        let inputs = FilledInputs::new(vec![
            ("work".to_owned(), ConfigValue::Text(work.to_owned())),
            ("rounds".to_owned(), ConfigValue::Int(rounds.cast_signed())),
        ]);
        let loaded = Loaded::open(
            &root().join("bench/lambdas/kernels/rust/build/bench_kernels.wasm"),
            &root().join("target/test-cache/gleaner"),
            inputs.limits.stack.as_usize(),
            Nans::Native,
        );
        let loaded = loaded.expect("a component");
        let guest = WasmGuest::new(loaded, inputs.session.clone(), &inputs.limits, None);
        let mut guest = guest.expect("a guest");
        guest.init().expect("init");
        let mut hosted = Self { guest, inputs };
        // The first wake grows the guest's memory.
        hosted.frame();
        hosted
    }

    /// A wake by the frame.
    pub(super) fn frame(&mut self) {
        let sample = self.inputs.camera.newest().unwrap().expect("the frame was published");
        self.wake(Wake::Event(sample));
    }

    /// A wake by a tick, which does nothing.
    pub(super) fn tick(&mut self) {
        self.wake(Wake::Tick(Tick { at_ns: 1, missed: 0 }));
    }

    fn wake(&mut self, wake: Wake) {
        self.inputs.session.begin(1);
        let outcome = self.guest.wake(wake);
        assert!(outcome.result.is_ok(), "{:?}", outcome.result);
        self.inputs.session.end();
    }
}
