//! Whether a participant lives, and how it ends.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use gleaner_dds::{Dds, Options};
use gleaner_protocol::Network;
use gleaner_transport::{Clock, LiveSource, Qos, SampleMeta, Sink, Transport, Verdict};

use super::Test;
use super::peer::{Kept, Peer, connected, domain, matched, open, options, spec, until, write};

/// While it runs, no other may have threads of the library.
pub const ALONE: &str =
    "no_signal_interrupts_the_threads_of_the_library_and_ours_take_them_as_before";

pub const TESTS: &[Test] = &[
    ("the_buffer_that_was_granted_is_told", buffer),
    (ALONE, signals),
    ("an_idle_writer_is_no_death_and_a_sink_that_keeps_a_sample_is", stuck),
    ("a_sink_that_panics_is_death_with_a_name_and_other_topics_go_on", panicking),
    ("a_participant_that_is_dropped_ends_in_the_middle_of_samples", dropped),
    ("a_participant_is_not_kept_by_a_sink_that_does_not_come_back", dropped_while_stuck),
    ("a_time_of_day_that_is_set_back_is_death_with_words", set_back),
    ("a_node_name_that_is_none_is_refused", bad_node),
];

fn set_back() {
    static BACK_NS: AtomicI64 = AtomicI64::new(0);
    let time_of_day = || Clock::of_today().now() - BACK_NS.load(Ordering::Relaxed);
    let domain = domain();
    let mut dds = Dds::open(Options { time_of_day, ..options(domain) }).unwrap();
    let sink = Kept::new();
    dds.subscribe(&spec("/clock", Qos::Auto), sink.clone()).unwrap();
    let peer = Peer::join(domain);
    // Whoever hears this has looked at the clock.
    sink.mark(&peer.writer("/clock", false, false), b"tick");
    assert_eq!(dds.health().dead, None);
    BACK_NS.store(3_600_000_000_000, Ordering::Relaxed);
    until("death", || dds.health().dead.is_some());
    let dead = dds.health().dead.unwrap();
    assert!(dead.starts_with("the time of day was set back by 3600 s: "), "{dead}");
}

fn buffer() {
    for (largest, asked) in [(1, 8 << 20), (4 << 20, 16 << 20), (usize::MAX, 64 << 20)] {
        let dds = Dds::open(Options { largest, ..options(domain()) }).unwrap();
        let Network { buffer_asked, buffer_granted, .. } = dds.health().network.unwrap();
        let limit = std::fs::read_to_string("/proc/sys/net/core/rmem_max")
            .unwrap()
            .trim()
            .parse::<usize>()
            .unwrap();
        assert_eq!((buffer_asked, buffer_granted), (asked, asked.min(limit)));
    }
}

/// RustDDS ends at the first wait that is interrupted.
fn signals() {
    let blocked = |thread: &Path| {
        let status = fs::read_to_string(thread.join("status")).unwrap();
        let mask = status.lines().find_map(|line| line.strip_prefix("SigBlk:")).unwrap();
        u64::from_str_radix(mask.trim(), 16).unwrap()
    };
    let own = Path::new("/proc/thread-self");
    let before = blocked(own);
    let _dds = open(domain());
    assert_eq!(blocked(own), before);
    // SIGALRM, SIGTERM, SIGCHLD; SIGSEGV is a thread's own.
    let bits = [14, 15, 17].map(|signal| 1 << (signal - 1)).iter().sum::<u64>();
    let threads = fs::read_dir("/proc/self/task").unwrap().map(|entry| entry.unwrap().path());
    // Others may end meanwhile; those of this participant run by now, and have their names.
    let name = |thread: &PathBuf| fs::read_to_string(thread.join("comm")).unwrap_or_default();
    let library: Vec<_> = threads.filter(|thread| name(thread).starts_with("RustDDS")).collect();
    assert!(library.len() >= 2, "{library:?}");
    for thread in library {
        assert_eq!(blocked(&thread) & bits, bits, "{}", name(&thread));
        assert_eq!(blocked(&thread) & 1 << 10, 0, "{}", name(&thread));
    }
}

/// Keeps each sample until it is told to give it back.
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
    fn deliver(&self, _: &SampleMeta, _: &[u8]) -> Verdict {
        self.has.store(true, Ordering::SeqCst);
        let _ = self.release.lock().unwrap().recv();
        Verdict::Taken
    }
}

fn stuck() {
    let domain = domain();
    let mut dds = open(domain);
    let (sink, release) = Stuck::new();
    let subscription = dds.subscribe(&spec("/stuck", Qos::Auto), sink.clone()).unwrap();
    let peer = Peer::join(domain);
    let writer = peer.writer("/stuck", true, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    // As often as it takes for the other case; a writer that says nothing is no reason to be dead.
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
    fn deliver(&self, _: &SampleMeta, _: &[u8]) -> Verdict {
        panic!("this sink was meant to panic")
    }
}

fn panicking() {
    let domain = domain();
    let mut dds = open(domain);
    let kept = Kept::new();
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
        // Also if this thread panics: the other one would not end.
        let _end = Raised(&ended);
        for _ in 0..5 {
            let mut dds = open(domain);
            let sink = Kept::new();
            dds.subscribe(&spec("/stream", Qos::Auto), sink.clone()).unwrap();
            sink.wait(100);
            drop(dds);
            assert_eq!(Arc::strong_count(&sink), 1, "nobody has the sink any more");
        }
    });
}

/// Raises a flag when it is dropped.
struct Raised<'a>(&'a AtomicBool);

impl Drop for Raised<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

fn dropped_while_stuck() {
    let domain = domain();
    let mut dds = open(domain);
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
    until("the end of the thread that was left behind", || Arc::strong_count(&sink) == 1);
}

fn bad_node() {
    for node in ["", "gleaner", "/", "/a b"] {
        let error =
            Dds::open(Options { node: node.to_owned(), ..options(domain()) }).err().unwrap();
        assert_eq!(error.to_string(), format!("`{node}` is not a node's namespace and name"));
    }
}
