//! The whole program, in this process: its socket, its threads, its files.

use std::fs::{self, File};
use std::io::{BufRead, BufReader, PipeReader};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::hex;
use gleaner_journal::{FileDigest, Header};
use gleaner_lambda::manifest::Limits;
use gleaner_protocol::link::{Add, Control, RecorderLink, RecorderReport, RecorderStatus, Said};
use gleaner_recorder::program::{Options, run};
use gleaner_tests::Folder;
use gleaner_transport::loopback::Loopback;
use gleaner_transport::{Clock, LiveSource};
use sha2::{Digest, Sha256};

use super::{FRAMES_PER_S, TYPE, Traffic, header, wake};

/// Time between two wakes.
const WAKE: Duration = Duration::from_millis(10);
/// Wakes between two triggers of a burst, triggers of a burst, and wakes from one burst to the
/// next: each finds the clip of the one before finished, and a full preroll to walk through.
const APART: u64 = 10;
const BURST: u64 = 10;
const AGAIN: u64 = 400;
/// Wakes before the first one.
const FIRST: u64 = 150;
/// How often the lambda's process sends what waits, in wakes.
const POLL: u64 = 5;
const PATIENCE: Duration = Duration::from_secs(30);

/// How the program kept up.
pub struct Live {
    /// From a decision with a trigger to the opening of its window, in ms, sorted.
    pub opened_ms: Vec<f64>,
    /// Longest time in which a sample was taken, in ms.
    pub longest_ms: f64,
    /// Time that it took to tell of a wake without a trigger, in us, sorted.
    pub told_us: Vec<f64>,
    /// Samples that were lost.
    pub lost: u64,
}

/// Records for `seconds`, with bursts of triggers. On all cores: a vehicle has several, and here
/// are sender and receiver in one.
pub fn record_live(seconds: u64) -> Live {
    let measured = thread::spawn(move || {
        let mut all = rustix::thread::CpuSet::new();
        (0..rustix::thread::CpuSet::MAX_CPU).for_each(|core| all.set(core));
        // If not, figures are of one core, and worse.
        let _ = rustix::thread::sched_setaffinity(None, &all);
        on_these_cores(seconds)
    });
    measured.join().expect("nothing fails")
}

fn on_these_cores(seconds: u64) -> Live {
    let (out, network, clock, traffic) =
        (Folder::new(), Loopback::new(), Clock::of_today(), Traffic::new());
    for name in traffic.topics() {
        network.add_topic(name, TYPE, "");
    }
    let (folder, header) = lambda(out.path(), &traffic);
    let options = Options {
        out: out.path().to_owned(),
        clock,
        preroll_bytes: None,
        disk_floor: 0,
        clips_max: Some(2),
        bytes_max: None,
        commands: None,
    };
    let (mut control, stdin) = Control::pair().expect("a socket");
    let (reports, to) = std::io::pipe().expect("a pipe");
    let feed = network.clone();
    let program = thread::spawn(move || {
        let feed = || Ok(Box::new(feed) as Box<dyn LiveSource>);
        run(options, feed, stdin, File::from(OwnedFd::from(to)), Arc::default())
            .expect("nothing fails");
    });
    let reports = thread::spawn(move || last(reports));
    let socket = control
        .add(&Add { lambda: folder, remaps: Vec::new(), most: Limits::MOST })
        .expect("it is there");
    let mut link = RecorderLink::new(socket);
    link.hello(&header, PATIENCE).expect("it is the lambda that was announced");
    let stop = Arc::<AtomicBool>::default();
    let sensors = thread::spawn({
        let (network, stop) = (network.clone(), Arc::clone(&stop));
        move || publish(&network, &traffic, clock, &stop)
    });
    let (opened_ms, told_us) = decide(&mut link, clock, seconds);
    stop.store(true, Ordering::Relaxed);
    let longest_ms = sensors.join().expect("nothing fails");
    link.bye(PATIENCE);
    control.stop().expect("it is there");
    program.join().expect("nothing fails");
    let last = reports.join().expect("nothing fails").expect("the program says how it ended");
    let lost = last.topics.iter().map(|topic| topic.no_slot + topic.too_big).sum::<u64>()
        + last.recording.evicted_early;
    Live { opened_ms, longest_ms, told_us, lost }
}

