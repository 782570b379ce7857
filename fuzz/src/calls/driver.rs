//! Runs the component `driver` on an input and checks the guarantees of each wake.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use gleaner_base::ByteSize;
use gleaner_compile::Nans;
use gleaner_host::api::Session;
use gleaner_host::api::data::{Topic, Wake};
use gleaner_host::api::log::{LINE_BYTES, LogLine};
use gleaner_host::api::trigger::{ATTRIBUTES, LABEL_BYTES, PER_WAKE};
use gleaner_host::guest::Guest;
use gleaner_host::guest::wasm::{Loaded, WasmGuest};
use gleaner_host::input::open_inputs;
use gleaner_journal::{Decoder, Encoder, JournalEntry, WakeSource};
use gleaner_lambda::Manifest;
use gleaner_messages::Endian;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{Guid, SampleMeta};
use gleaner_test_support::operations::Operation::{
    AsFrame, Column, Field, Input as Topics, MeanLuma, Newest, Resize, ToGray,
};

use super::pictures::{coded, raw};
use super::{picture, program};
use crate::input::FuzzInput;
use crate::message::bundled_text;

/// Host memory budget of an input: 4 MiB for decoded frames by the manifest, and as much for
/// everything else. Samples and the guest's memory are mapped, so they do not count.
pub(super) const MEMORY: usize = 8 << 20;

/// Maximum sample size and decoded size; the valid pictures have 9 KiB of pixels.
const SAMPLE: ByteSize = ByteSize::kib(16);
const DECODED: ByteSize = ByteSize::kib(32);

/// Maximum length of a fault's message: a panic's message is a log line.
const MESSAGE_BYTES: usize = LINE_BYTES + 256;

/// Calls that use every available frame, and one more. The burnt fuel shows whether a frame is
/// missing.
fn reference_calls() -> Vec<u8> {
    let (small, gray) =
        ([(Resize, &[0, 0, 16, 16][..]), (Resize, &[1, 0, 16, 16])], [(ToGray, &[2][..])]);
    [
        // Both cameras, a field of each, their newest samples, and the frames of these.
        program(&[(Topics, &[1]), (Topics, &[2]), (Field, &[0, 0, 2]), (Field, &[1, 0, 4])]),
        program(&[(Newest, &[0]), (Newest, &[1]), (AsFrame, &[1]), (AsFrame, &[2])]),
        // Mean luma of both, and a column.
        program(&[(MeanLuma, &[0, 0]), (MeanLuma, &[1, 0]), (Column, &[0, 0, 1, 0, 0, 0])]),
        // Four frames resized, and eleven in grey.
        program(&small).repeat(2),
        program(&gray).repeat(11),
    ]
    .concat()
}

/// The results of one wake, as a journal records them.
#[derive(Debug, PartialEq)]
pub(super) struct DriverWake {
    /// Set if `driver` received its program.
    pub(super) ran: bool,
    entry: JournalEntry,
    log: Vec<LogLine>,
}

struct Common {
    manifest: Manifest,
    loaded: Loaded,
    /// Type and definition of each input's messages.
    definitions: [(&'static str, String); 2],
    raw: Vec<Vec<u8>>,
    coded: Vec<Vec<u8>>,
}

fn common() -> &'static Common {
    static COMMON: OnceLock<Common> = OnceLock::new();
    COMMON.get_or_init(|| {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"))
            .parent()
            .map(PathBuf::from)
            .expect("fuzz/ lies in the checkout");
        let lambda = root.join("tests/lambdas/driver/rust/build");
        let missing = |what: &dyn std::fmt::Display| -> ! {
            panic!("{what}; run: cargo xtask fuzz calls --seconds 1")
        };
        let mut manifest = Manifest::load(&lambda).unwrap_or_else(|error| missing(&error));
        // All of it is mapped and touched for each fuzz input: the manifest's sizes would take a
        // quarter of the time.
        for input in &mut manifest.inputs {
            input.max_size = SAMPLE;
            input.decoded_size = input.decoded_size.map(|_| DECODED);
        }
        let (code, cache) = (lambda.join("driver.wasm"), root.join("target/test-cache/gleaner"));
        let stack = manifest.limits.stack.as_usize();
        let loaded = Loaded::open(&code, &cache, stack, Nans::Native)
            .unwrap_or_else(|error| missing(&error));
        let definition = |name| (name, bundled_text(name).to_string());
        let definitions =
            ["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"].map(definition);
        Common { manifest, loaded, definitions, raw: raw(), coded: coded() }
    })
}

/// Fuel of a wake that makes the reference calls, in the first instance on its inputs. The fuel
/// differs if a call is refused.
pub(super) fn reference_fuel() -> Option<u64> {
    static FUEL: OnceLock<Option<u64>> = OnceLock::new();
    *FUEL.get_or_init(|| {
        let fuel = DriverInstance::new().run_reference();
        assert!(fuel.is_some(), "the reference calls need inputs");
        fuel
    })
}

/// An instance of `driver` with its topics. Each fuzz input gets an instance of its own, so that
/// its results can be reproduced.
pub(super) struct DriverInstance {
    guest: WasmGuest,
    session: Session,
    transport: Loopback,
    inputs: Vec<Arc<Topic>>,
    /// References to each input before the first wake.
    unused: Vec<usize>,
    sent: u64,
}

impl DriverInstance {
    pub(super) fn new() -> Self {
        let Common { manifest, loaded, definitions, .. } = common();
        let mut transport = Loopback::new();
        transport.add_topic("/program", "test_msgs/msg/Program", "uint8[] data\n");
        for (topic, (name, text)) in ["/camera/raw", "/camera/coded"].into_iter().zip(definitions) {
            transport.add_topic(topic, name, text);
        }
        let inputs =
            open_inputs(manifest, &[], &mut transport).expect("the inputs fit into memory");
        let session = Session::new(inputs.clone(), Vec::new(), &manifest.limits);
        let guest = WasmGuest::new(loaded.clone(), session.clone(), &manifest.limits, None)
            .expect("descriptors are left");
        let unused = inputs.iter().map(Arc::strong_count).collect();
        let mut driver = Self { guest, session, transport, inputs, unused, sent: 0 };
        driver.guest.init().expect("`init` of driver does nothing");
        driver
    }

