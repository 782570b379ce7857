//! Runs the whole recorder program in this process: its socket, its threads, its files.

use std::fs::{self, File};
use std::io::{BufRead, BufReader, PipeReader};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::hex;
use gleaner_ingress::Ingress;
use gleaner_journal::{FileDigest, JournalHeader};
use gleaner_lambda::manifest::Limits;
use gleaner_messages::Sources;
use gleaner_messages::transport::Clock;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_protocol::ingress::{AddReader, Qos, recorded_grant};
use gleaner_protocol::link::{
    AddLambda, ControlClient, RecorderLink, RecorderMessage, RecorderReport, RecorderStatus,
};
use gleaner_recorder::program::{RecorderConnections, RecorderOptions, run};
use gleaner_tests::TempFolder;
use sha2::{Digest, Sha256};

use super::{FRAMES_PER_S, TYPE, Traffic, header, wake};

/// Time between two wakes.
const WAKE: Duration = Duration::from_millis(10);
/// Wakes between two triggers of a burst, triggers of a burst, and wakes from one burst to the
/// next. Each burst finds the previous clip finished and a full preroll to scan.
const TRIGGER_PERIOD: u64 = 10;
const BURST: u64 = 10;
const BURST_PERIOD: u64 = 400;
/// Wakes before the first burst.
const FIRST: u64 = 150;
/// Wakes between two calls that send queued messages.
const POLL: u64 = 5;
const PATIENCE: Duration = Duration::from_secs(30);

/// Latencies and losses of the program.
pub struct RecorderLatency {
    /// Times from a decision with a trigger to the opening of its window, in ms, sorted.
    pub opened_ms: Vec<f64>,
    /// Maximum time to accept a sample, in ms.
    pub longest_ms: f64,
    /// Times to send a wake without a trigger, in us, sorted.
    pub sent_us: Vec<f64>,
    /// Number of lost samples.
    pub lost: u64,
}

/// Records for `seconds`, with bursts of triggers. Uses all cores, as a vehicle has several, and
/// sender and receiver are the same process here.
pub fn record_live(seconds: u64) -> RecorderLatency {
    let measured = thread::spawn(move || {
        let mut all = rustix::thread::CpuSet::new();
        (0..rustix::thread::CpuSet::MAX_CPU).for_each(|core| all.set(core));
        // On failure the figures are those of one core, and worse.
        let _ = rustix::thread::sched_setaffinity(None, &all);
        measure(seconds)
    });
    measured.join().expect("the thread does not panic")
}

fn measure(seconds: u64) -> RecorderLatency {
    let (out, network, clock, traffic) =
        (TempFolder::new(), Loopback::new(), Clock::from_time_of_day(), Traffic::new());
    for name in traffic.topics() {
        network.add_topic(name, TYPE, "");
    }
    let (folder, header) = lambda(out.path(), &traffic);
    let options = RecorderOptions {
        out: out.path().to_owned(),
        clock,
        messages: Sources::default(),
        preroll_bytes: None,
        disk_floor: 0,
        clips_max: Some(2),
        bytes_max: None,
        commands: None,
    };
    let (mut control, stdin) = ControlClient::pair().expect("a socket");
    let (reports, to) = std::io::pipe().expect("a pipe");
    let (mut ingress, _) = Ingress::start_in_thread(Box::new(network.clone()));
    let grants: Vec<_> = traffic.topics().iter().cloned().zip(1..).collect();
    let topics = grants
        .iter()
        .map(|(topic, id)| {
            recorded_grant(*id, topic, Some(TYPE.to_owned()), Some(1 << 20), Qos::Auto)
        })
        .collect();
    let reader = AddReader { name: "recorder".to_owned(), topics, publishes: Vec::new() };
    let samples = ingress.add_reader(&reader).expect("the ingress runs");
    let program = thread::spawn(move || {
        let connections =
            RecorderConnections { control: stdin, ingress: samples, starter: None, signer: None };
        run(options, connections, File::from(OwnedFd::from(to)), Arc::default())
            .expect("nothing fails");
    });
    let reports = thread::spawn(move || last(reports));
    let socket = control
        .add(&AddLambda { lambda: folder, remaps: Vec::new(), most: Limits::MAX, grants })
        .expect("the program runs");
    let mut link = RecorderLink::new(socket);
    link.hello(&header, PATIENCE).expect("the lambda was added");
    let stop = Arc::<AtomicBool>::default();
    let sensors = thread::spawn({
        let (network, stop) = (network.clone(), Arc::clone(&stop));
        move || publish(&network, &traffic, clock, &stop)
    });
    let (opened_ms, sent_us) = decide(&mut link, clock, seconds);
    stop.store(true, Ordering::Relaxed);
    let longest_ms = sensors.join().expect("the thread does not panic");
    link.bye(PATIENCE);
    control.stop().expect("the program runs");
    program.join().expect("the thread does not panic");
    let last = reports.join().expect("the thread does not panic").expect("a final report");
    let lost = last.topics.iter().map(|topic| topic.no_slot + topic.too_big).sum::<u64>()
        + last.recording.evicted_early;
    RecorderLatency { opened_ms, longest_ms, sent_us, lost }
}

