//! Calls through the WIT, from the lambda `driver`. Each is charged. For any order and any
//! arguments, the host stays intact, releases its resources, and decides the same again. Programs
//! come from a random generator with a fixed seed.
//!
//! `GLEANER_HOST_CALLS` sets the number of programs; 10,000 take half a minute, a million an hour.

use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_compile::Nans;
use gleaner_host::api::Session;
use gleaner_host::api::data::{Topic, Wake};
use gleaner_host::guest::Guest;
use gleaner_host::guest::wasm::{Deadline, Loaded, WasmGuest};
use gleaner_host::input::open_inputs;
use gleaner_lambda::manifest::{Limits, Manifest};
use gleaner_lambda::{Fault, Trigger};
use gleaner_messages::Endian;
use gleaner_messages::transport::SampleMeta;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_protocol::process_stats::usage;
use gleaner_test_support::operations::{DriverStep, MESSAGE, Operation, setup};
use gleaner_tests::drive::{COMPRESSED, CdrBuilder, IMAGE, compressed, image};
use gleaner_tests::{root, times};

use crate::meta;
use crate::own_process::ran_elsewhere;

/// Maximum growth of the process over all programs, in bytes. The limits of `driver` bound its
/// memory at any time.
const GROWTH_BYTES: u64 = 32 << 20;

/// xorshift64: good enough to generate arguments, and the same on every machine.
struct RandomNumbers(u64);

impl RandomNumbers {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }

    /// Random bytes, of which some are edge cases.
    fn hostile(&mut self, n: u64) -> Vec<u8> {
        let length = self.below(n + 1);
        let edge = [0, 1, 2, 3, 16, 0x7f, 0x80, 0xff];
        let byte = |numbers: &mut Self| match numbers.below(3) {
            0 => edge[numbers.below(8) as usize],
            1 => numbers.below(48) as u8,
            _ => numbers.next() as u8,
        };
        (0..length).map(|_| byte(self)).collect()
    }

    /// Returns a valid message, one with some bytes changed, or random bytes.
    fn message(&mut self, valid: &[u8]) -> Vec<u8> {
        let mut message = valid.to_vec();
        match self.below(4) {
            0 => return self.hostile(200),
            1 => {
                for _ in 0..=self.below(4) {
                    let at = self.below(message.len() as u64) as usize;
                    message[at] = self.next() as u8;
                }
            }
            2 if self.below(4) == 0 => message.truncate(self.below(message.len() as u64) as usize),
            _ => {}
        }
        message
    }
}

/// The part of a wake's outcome that must be reproducible.
type ComparedOutcome = (Result<(), Fault>, Option<u64>, Vec<Trigger>);

struct DriverGuest {
    guest: WasmGuest,
    session: Session,
    transport: Loopback,
    inputs: Vec<Arc<Topic>>,
    sent: u64,
}

impl DriverGuest {
    fn new(timed: bool) -> Self {
        let lambda = root().join("tests/lambdas/driver/rust/build");
        let manifest = Manifest::load(&lambda).expect("driver is built; run: cargo xtask test");
        let mut transport = Loopback::new();
        for (input, definition) in manifest.inputs.iter().zip(["uint8[] data\n", IMAGE, COMPRESSED])
        {
            transport.add_topic(input.topic.as_str(), input.type_name.as_str(), definition);
        }
        let inputs = open_inputs(&manifest, &[], &mut transport).unwrap();
        let limits: &Limits = &manifest.limits;
        let session = Session::new(inputs.clone(), Vec::new(), limits);
        let cache = root().join("target/test-cache/gleaner");
        let loaded = Loaded::open(
            &lambda.join("driver.wasm"),
            &cache,
            limits.stack.as_usize(),
            Nans::Native,
        )
        .unwrap();
        let deadline = timed.then(|| Deadline::new(loaded.engine(), limits.deadline).unwrap());
        let mut guest = WasmGuest::new(loaded, session.clone(), limits, deadline).unwrap();
        guest.init().unwrap();
        Self { guest, session, transport, inputs, sent: 0 }
    }

    fn publish(&mut self, topic: &str, cdr: &[u8]) {
        self.sent += 1;
        let (at_ns, seq) = (self.sent as i64 * 1_000_000, self.sent);
        let endian = if cdr.len() % 7 == 5 { Endian::Big } else { Endian::Little };
        let meta = SampleMeta { endian, ..meta(at_ns, seq) };
        self.transport.publish(topic, &meta, cdr).unwrap();
    }

    /// Runs a program over these pictures.
    fn run(&mut self, raw: &[u8], coded: &[u8], program: &[u8]) -> ComparedOutcome {
        self.publish("/camera/raw", raw);
        self.publish("/camera/coded", coded);
        self.publish("/program", &CdrBuilder::default().bytes(program).done());
        self.session.begin(self.sent as i64 * 1_000_000);
        // It may hold all slots: then there is no room for the program, and the previous one runs
        // again.
        let Ok(Some(sample)) = self.inputs[0].newest() else { return (Ok(()), None, Vec::new()) };
        let outcome = self.guest.wake(Wake::Event(sample));
        self.session.take_log();
        (outcome.result, outcome.fuel, self.session.end())
    }
}

