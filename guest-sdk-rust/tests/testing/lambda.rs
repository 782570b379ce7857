//! A lambda whose `init` and handlers are closures of a test.

use std::cell::RefCell;

use gleaner_sdk::testing::{Host, Run};
use gleaner_sdk::{Config, Lambda, Result, Sample, Tick};

type OnEvent = Box<dyn FnMut(Sample) -> Result<()>>;
type OnTick = Box<dyn FnMut(Tick) -> Result<()>>;

/// Handler of a wake.
pub enum Handler {
    Event(OnEvent),
    Tick(OnTick),
}

type Make = Box<dyn FnMut(&Config) -> Result<Handler>>;

thread_local! {
    static MAKE: RefCell<Option<Make>> = const { RefCell::new(None) };
}

pub struct TestLambda(Handler);

impl Lambda for TestLambda {
    fn init(config: &Config) -> Result<Self> {
        MAKE.with_borrow_mut(|make| Ok(Self(make.as_mut().expect("`load` was used")(config)?)))
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let Handler::Event(handler) = &mut self.0 else { panic!("an event") };
        handler(sample)
    }

    fn on_tick(&mut self, tick: Tick) -> Result<()> {
        let Handler::Tick(handler) = &mut self.0 else { panic!("a tick") };
        handler(tick)
    }
}

/// Loads a lambda with `make` as its `init`.
pub fn load(
    host: Host,
    make: impl FnMut(&Config) -> Result<Handler> + 'static,
) -> std::result::Result<Run<TestLambda>, gleaner_sdk::testing::Error> {
    MAKE.set(Some(Box::new(make)));
    host.load()
}

/// Loads a lambda that calls `handler` in each wake; it has no state.
pub fn on_event(
    host: Host,
    handler: impl Fn(Sample) -> Result<()> + Copy + 'static,
) -> Run<TestLambda> {
    load(host, move |_| Ok(Handler::Event(Box::new(handler)))).unwrap()
}

/// Returns a manifest with a valid `[lambda]`, followed by `rest`.
pub fn manifest(rest: &str) -> String {
    let lambda = "[lambda]\nname = \"probe\"\nversion = \"0.1.0\"\nkind = \"wasm\"\n\
                  entry = \"probe.wasm\"\n";
    format!("{lambda}{rest}")
}

/// Returns a host whose lambda is woken by an IMU; `keys` are further keys of the input, `rest`
/// follows it.
pub fn imu(keys: &str, rest: &str) -> Host {
    let input =
        "[[input]]\nname = \"imu\"\ntopic = \"/imu/data\"\ntype = \"sensor_msgs/msg/Imu\"\n";
    Host::from_manifest(&manifest(&format!("[schedule]\nevent = \"imu\"\n{input}{keys}\n{rest}")))
}

/// Returns a host whose lambda is woken by a camera with raw images or, if `compressed`, compressed
/// ones.
pub fn camera(compressed: bool, rest: &str) -> Host {
    let kind = if compressed { "CompressedImage" } else { "Image" };
    let input = format!(
        "[[input]]\nname = \"camera\"\ntopic = \"/camera\"\ntype = \"sensor_msgs/msg/{kind}\"\n"
    );
    Host::from_manifest(&manifest(&format!("[schedule]\nevent = \"camera\"\n{input}{rest}")))
}
