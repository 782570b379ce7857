//! A writer and readers in separate processes: what readers see, and what hostile and killed
//! readers cannot do.
#![allow(unsafe_code)]

use std::env;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Read};
use std::process::{Child, ChildStdout, Command, ExitCode, Stdio};
use std::time::Duration;

use gleaner_buffers::shared::{
    ControlMemory, META_WORDS, Notifier, PinLimits, ReaderId, ReaderMemory, SharedLayout,
    SharedReader, SharedWriter, WriterMemory,
};
use gleaner_samples::regions::{ControlRegion, KernelFutex, MappedTopic, TopicRegion};
use gleaner_test_support::random::XorShift64;
use libtest_mimic::{Arguments, Trial};

const LAYOUT: SharedLayout = SharedLayout { depth: 8, slots: 64, slot_bytes: 4096 };
const LIMITS: PinLimits = PinLimits { first_word: 0, windows: 2, window: 4, singles: 4 };

/// Words of a control page that a hostile reader overwrites: more than it is granted.
const GARBAGE_WORDS: usize = 16;

/// The variable with the role of a child of this program.
const ROLE: &str = "GLEANER_TEST_ROLE";

/// The word of each sample after the last one.
const END: u64 = u64::MAX;

fn main() -> ExitCode {
    match env::var(ROLE).as_deref() {
        Ok("verify") => verify(),
        Ok("garbage") => garbage(),
        Ok("hold") => hold(),
        _ => {
            let trial = |name: &str, test: fn()| {
                Trial::test(name, move || {
                    test();
                    Ok(())
                })
            };
            let trials = vec![
                trial(
                    "honest_readers_see_whole_samples_beside_hostile_ones",
                    beside_hostile_readers,
                ),
                trial("a_reader_killed_while_it_holds_samples_frees_them", killed_readers),
            ];
            return libtest_mimic::run(&Arguments::from_args(), trials).exit_code();
        }
    }
    ExitCode::SUCCESS
}

struct Topic {
    region: File,
    writer: SharedWriter,
    bells: Vec<Notifier>,
}

struct ReaderProcess {
    child: Child,
    stdout: BufReader<ChildStdout>,
    id: ReaderId,
}

impl Drop for ReaderProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Topic {
    fn new() -> Self {
        let bytes = LAYOUT.bytes_needed().unwrap();
        let (region, file) = TopicRegion::create("test", bytes, 4096).unwrap();
        let memory = WriterMemory::new(region, LAYOUT).unwrap();
        Self { region: file, writer: SharedWriter::new(memory), bells: Vec::new() }
    }

    /// Starts a reader, and waits for its first line.
    fn start(&mut self, role: &str) -> ReaderProcess {
        let (control, file) = ControlRegion::create().unwrap();
        let id = self.writer.attach(control.clone(), LIMITS).unwrap();
        self.bells.push(Notifier::of(control));
        let mut child = Command::new(env::current_exe().unwrap())
            .env(ROLE, role)
            .stdin(self.region.try_clone().unwrap())
            .stderr(file)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        assert_eq!(line, "ready\n", "{role}");
        ReaderProcess { child, stdout, id }
    }

    fn publish(&mut self, word: u64) {
        let len = 8 * (1 + self.writer.head() as usize % 512);
        let mut draft = self.writer.draft(len).unwrap();
        draft.chunks_exact_mut(8).for_each(|bytes| bytes.copy_from_slice(&word.to_le_bytes()));
        self.writer.publish(&[word; META_WORDS]).unwrap();
        for bell in &self.bells {
            bell.ring(&KernelFutex);
        }
    }
}

fn beside_hostile_readers() {
    let samples = if env::var_os("GLEANER_LONG").is_some() { 1_000_000 } else { 50_000 };
    let mut topic = Topic::new();
    let hostile = [topic.start("garbage"), topic.start("garbage")];
    let mut honest = topic.start("verify");
    for word in 0..samples {
        topic.publish(word);
    }
    topic.publish(END);
    let mut report = String::new();
    honest.stdout.read_to_string(&mut report).unwrap();
    let verified: u64 = report.trim().parse().unwrap();
    assert!(verified > 0);
    assert!(honest.child.wait().unwrap().success());
    println!("{verified} of {samples} samples verified");
    drop(hostile);
}