/// Sends the wakes of the lambda, some of which trigger.
fn decide(link: &mut RecorderLink, clock: Clock, seconds: u64) -> (Vec<f64>, Vec<f64>) {
    let (mut opened, mut sent) = (Vec::new(), Vec::new());
    let started = Instant::now();
    let mut poll = |link: &mut RecorderLink| {
        for message in link.poll().expect("the program runs") {
            if let RecorderMessage::Opened { wait_ns } = message {
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
        let in_burst = n
            .checked_sub(FIRST)
            .map(|n| n % BURST_PERIOD)
            .filter(|n| n % TRIGGER_PERIOD == 0 && n / TRIGGER_PERIOD < BURST);
        let at_ns = clock.now();
        let entry = wake(at_ns, in_burst.is_some());
        let before = Instant::now();
        link.wake(&entry, clock.monotonic(clock.now())).expect("the program runs");
        match in_burst {
            Some(_) => triggers += 1,
            None => sent.push(before.elapsed().as_secs_f64() * 1e6),
        }
        if n % POLL == 0 {
            poll(link);
        }
    }
    let until = Instant::now() + PATIENCE;
    while poll(link) < triggers && Instant::now() < until {
        thread::sleep(WAKE);
    }
    opened.sort_by(f64::total_cmp);
    sent.sort_by(f64::total_cmp);
    (opened, sent)
}

/// Publishes the sensors' data until `stop` is set. Returns the maximum time to accept a sample, in
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
            network.publish(name, meta, cdr).expect("the topic exists");
            longest = longest.max(taken.elapsed());
        });
    }
    longest.as_secs_f64() * 1e3
}

fn last(reports: PipeReader) -> Option<RecorderStatus> {
    BufReader::new(reports).lines().map_while(Result::ok).find_map(
        |line| match serde_json::from_str(&line) {
            Ok(RecorderReport::Ended(last)) => Some(*last),
            _ => None,
        },
    )
}

/// Writes the build of a lambda that the program can add.
fn lambda(out: &Path, traffic: &Traffic) -> (PathBuf, JournalHeader) {
    let manifest = format!(
        "[lambda]\nname = \"load\"\nversion = \"0.1.0\"\nkind = \"wasm\"\nentry = \"load.wasm\"\n\
         [schedule]\nperiod = \"10ms\"\n[record]\ntopics = {:?}\npreroll = \"1s\"\n\
         postroll = \"200ms\"\npreroll_size = \"96 MiB\"\n",
        traffic.topics()
    );
    let folder = out.join("load");
    fs::create_dir_all(folder.join("build")).expect("a folder of its own");
    fs::write(folder.join("build/lambda.toml"), &manifest).expect("a folder of its own");
    let sha256 = hex(&Sha256::digest(&manifest));
    let file = FileDigest { path: "lambda.toml".to_owned(), bytes: manifest.len() as u64, sha256 };
    (folder, JournalHeader { files: vec![file], ..header() })
}
