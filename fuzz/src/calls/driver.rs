//! The component `driver`, what it sees, and what is promised of each of its wakes.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use gleaner_base::ByteSize;
use gleaner_compile::Nans;
use gleaner_host::api::Session;
use gleaner_host::api::data::{Topic, Wake};
use gleaner_host::api::log::{LINE_BYTES, Line};
use gleaner_host::api::trigger::{ATTRIBUTES, LABEL_BYTES, PER_WAKE};
use gleaner_host::guest::Guest;
use gleaner_host::guest::wasm::{Loaded, WasmGuest};
use gleaner_host::input::open_inputs;
use gleaner_journal::{Decoder, Encoder, Entry, Woken};
use gleaner_lambda::Manifest;
use gleaner_messages::{Endian, Sources};
use gleaner_operations::Operation::{
    AsFrame, Column, Field, Input as Topics, MeanLuma, Newest, Resize, ToGray,
};
use gleaner_transport::loopback::Loopback;
use gleaner_transport::{Guid, SampleMeta};

use super::pictures::{coded, raw};
use super::{picture, program};
use crate::input::Input;

/// What the host may allocate for an input: the pictures that a lambda makes, 4 MiB by the
/// manifest, and as much for all else. Samples and the memory of the guest are mapped.
pub(super) const MEMORY: usize = 8 << 20;

/// The largest sample, and what a picture may become; the sound ones have 9 KiB of pixels.
const SAMPLE: ByteSize = ByteSize::kib(16);
const DECODED: ByteSize = ByteSize::kib(32);

/// How long a fault's message is at most: what a panic says is a line of a log.
const MESSAGE_BYTES: usize = LINE_BYTES + 256;

/// Calls that take all frames there are, and one more. How much fuel they burn tells whether any is
/// missing.
fn known_calls() -> Vec<u8> {
    let (small, gray) =
        ([(Resize, &[0, 0, 16, 16][..]), (Resize, &[1, 0, 16, 16])], [(ToGray, &[2][..])]);
    [
        // The cameras, a field of each, their newest samples, and the pictures of these.
        program(&[(Topics, &[1]), (Topics, &[2]), (Field, &[0, 0, 2]), (Field, &[1, 0, 4])]),
        program(&[(Newest, &[0]), (Newest, &[1]), (AsFrame, &[1]), (AsFrame, &[2])]),
        // Their light, and a column.
        program(&[(MeanLuma, &[0, 0]), (MeanLuma, &[1, 0]), (Column, &[0, 0, 1, 0, 0, 0])]),
        // Four in another size, and eleven in grey.
        program(&small).repeat(2),
        program(&gray).repeat(11),
    ]
    .concat()
}

/// One wake, as a journal has it.
#[derive(Debug, PartialEq)]
pub(super) struct Woke {
    /// Whether `driver` was there and had a program.
    pub(super) ran: bool,
    entry: Entry,
    log: Vec<Line>,
}

/// What all instances have in common.
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
        // All of it is mapped and touched for each input of the fuzzer: a quarter of the time would
        // go there.
        for input in &mut manifest.inputs {
            input.max_size = SAMPLE;
            input.decoded_size = input.decoded_size.map(|_| DECODED);
        }
        let (code, cache) = (lambda.join("driver.wasm"), root.join("target/test-cache/gleaner"));
        let stack = manifest.limits.stack.as_usize();
        let loaded = Loaded::open(&code, &cache, stack, Nans::AsMade)
            .unwrap_or_else(|error| missing(&error));
        let definition = |name| {
            let text = Sources::default()
                .find(name)
                .expect("a bundled type is whole")
                .expect("the type is bundled");
            (name, text.to_string())
        };
        let definitions =
            ["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"].map(definition);
        Common { manifest, loaded, definitions, raw: raw(), coded: coded() }
    })
}

/// What known calls are answered with, by an instance that is the first on its inputs: the wake's
/// fuel, which tells refusals apart.
pub(super) fn known() -> Option<u64> {
    static FUEL: OnceLock<Option<u64>> = OnceLock::new();
    *FUEL.get_or_init(|| {
        let fuel = Driver::new().give_back();
        assert!(fuel.is_some(), "the known calls need inputs");
        fuel
    })
}

/// An instance of `driver` and what it sees. Each input of a fuzzer has one of its own, so that
/// what it does happens again.
pub(super) struct Driver {
    guest: WasmGuest,
    session: Session,
    transport: Loopback,
    inputs: Vec<Arc<Topic>>,
    /// References to each input before the first wake.
    unused: Vec<usize>,
    sent: u64,
}

impl Driver {
    pub(super) fn new() -> Self {
        let Common { manifest, loaded, definitions, .. } = common();
        let mut transport = Loopback::new();
        transport.add_topic("/program", "test_msgs/msg/Program", "uint8[] data\n");
        for (topic, (name, text)) in ["/camera/raw", "/camera/coded"].into_iter().zip(definitions) {
            transport.add_topic(topic, name, text);
        }
        let inputs =
            open_inputs(manifest, &[], &mut transport, None).expect("the inputs fit into memory");
        let session = Session::new(inputs.clone(), Vec::new(), &manifest.limits);
        let guest = WasmGuest::new(loaded.clone(), session.clone(), &manifest.limits, None)
            .expect("descriptors are left");
        let unused = inputs.iter().map(Arc::strong_count).collect();
        let mut driver = Self { guest, session, transport, inputs, unused, sent: 0 };
        driver.guest.init().expect("driver does nothing at its start");
        driver
    }

