//! Tests of the health and the shutdown of a participant.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use gleaner_dds::{Dds, DdsOptions};
use gleaner_messages::transport::{Clock, Delivery, LiveSource, Qos, SampleMeta, Sink, Transport};
use gleaner_protocol::NetworkStatus;

use super::Test;
use super::peer::{
    KeptSamples, Peer, connected, domain, matched, open, open_in, options, spec, until, write,
};

/// The test that needs to run alone: no other may have threads of the library.
pub const ALONE: &str =
    "no_signal_interrupts_the_threads_of_rustdds_and_other_threads_are_unchanged";

pub const TESTS: &[Test] = &[
    ("the_granted_buffer_is_reported", buffer),
    (ALONE, signals),
    ("a_sink_that_holds_a_sample_is_death_but_an_idle_writer_is_not", stuck),
    ("a_sink_that_panics_is_reported_and_other_topics_go_on", panicking),
    ("a_participant_can_be_dropped_while_samples_arrive", dropped),
    ("a_participant_can_be_dropped_while_a_sink_is_stuck", dropped_while_stuck),
    ("a_time_of_day_that_is_set_back_is_reported_as_death", set_back),
    ("an_invalid_node_name_is_refused", bad_node),
];

fn set_back() {
    static BACK_NS: AtomicI64 = AtomicI64::new(0);
    let time_of_day = || Clock::from_time_of_day().now() - BACK_NS.load(Ordering::Relaxed);
    let domain = domain();
    let mut dds = Dds::open(DdsOptions { time_of_day, ..options(domain) }).unwrap();
    let sink = KeptSamples::new();
    dds.subscribe(&spec("/clock", Qos::Auto), sink.clone()).unwrap();
    let peer = Peer::join(domain);
    // When this arrives, the clock has been checked.
    sink.mark(&peer.writer("/clock", false, false), b"tick");
    assert_eq!(dds.health().dead, None);
    BACK_NS.store(3_600_000_000_000, Ordering::Relaxed);
    until("death", || dds.health().dead.is_some());
    let dead = dds.health().dead.unwrap();
    assert!(dead.starts_with("the time of day was set back by 3600 s: "), "{dead}");
}

fn buffer() {
    for (largest, asked) in [(1, 8 << 20), (4 << 20, 16 << 20), (usize::MAX, 64 << 20)] {
        let dds = Dds::open(DdsOptions { largest, ..options(domain()) }).unwrap();
        let NetworkStatus { buffer_requested, buffer_granted, .. } = dds.health().network.unwrap();
        let limit = std::fs::read_to_string("/proc/sys/net/core/rmem_max")
            .unwrap()
            .trim()
            .parse::<usize>()
            .unwrap();
        assert_eq!((buffer_requested, buffer_granted), (asked, asked.min(limit)));
    }
}

/// The threads of RustDDS end at the first wait that is interrupted.
fn signals() {
    let blocked = |thread: &Path| {
        let status = fs::read_to_string(thread.join("status")).unwrap();
        let mask = status.lines().find_map(|line| line.strip_prefix("SigBlk:")).unwrap();
        u64::from_str_radix(mask.trim(), 16).unwrap()
    };
    let own = Path::new("/proc/thread-self");
    let before = blocked(own);
    let (_, _dds) = open();
    assert_eq!(blocked(own), before);
    // SIGALRM, SIGTERM, SIGCHLD; SIGSEGV is a thread's own.
    let bits = [14, 15, 17].map(|signal| 1 << (signal - 1)).iter().sum::<u64>();
    let threads = fs::read_dir("/proc/self/task").unwrap().map(|entry| entry.unwrap().path());
    // Other threads may end meanwhile; those of this participant run by now, and have their names.
    let name = |thread: &PathBuf| fs::read_to_string(thread.join("comm")).unwrap_or_default();
    let library: Vec<_> = threads.filter(|thread| name(thread).starts_with("RustDDS")).collect();
    assert!(library.len() >= 2, "{library:?}");
    for thread in library {
        assert_eq!(blocked(&thread) & bits, bits, "{}", name(&thread));
        assert_eq!(blocked(&thread) & 1 << 10, 0, "{}", name(&thread));
    }
}

/// A sink that keeps each sample until it is released.
struct Stuck {
    has: AtomicBool,
    release: Mutex<Receiver<()>>,
}