/// The lambda: wakes, some of which trigger.
fn decide(link: &mut RecorderLink, clock: Clock, seconds: u64) -> (Vec<f64>, Vec<f64>) {
    let (mut opened, mut told) = (Vec::new(), Vec::new());
    let started = Instant::now();
    let mut listen = |link: &mut RecorderLink| {
        for said in link.poll().expect("the program runs") {
            if let Said::Opened { wait_ns } = said {
                opened.push(wait_ns as f64 / 1e6);
            }
        }
        opened.len() as u64
    };
    let mut triggers = 0;
    for n in 0..seconds * 1000 / WAKE.as_millis() as u64 {
        if let Some(early) = (WAKE * n as u32).checked_sub(started.elapsed()) {
            thread::sleep(early);
        }
        let in_burst =
            n.checked_sub(FIRST).map(|n| n % AGAIN).filter(|n| n % APART == 0 && n / APART < BURST);
        let at_ns = clock.now();
        let entry = wake(at_ns, in_burst.is_some());
        let before = Instant::now();
        link.wake(&entry, clock.monotonic(clock.now())).expect("the program runs");
        match in_burst {
            Some(_) => triggers += 1,
            None => told.push(before.elapsed().as_secs_f64() * 1e6),
        }
        if n % POLL == 0 {
            listen(link);
        }
    }
    let until = Instant::now() + PATIENCE;
    while listen(link) < triggers && Instant::now() < until {
        thread::sleep(WAKE);
    }
    opened.sort_by(f64::total_cmp);
    told.sort_by(f64::total_cmp);
    (opened, told)
}

/// The sensors, until they are to stop. Returns the longest time in which a sample was taken, in
/// ms.
fn publish(network: &Loopback, traffic: &Traffic, clock: Clock, stop: &AtomicBool) -> f64 {
    let (started, mut longest) = (Instant::now(), Duration::ZERO);
    for n in 0.. {
        if stop.load(Ordering::Relaxed) {
            break;
        }
        let due = Duration::from_nanos(n * 1_000_000_000 / FRAMES_PER_S);
        if let Some(early) = due.checked_sub(started.elapsed()) {
            thread::sleep(early);
        }
        traffic.frame(n, clock.now(), |name, meta, cdr| {
            let taken = Instant::now();
            network.publish(name, meta, cdr).expect("the topic is there");
            longest = longest.max(taken.elapsed());
        });
    }
    longest.as_secs_f64() * 1e3
}

/// The last thing that the program says.
fn last(reports: PipeReader) -> Option<RecorderStatus> {
    BufReader::new(reports).lines().map_while(Result::ok).find_map(
        |line| match serde_json::from_str(&line) {
            Ok(RecorderReport::Ended(last)) => Some(*last),
            _ => None,
        },
    )
}

/// A build that the program can be told of.
fn lambda(out: &Path, traffic: &Traffic) -> (PathBuf, Header) {
    let manifest = format!(
        "[lambda]\nname = \"load\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"load.wasm\"\n[schedule]\nperiod = \"10ms\"\n\
         [record]\ntopics = {:?}\npreroll = \"1s\"\npostroll = \"200ms\"\npreroll_size = \"96 MiB\"\n",
        traffic.topics()
    );
    let folder = out.join("load");
    fs::create_dir_all(folder.join("build")).expect("a folder of its own");
    fs::write(folder.join("build/lambda.toml"), &manifest).expect("a folder of its own");
    let sha256 = hex(&Sha256::digest(&manifest));
    let file = FileDigest { path: "lambda.toml".to_owned(), bytes: manifest.len() as u64, sha256 };
    (folder, Header { files: vec![file], ..header() })
}
