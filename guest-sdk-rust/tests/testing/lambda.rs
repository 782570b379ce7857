//! A lambda that does what a test says, in `init` and in each wake.

use std::cell::RefCell;

use gleaner_sdk::testing::{Host, Run};
use gleaner_sdk::{Config, Lambda, Result, Sample, Tick};

type OnEvent = Box<dyn FnMut(Sample) -> Result<()>>;
type OnTick = Box<dyn FnMut(Tick) -> Result<()>>;

/// What is called in a wake.
pub enum Handler {
    Event(OnEvent),
    Tick(OnTick),
}

type Make = Box<dyn FnMut(&Config) -> Result<Handler>>;

thread_local! {
    static MAKE: RefCell<Option<Make>> = const { RefCell::new(None) };
}

pub struct Told(Handler);

impl Lambda for Told {
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

/// Loads a lambda of which `init` is `make`.
pub fn load(
    host: Host,
    make: impl FnMut(&Config) -> Result<Handler> + 'static,
) -> std::result::Result<Run<Told>, gleaner_sdk::testing::Error> {
    MAKE.set(Some(Box::new(make)));
    host.load()
}

/// A lambda that does this in each wake; it keeps nothing.
pub fn on_event(host: Host, handler: impl Fn(Sample) -> Result<()> + Copy + 'static) -> Run<Told> {
    load(host, move |_| Ok(Handler::Event(Box::new(handler)))).unwrap()
}

/// A manifest that begins with a usual lambda, and goes on with `rest`.
pub fn manifest(rest: &str) -> String {
    let lambda =
        "[lambda]\nname = \"told\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"told.wasm\"\n";
    format!("{lambda}{rest}")
}

/// Woken by an IMU, with these further keys of its input, and `rest` behind.
pub fn imu(keys: &str, rest: &str) -> Host {
    let input =
        "[[input]]\nname = \"imu\"\ntopic = \"/imu/data\"\ntype = \"sensor_msgs/msg/Imu\"\n";
    Host::from_manifest(&manifest(&format!("[schedule]\nevent = \"imu\"\n{input}{keys}\n{rest}")))
}

/// Woken by a camera with raw pictures or, if `compressed`, others.
pub fn camera(compressed: bool, rest: &str) -> Host {
    let kind = if compressed { "CompressedImage" } else { "Image" };
    let input = format!(
        "[[input]]\nname = \"camera\"\ntopic = \"/camera\"\ntype = \"sensor_msgs/msg/{kind}\"\n"
    );
    Host::from_manifest(&manifest(&format!("[schedule]\nevent = \"camera\"\n{input}{rest}")))
}