    fn publish(&mut self, topic: &str, cdr: &[u8], endian: Endian) {
        self.sent += 1;
        let (at_ns, seq) = (self.sent as i64 * 1_000_000, self.sent);
        let meta = SampleMeta { endian, ..SampleMeta::new(at_ns, Guid::default(), seq) };
        self.transport.publish(topic, &meta, cdr).expect("the topic was added");
    }

    /// Runs one wake of an input.
    pub(super) fn wake(&mut self, wake: &[u8]) -> DriverWake {
        let Common { raw, coded, .. } = common();
        let mut input = FuzzInput(wake);
        for (topic, valid) in [("/camera/raw", raw), ("/camera/coded", coded)] {
            let (cdr, endian) = message(&mut input, valid);
            self.publish(topic, &cdr, endian);
        }
        self.run(input.0)
    }

    fn run(&mut self, program: &[u8]) -> DriverWake {
        let mut cdr = (program.len() as u32).to_le_bytes().to_vec();
        cdr.extend(program);
        self.publish("/program", &cdr, Endian::Little);
        let at_ns = self.sent as i64 * 1_000_000;
        self.session.begin(at_ns);
        // The instance may hold all samples: then there is no slot for the program, and the
        // previous program runs again.
        let newest = self.inputs[0].newest().expect("a ring of this process");
        let ran = newest.as_ref().is_some_and(|sample| sample.identity().seq == self.sent);
        let outcome = newest.map(|sample| self.guest.wake(Wake::Event(sample)));
        let (log, digest) = self.session.take_log();
        let (result, fuel) =
            outcome.map_or((Ok(()), None), |outcome| (outcome.result, outcome.fuel));
        let (triggers, cause) =
            (self.session.end(), WakeSource::Sample { writer: [0; 16], seq: self.sent });
        let entry = JournalEntry {
            at_ns,
            cause,
            seen: Vec::new(),
            triggers,
            fault: result.err(),
            fuel,
            log: digest,
        };
        self.check_guarantees(&entry, &log);
        DriverWake { ran, entry, log }
    }

    fn check_guarantees(&self, entry: &JournalEntry, log: &[LogLine]) {
        let limits = &common().manifest.limits;
        match &entry.fault {
            Some(fault) => {
                let length = fault.message.len();
                assert!(
                    (1..=MESSAGE_BYTES).contains(&length),
                    "a fault with a message of {length} bytes"
                );
                assert_eq!(self.held(), self.unused, "a faulted instance still holds samples");
            }
            None => assert!(
                entry.fuel.is_none_or(|fuel| fuel <= limits.fuel),
                "{:?} exceeds the fuel limit",
                entry.fuel
            ),
        }
        assert!(entry.triggers.len() <= PER_WAKE);
        for trigger in &entry.triggers {
            assert!(
                (1..=LABEL_BYTES).contains(&trigger.label.len())
                    && trigger.attributes.len() <= ATTRIBUTES
            );
        }
        assert!(log.iter().all(|line| line.message.len() <= LINE_BYTES), "a log line is too long");
        let mut bytes = Vec::new();
        Encoder::new(0).encode(entry, &mut bytes);
        let mut rest = bytes.as_slice();
        let read = Decoder::new(0).decode(&mut rest).expect("a decision can be encoded");
        assert!(read == *entry && rest.is_empty(), "decoded {read:?}, not {entry:?}");
    }

    fn held(&self) -> Vec<usize> {
        self.inputs.iter().map(Arc::strong_count).collect()
    }

    /// Restarts the instance and makes the reference calls: everything that the previous instance
    /// held is available again.
    pub(super) fn run_reference(&mut self) -> Option<u64> {
        self.guest.init().expect("`init` of driver does nothing");
        assert_eq!(self.held(), self.unused, "an ended instance still holds samples");
        let Common { raw, coded, .. } = common();
        self.publish("/camera/raw", &raw[0], Endian::Little);
        self.publish("/camera/coded", &coded[0], Endian::Little);
        let wake = self.run(&reference_calls());
        assert!(wake.ran && wake.entry.fault.is_none(), "{wake:?}");
        wake.entry.fuel
    }

    /// Drops the instance and checks that its inputs have no other owner.
    pub(super) fn end(self) {
        let Self { guest, session, transport, inputs, .. } = self;
        drop((guest, session, transport));
        assert!(inputs.iter().all(|topic| Arc::strong_count(topic) == 1));
    }
}

/// One of the valid messages, modified as `input` describes.
fn message(input: &mut FuzzInput, valid: &[Vec<u8>]) -> (Vec<u8>, Endian) {
    let how = input.u8();
    let endian = if how & picture::BIG_ENDIAN == 0 { Endian::Little } else { Endian::Big };
    if how & picture::OWN != 0 {
        let length = input.u8();
        return (input.bytes(length.into()).to_vec(), endian);
    }
    let mut message = valid[usize::from(how & picture::WHICH) % valid.len()].clone();
    if how & picture::SHORT != 0 {
        message.truncate(input.u16().into());
    }
    for _ in 0..(how & picture::CHANGES) >> 4 {
        let (at, value) = (usize::from(input.u16()), input.u8());
        if let Some(byte) = message.get_mut(at) {
            *byte = value;
        }
    }
    (message, endian)
}
