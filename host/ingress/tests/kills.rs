//! An ingress with readers in other processes: honest ones, killed ones, and ones that break the
//! rules, while samples flow.
//!
//! `GLEANER_LONG=1` kills 200 readers instead of ten; `GLEANER_KILLS` is another number.
#![allow(unsafe_code)]

use std::env;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::process::{Child, ChildStdout, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use gleaner_buffers::shared::ControlMemory;
use gleaner_ingress::Ingress;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{Guid, SampleMeta, StoredMeta};
use gleaner_protocol::ingress::{
    AddReader, IngressControl, IngressLink, PinGrant, PublishGrant, TopicGrant,
};
use gleaner_protocol::link::Incoming;
use gleaner_samples::Feed;
use gleaner_samples::regions::ControlRegion;
use gleaner_test_support::random::XorShift64;
use libtest_mimic::{Arguments, Trial};

/// The variable with the role of a child of this program.
const ROLE: &str = "GLEANER_TEST_ROLE";
const TYPE: &str = "test_msgs/msg/Words";
const TIMEOUT: Duration = Duration::from_secs(60);
/// Words of the largest sample.
const WORDS: usize = 512;
/// Words of a control page that a hostile reader overwrites: more than it is granted.
const GARBAGE_WORDS: usize = 16;

fn main() -> ExitCode {
    match env::var(ROLE).as_deref() {
        Ok("verify") => verify(),
        Ok("hold") => hold(),
        Ok("pages") => pages(),
        Ok("noise") => noise(),
        Ok("flood") => flood(),
        _ => {
            let kills = || {
                beside_killed_and_hostile_readers();
                Ok(())
            };
            let trial = Trial::test("honest_readers_beside_killed_and_hostile_ones", kills);
            return libtest_mimic::run(&Arguments::from_args(), vec![trial]).exit_code();
        }
    }
    ExitCode::SUCCESS
}

/// A child that is a reader; killed when it is dropped.
struct ReaderProcess {
    child: Child,
    stdout: BufReader<ChildStdout>,
}

impl ReaderProcess {
    fn start(control: &mut IngressControl, role: &str) -> Self {
        let grant = TopicGrant {
            topic: "/words".to_owned(),
            type_name: Some(TYPE.to_owned()),
            queue: 8,
            max_bytes: Some(8 * WORDS as u64),
            depth: 64,
            holds: PinGrant { windows: 2, window: 16, singles: 8 },
            wakes: true,
            digests: role == "verify",
            ..TopicGrant::default()
        };
        let (topic, type_name) = ("/published".to_owned(), TYPE.to_owned());
        let publishes = vec![PublishGrant { topic, type_name, depth: 4, max_bytes: 1024 }];
        let add = AddReader { name: role.to_owned(), topics: vec![grant], publishes };
        let socket = control.add_reader(&add).unwrap();
        let mut child = Command::new(env::current_exe().unwrap())
            .env(ROLE, role)
            .stdin(socket)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        let mut started = Self { child, stdout };
        started.expect("ready");
        started
    }

    fn expect(&mut self, line: &str) {
        let mut found = String::new();
        self.stdout.read_line(&mut found).unwrap();
        assert_eq!(found.trim_end(), line);
    }
}

impl Drop for ReaderProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn beside_killed_and_hostile_readers() {
    let given = env::var("GLEANER_KILLS").ok().and_then(|number| number.parse().ok());
    let usual = if env::var_os("GLEANER_LONG").is_some() { 200 } else { 10 };
    let kills: u32 = given.unwrap_or(usual);
    let source = Loopback::new();
    source.add_topic("/words", TYPE, "");
    source.add_topic("/published", TYPE, "");
    let (mut control, ingress) = Ingress::start_in_thread(Box::new(source.clone()));
    let mut honest = ["verify", "verify"].map(|role| ReaderProcess::start(&mut control, role));
    let hostile = ["pages", "pages", "flood"].map(|role| ReaderProcess::start(&mut control, role));
    let stop = Arc::new(AtomicBool::new(false));
    let publishing = std::thread::spawn({
        let stop = Arc::clone(&stop);
        move || publish(&source, &stop)
    });
    let started = Instant::now();
    for _ in 0..kills {
        let mut noise = ReaderProcess::start(&mut control, "noise");
        ReaderProcess::start(&mut control, "hold").expect("holds");
        noise.expect("disconnected");
    }
    let elapsed = started.elapsed();
    drop(hostile);
    stop.store(true, Ordering::Relaxed);
    let mut times = publishing.join().unwrap();
    times.sort_unstable();
    // The readers then see the end of their connections.
    drop(control);
    ingress.join().unwrap();
    let published = times.len();
    for reader in &mut honest {
        let mut report = String::new();
        reader.stdout.read_to_string(&mut report).unwrap();
        assert!(reader.child.wait().unwrap().success(), "{report}");
        println!("{}", report.trim_end());
    }
    let at = |share: f64| times[((times.len() - 1) as f64 * share) as usize] / 1000;
    println!(
        "{kills} readers killed and as many disconnected in {elapsed:.1?}, {published} samples; \
         to publish one: p50 {} us, p99 {} us, p99.9 {} us, max {} us",
        at(0.5),
        at(0.99),
        at(0.999),
        at(1.0),
    );
}

/// Publishes samples, all words of which are their number; returns the time of each call, in ns.
fn publish(source: &Loopback, stop: &AtomicBool) -> Vec<u64> {
    let mut times = Vec::new();
    let mut seq = 0_u64;
    while !stop.load(Ordering::Relaxed) {
        seq += 1;
        let cdr = seq.to_le_bytes().repeat(1 + seq as usize % WORDS);
        let meta = SampleMeta::new(seq as i64, Guid(*b"publishes words "), seq);
        let begun = Instant::now();
        source.publish("/words", &meta, &cdr).unwrap();
        times.push(begun.elapsed().as_nanos() as u64);
        if seq.is_multiple_of(4) {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
    times
}

fn socket() -> OwnedFd {
    rustix::stdio::stdin().try_clone_to_owned().unwrap()
}

fn print(line: &str) {
    println!("{line}");
    std::io::stdout().flush().unwrap();
}

/// Verifies samples, some of them again after a while, until the ingress ends.
fn verify() {
    let mut feed = Feed::connect(socket()).unwrap();
    let topic = feed.topic(0, TIMEOUT).unwrap();
    let mut bell = feed.bell();
    print("ready");
    let (mut next, mut verified, mut missed) = (topic.info.first, 0_u64, 0_u64);
    let is_whole = |sample: &gleaner_buffers::shared::HeldSample| {
        let seq = StoredMeta::of_words(sample.meta()).sample.seq;
        sample.len() == 8 * (1 + seq as usize % WORDS)
            && sample.chunks_exact(8).all(|word| word == seq.to_le_bytes())
    };
    let mut held = Vec::new();
    loop {
        let seen = bell.value();
        let head = topic.reader.head();
        while next < head {
            match topic.reader.get(next).unwrap() {
                Some(sample) => {
                    assert!(is_whole(&sample), "torn");
                    verified += 1;
                    if held.len() < 6 && next.is_multiple_of(7) {
                        held.push(sample);
                    }
                }
                None => missed += 1,
            }
            next += 1;
        }
        if let Some(window) = topic.reader.last_before(u64::MAX, 16).unwrap() {
            assert!(window.iter().all(is_whole), "torn");
        }
        assert!(held.iter().all(is_whole), "torn while held");
        if next.is_multiple_of(5) {
            held.clear();
        }
        if feed.poll().is_err() {
            return print(&format!("{verified} samples verified, {missed} left before"));
        }
        bell.wait(seen, Duration::from_millis(100));
    }
}

/// Holds as many samples as it can, until it is killed.
fn hold() {
    let mut feed = Feed::connect(socket()).unwrap();
    let topic = feed.topic(0, TIMEOUT).unwrap();
    print("ready");
    let mut held = Vec::new();
    while held.len() < 10 {
        held.extend(topic.reader.newest_before(u64::MAX).unwrap());
        std::thread::sleep(Duration::from_millis(1));
        if topic.reader.newest_before(u64::MAX).is_err() {
            break;
        }
    }
    print("holds");
    std::thread::sleep(TIMEOUT * 10);
    drop(held);
}

/// Returns random numbers, other ones in each process.
fn random() -> impl FnMut() -> u64 {
    let seed = 0x9e37_79b9_7f4a_7c15_u64.wrapping_mul(u64::from(std::process::id()) | 1);
    let mut random = XorShift64(seed);
    move || random.number()
}

/// Writes garbage to its control page, and reads its socket never again.
fn pages() {
    let (mut link, _requests) = IngressLink::new(socket());
    let page = loop {
        if let Incoming::Message(delivery) = link.poll().unwrap() {
            break delivery.descriptor.unwrap();
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    let page = ControlRegion::open(File::from(page)).unwrap();
    print("ready");
    let mut random = random();
    loop {
        for word in 0..GARBAGE_WORDS {
            // SAFETY: this reader holds nothing.
            unsafe { page.overwrite(word, random()) };
        }
        std::thread::sleep(Duration::from_micros(50));
    }
}

/// Sends garbage until it is disconnected.
fn noise() {
    let mut socket = UnixStream::from(socket());
    let mut random = random();
    print("ready");
    loop {
        let mut garbage = vec![0; 1000];
        garbage.chunks_exact_mut(8).for_each(|word| word.copy_from_slice(&random().to_le_bytes()));
        if socket.write_all(&garbage).is_err() {
            return print("disconnected");
        }
    }
}

/// Publishes without a pause.
fn flood() {
    let feed = Feed::connect(socket()).unwrap();
    let publisher = feed.publisher(0);
    print("ready");
    loop {
        if publisher.publish(&[7; 1000]).is_err() {
            let _ = rustix::event::poll(
                &mut [rustix::event::PollFd::new(&feed.as_fd(), rustix::event::PollFlags::OUT)],
                None,
            );
        }
    }
}