fn pictures() -> Vec<(Vec<u8>, Vec<u8>)> {
    let noise: Vec<u8> = (0..64 * 48 * 3_u32).map(|n| (n * 7 + n / 11) as u8).collect();
    let mut jpeg = Vec::new();
    jpeg_encoder::Encoder::new(&mut jpeg, 80)
        .encode(&noise, 64, 48, jpeg_encoder::ColorType::Rgb)
        .unwrap();
    let raw = [("rgb8", 192), ("mono16", 128), ("yuv422", 128), ("bayer_rggb8", 64)];
    raw.map(|(encoding, step)| {
        (image(64, 48, encoding, step, &noise[..48 * step as usize]), compressed(&jpeg))
    })
    .to_vec()
}

/// Fuel that the host charges for a call after [`setup`].
fn paid(operation: Operation, arguments: &[u8]) -> u64 {
    let (raw, coded) = &pictures()[0];
    assert_eq!(raw.len() as u64, MESSAGE, "the price list depends on the length of this message");
    let used = |program: &[u8]| {
        let mut driver = DriverGuest::new(false);
        let mut used = 0;
        // Until the rings are full, and the guest's memory has its final size.
        for _ in 0..6 {
            let (result, _, _) = driver.run(raw, coded, program);
            assert_eq!(result, Ok(()), "{}", operation.name());
            used = driver.session.fuel().used();
        }
        // It reads its program with a call, too.
        used - program.len() as u64 / 8
    };
    let call = DriverStep::Call(operation).with(arguments);
    used(&[setup(), call].concat()) - used(&setup())
}

#[test]
fn every_call_costs_its_listed_price() {
    let mut problems = Vec::new();
    for operation in Operation::ALL {
        let name = operation.name();
        let Some(calls) = operation.price().calls() else {
            assert_eq!(
                paid(*operation, &[]),
                0,
                "`{name}` can be called now: add its price to the list"
            );
            continue;
        };
        for (arguments, price) in calls {
            let paid = paid(*operation, arguments);
            if paid != price {
                problems.push(format!(
                    "`{name}` {arguments:?} cost {paid} units of fuel; the listed price is {price}"
                ));
            }
        }
    }
    assert!(problems.is_empty(), "\n{}", problems.join("\n"));
}

#[test]
fn no_sequence_of_calls_damages_the_host() {
    if ran_elsewhere("host_calls::no_sequence_of_calls_damages_the_host") {
        return;
    }
    let programs = times("GLEANER_HOST_CALLS", 10_000);
    let pictures = pictures();
    let mut numbers = RandomNumbers(0x9e37_79b9_7f4a_7c15);
    // The same calls twice, and a third time with a deadline.
    let (mut first, mut second, mut timed) =
        (DriverGuest::new(false), DriverGuest::new(false), DriverGuest::new(true));
    let (mut faults, mut triggers, mut longest) = ([0_u32; 9], 0, Duration::ZERO);
    let mut resident = None;
    for number in 0..programs {
        let (raw, coded) = &pictures[numbers.below(pictures.len() as u64) as usize];
        let (raw, coded) = (numbers.message(raw), numbers.message(coded));
        let program = numbers.hostile(600);
        let outcome = first.run(&raw, &coded, &program);
        assert_eq!(
            outcome,
            second.run(&raw, &coded, &program),
            "program {number} decides otherwise: {program:?}"
        );
        let started = Instant::now();
        let _ = timed.run(&raw, &coded, &program);
        longest = longest.max(started.elapsed());
        if let Err(fault) = &outcome.0 {
            faults[fault.kind as usize] += 1;
            assert!(!fault.message.is_empty(), "program {number}");
        }
        triggers += outcome.2.len();
        if number == programs / 10 {
            resident = Some(usage::resident());
        }
    }
    let (before, now) = (resident.unwrap_or_default(), usage::resident());
    println!(
        "{programs} programs: faults by kind {faults:?}, {triggers} triggers, longest wake {longest:?}"
    );
    println!("{} KiB resident after a tenth, {} KiB at the end", before / 1024, now / 1024);
    assert!(now < before + GROWTH_BYTES, "from {before} to {now} bytes");
    assert!(faults.iter().sum::<u32>() > 0 && triggers > 0, "the programs do nothing");
    // The guests release what they hold, and nothing else holds the inputs.
    for driver in [first, second, timed] {
        let DriverGuest { guest, session, transport, inputs, .. } = driver;
        drop((guest, session, transport));
        assert_eq!(inputs.iter().map(Arc::strong_count).collect::<Vec<_>>(), [1; 3]);
    }
}