    fn publish(&mut self, topic: &str, cdr: &[u8], endian: Endian) {
        self.sent += 1;
        let (at_ns, seq) = (self.sent as i64 * 1_000_000, self.sent);
        let meta = SampleMeta {
            at_ns,
            publish_ns: at_ns,
            writer: Guid::default(),
            seq,
            endian,
            options: [0; 2],
        };
        self.transport.publish(topic, &meta, cdr).expect("the topic was added");
    }

    /// Runs a wake as an input says it.
    pub(super) fn wake(&mut self, wake: &[u8]) -> Woke {
        let Common { raw, coded, .. } = common();
        let mut input = Input(wake);
        for (topic, sound) in [("/camera/raw", raw), ("/camera/coded", coded)] {
            let (cdr, endian) = message(&mut input, sound);
            self.publish(topic, &cdr, endian);
        }
        self.run(input.0)
    }

    fn run(&mut self, program: &[u8]) -> Woke {
        let mut cdr = (program.len() as u32).to_le_bytes().to_vec();
        cdr.extend(program);
        self.publish("/program", &cdr, Endian::Little);
        let at_ns = self.sent as i64 * 1_000_000;
        self.session.begin(at_ns);
        // It keeps what it likes: then there may be no room for the program, and the one before
        // runs again.
        let newest = self.inputs[0].newest();
        let ran = newest.as_ref().is_some_and(|sample| sample.identity().seq == self.sent);
        let outcome = newest.map(|sample| self.guest.wake(Wake::Event(sample)));
        let (log, said) = self.session.take_log();
        let (result, fuel) =
            outcome.map_or((Ok(()), None), |outcome| (outcome.result, outcome.fuel));
        let (triggers, cause) =
            (self.session.end(), Woken::Sample { writer: [0; 16], seq: self.sent });
        let entry = Entry {
            at_ns,
            cause,
            seen: Vec::new(),
            triggers,
            fault: result.err(),
            fuel,
            log: said,
        };
        self.hold_to_promises(&entry, &log);
        Woke { ran, entry, log }
    }

    fn hold_to_promises(&self, entry: &Entry, log: &[Line]) {
        let limits = &common().manifest.limits;
        match &entry.fault {
            Some(fault) => {
                let length = fault.message.len();
                assert!(
                    (1..=MESSAGE_BYTES).contains(&length),
                    "a fault with a message of {length} bytes"
                );
                assert_eq!(self.held(), self.unused, "after a fault something of it is still held");
            }
            None => assert!(
                entry.fuel.is_none_or(|fuel| fuel <= limits.fuel),
                "{:?} is more than allowed",
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
        assert!(log.iter().all(|line| line.message.len() <= LINE_BYTES), "a line that is too long");
        let mut bytes = Vec::new();
        Encoder::new(0).encode(entry, &mut bytes);
        let mut rest = bytes.as_slice();
        let read = Decoder::new(0).decode(&mut rest).expect("what a wake decides can be noted");
        assert!(read == *entry && rest.is_empty(), "noted as {read:?}, not as {entry:?}");
    }

    fn held(&self) -> Vec<usize> {
        self.inputs.iter().map(Arc::strong_count).collect()
    }

    /// Ends the instance and runs known calls in another one: what the first held is there for it.
    pub(super) fn give_back(&mut self) -> Option<u64> {
        self.guest.init().expect("driver does nothing at its start");
        assert_eq!(self.held(), self.unused, "what is gone still holds something");
        let Common { raw, coded, .. } = common();
        self.publish("/camera/raw", &raw[0], Endian::Little);
        self.publish("/camera/coded", &coded[0], Endian::Little);
        let woke = self.run(&known_calls());
        assert!(woke.ran && woke.entry.fault.is_none(), "{woke:?}");
        woke.entry.fuel
    }

    /// What it held goes with it, and nothing else holds the inputs.
    pub(super) fn end(self) {
        let Self { guest, session, transport, inputs, .. } = self;
        drop((guest, session, transport));
        assert!(inputs.iter().all(|topic| Arc::strong_count(topic) == 1));
    }
}

/// One of the sound messages, as `input` changes it.
fn message(input: &mut Input, sound: &[Vec<u8>]) -> (Vec<u8>, Endian) {
    let how = input.u8();
    let endian = if how & picture::BIG_ENDIAN == 0 { Endian::Little } else { Endian::Big };
    if how & picture::OWN != 0 {
        let length = input.u8();
        return (input.bytes(length.into()).to_vec(), endian);
    }
    let mut message = sound[usize::from(how & picture::WHICH) % sound.len()].clone();
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
