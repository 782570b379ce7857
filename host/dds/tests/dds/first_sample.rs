//! The first sample of a writer, with a receive thread that gets little time.

use std::collections::HashSet;
use std::fs;
use std::hint;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use gleaner_messages::transport::{Qos, Transport};
use rustix::process::{Pid, setpriority_process};

use super::Test;
use super::peer::{KeptSamples, Peer, domain, matched, open_in, spec, write};

pub const TESTS: &[Test] =
    &[("a_sample_that_is_written_at_the_match_reaches_a_slow_receive_thread", first)];

const TOPICS: usize = 30;

fn first() {
    let domain = domain();
    let others = receive_threads();
    let mut dds = open_in(domain);
    // It gets about a sixtieth of the time of a busy thread. So RustDDS often matches the writer,
    // and receives its sample, while the receive thread still prepares the reader.
    for thread in receive_threads().difference(&others) {
        setpriority_process(Pid::from_raw(*thread), 19).unwrap();
    }
    let _busy = BusyThreads::start();
    let peer = Peer::join(domain);
    for n in 0..TOPICS {
        let topic = format!("/first_{n}");
        let sink = KeptSamples::new();
        dds.subscribe(&spec(&topic, Qos::Auto), sink.clone()).unwrap();
        let writer = peer.writer(&topic, true, false);
        matched(&writer);
        write(&writer, b"1st.");
        sink.mark(&writer, b"mark");
        assert_eq!(sink.wait(1)[0].1, b"1st.", "topic {n}");
    }
}

fn receive_threads() -> HashSet<i32> {
    let is_receiver = |path: &PathBuf| {
        fs::read_to_string(path.join("comm")).is_ok_and(|name| name == "gleaner receive\n")
    };
    let id = |path: &Path| path.file_name()?.to_str()?.parse().ok();
    let threads = fs::read_dir("/proc/self/task").unwrap().map(|entry| entry.unwrap().path());
    threads.filter(is_receiver).filter_map(|path| id(&path)).collect()
}

/// Threads that keep all cores busy until this is dropped.
struct BusyThreads;

static BUSY: AtomicBool = AtomicBool::new(false);

impl BusyThreads {
    fn start() -> Self {
        BUSY.store(true, Ordering::Relaxed);
        for _ in 0..thread::available_parallelism().map_or(1, usize::from) {
            thread::spawn(|| {
                while BUSY.load(Ordering::Relaxed) {
                    hint::spin_loop();
                }
            });
        }
        Self
    }
}

impl Drop for BusyThreads {
    fn drop(&mut self) {
        BUSY.store(false, Ordering::Relaxed);
    }
}