impl Stuck {
    fn new() -> (Arc<Self>, SyncSender<()>) {
        let (sender, receiver) = sync_channel(0);
        (Arc::new(Self { has: AtomicBool::new(false), release: Mutex::new(receiver) }), sender)
    }
}

impl Sink for Stuck {
    fn deliver(&self, _: &SampleMeta, _: &[u8]) -> Delivery {
        self.has.store(true, Ordering::SeqCst);
        let _ = self.release.lock().unwrap().recv();
        Delivery::Taken
    }
}

fn stuck() {
    let (domain, mut dds) = open();
    let (sink, release) = Stuck::new();
    let subscription = dds.subscribe(&spec("/stuck", Qos::Auto), sink.clone()).unwrap();
    let peer = Peer::join(domain);
    let writer = peer.writer("/stuck", true, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    // As long as a stuck sink takes to be detected: a silent writer must not count as dead.
    for _ in 0..13 {
        assert_eq!(dds.health().dead, None);
        thread::sleep(Duration::from_secs(1));
    }
    write(&writer, b"kept");
    until("the sample", || sink.has.load(Ordering::SeqCst));
    let mut dead = None;
    until("death", || {
        dead = dds.health().dead;
        dead.is_some()
    });
    assert!(dead.as_ref().unwrap().contains("the sink of topic `/stuck`"), "{dead:?}");
    drop(release);
    until("life", || dds.health().dead.is_none());
}

struct Panicking;

impl Sink for Panicking {
    fn deliver(&self, _: &SampleMeta, _: &[u8]) -> Delivery {
        panic!("this sink was meant to panic")
    }
}

fn panicking() {
    let (domain, mut dds) = open();
    let kept = KeptSamples::new();
    let bad = dds.subscribe(&spec("/bad", Qos::Auto), Arc::new(Panicking)).unwrap();
    let good = dds.subscribe(&spec("/good", Qos::Auto), kept.clone()).unwrap();
    let peer = Peer::join(domain);
    let (bad_writer, good_writer) =
        (peer.writer("/bad", true, false), peer.writer("/good", true, false));
    connected(&dds, bad, 1);
    connected(&dds, good, 1);
    matched(&bad_writer);
    matched(&good_writer);
    write(&bad_writer, b"x...");
    until("death", || dds.health().dead.is_some());
    let dead = dds.health().dead.unwrap();
    assert_eq!(dead, "the sink of topic `/bad` panicked: this sink was meant to panic");
    write(&good_writer, b"y...");
    kept.wait(1);
}

fn dropped() {
    let domain = domain();
    let peer = Peer::join(domain);
    let writer = peer.writer("/stream", false, false);
    let ended = AtomicBool::new(false);
    thread::scope(|scope| {
        scope.spawn(|| {
            while !ended.load(Ordering::SeqCst) {
                write(&writer, &[1; 1000]);
                // Without a pause, RustDDS would have little time for discovery.
                thread::sleep(Duration::from_micros(100));
            }
        });
        // Also if this thread panics, or the other one would not end.
        let _end = RaiseOnDrop(&ended);
        for _ in 0..5 {
            let mut dds = open_in(domain);
            let sink = KeptSamples::new();
            dds.subscribe(&spec("/stream", Qos::Auto), sink.clone()).unwrap();
            sink.wait(100);
            drop(dds);
            assert_eq!(Arc::strong_count(&sink), 1, "the sink was released");
        }
    });
}

struct RaiseOnDrop<'a>(&'a AtomicBool);

impl Drop for RaiseOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

fn dropped_while_stuck() {
    let (domain, mut dds) = open();
    let (sink, release) = Stuck::new();
    let subscription = dds.subscribe(&spec("/stuck", Qos::Auto), sink.clone()).unwrap();
    let peer = Peer::join(domain);
    let writer = peer.writer("/stuck", true, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    write(&writer, b"kept");
    until("the sample", || sink.has.load(Ordering::SeqCst));
    drop(dds);
    drop(release);
    until("the end of the detached thread", || Arc::strong_count(&sink) == 1);
}

fn bad_node() {
    for node in ["", "gleaner", "/", "/a b"] {
        let error =
            Dds::open(DdsOptions { node: node.to_owned(), ..options(domain()) }).err().unwrap();
        assert_eq!(error.to_string(), format!("`{node}` is not a node's namespace and name"));
    }
}