fn killed_readers() {
    let kills = if env::var_os("GLEANER_LONG").is_some() { 400 } else { 20 };
    let mut topic = Topic::new();
    let mut honest = topic.start("verify");
    topic.publish(0);
    for round in 1..=kills {
        let mut holder = topic.start("hold");
        let mut line = String::new();
        while line != "holds\n" {
            topic.publish(round);
            line.clear();
            holder.stdout.read_line(&mut line).unwrap();
        }
        // More samples than slots: those of the holder stay, all others are used again.
        (0..2 * u64::from(LAYOUT.slots)).for_each(|_| topic.publish(round));
        holder.child.kill().unwrap();
        holder.child.wait().unwrap();
        topic.writer.detach(holder.id);
        topic.bells.truncate(1);
        (0..2 * u64::from(LAYOUT.slots)).for_each(|_| topic.publish(round));
    }
    topic.publish(END);
    assert!(honest.child.wait().unwrap().success());
}

/// Maps the topic and the control page that the parent passed.
fn attached() -> (SharedReader, ControlRegion) {
    let topic = File::open("/proc/self/fd/0").unwrap();
    let topic = MappedTopic::open(topic, LAYOUT.bytes_needed().unwrap()).unwrap();
    let memory = ReaderMemory::new(topic, LAYOUT).unwrap();
    let control = OpenOptions::new().read(true).write(true).open("/proc/self/fd/2").unwrap();
    let control = ControlRegion::open(control).unwrap();
    // SAFETY: the parent attached this page with these limits; the roles that store garbage hold
    // nothing.
    let reader = unsafe { SharedReader::new(&memory, control.clone(), LIMITS) }.unwrap();
    println!("ready");
    (reader, control)
}

/// Verifies the newest samples until the last one; exits by a panic if one is torn.
fn verify() {
    let (reader, control) = attached();
    let mut bell = Notifier::of(control);
    let mut verified = 0;
    loop {
        let seen = bell.value();
        if let Some(window) = reader.last_before(u64::MAX, 4).unwrap() {
            for sample in window.iter() {
                let word = sample.meta()[0];
                assert!(sample.chunks_exact(8).all(|bytes| bytes == word.to_le_bytes()), "torn");
                if word == END {
                    println!("{verified}");
                    return;
                }
                verified += 1;
            }
        }
        bell.wait(seen, Duration::from_secs(10), &KernelFutex);
    }
}

/// Writes garbage over its hazards until it is killed.
fn garbage() {
    let (reader, control) = attached();
    let mut random =
        XorShift64(0x9e37_79b9_7f4a_7c15_u64.wrapping_mul(u64::from(std::process::id())));
    loop {
        for word in 0..GARBAGE_WORDS {
            let state = random.number();
            // Half of the words name positions that are shown.
            let near = reader.head().saturating_sub(state % 16) << 16 | 0xffff;
            // SAFETY: this process holds nothing.
            unsafe { control.overwrite(word, if state.is_multiple_of(2) { state } else { near }) };
        }
    }
}

/// Holds the newest samples until it is killed.
fn hold() {
    let (reader, _) = attached();
    let window = loop {
        if let Some(window) = reader.last_before(u64::MAX, 4).unwrap() {
            break window;
        }
        std::thread::yield_now();
    };
    println!("holds");
    let words: Vec<u64> = window.iter().map(|sample| sample.meta()[0]).collect();
    loop {
        for (sample, word) in window.iter().zip(&words) {
            assert!(sample.chunks_exact(8).all(|bytes| bytes == word.to_le_bytes()), "torn");
        }
        std::thread::sleep(Duration::from_millis(1));
    }
}
