//! The recorder as a replay runs it, in one thread, fed at the pace of a vehicle.

use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_journal::JournalEntry;
use gleaner_lambda::manifest::{Manifest, Store};
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{Delivery, SampleMeta, Sink, TopicSpec, Transport};
use gleaner_protocol::process_stats::usage;
use gleaner_recorder::{
    LambdaSpec, Recorder, RecordingFolder as Clips, Settings, TopicId, TopicSchema,
};
use gleaner_tests::TempFolder;

use super::{FRAMES_PER_S, TYPE, Traffic, header};

const PREROLL_BYTES: u64 = 64 << 20;

/// Load that the recorder causes.
pub struct RecorderLoad {
    /// Received MB/s.
    pub megabytes_per_s: f64,
    /// CPU time, in % of the elapsed time.
    pub cpu_percent: f64,
    /// Maximum memory of the process beyond that at the start, in MiB.
    pub memory_mib: f64,
    /// Maximum size of the preroll, in % of its limit.
    pub preroll_percent: f64,
    /// Share of the time that is in a clip, in %.
    pub recorded_percent: f64,
}

struct RecorderSink {
    recorder: Arc<Mutex<Recorder>>,
    topic: TopicId,
}

impl Sink for RecorderSink {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        self.recorder
            .lock()
            .expect("one thread")
            .sample(self.topic, meta, cdr)
            .expect("the disk has room");
        Delivery::Taken
    }
}

/// Records for `seconds`, with a trigger every 15 s and windows of 5 s and 5 s.
pub fn record(seconds: u64, store: Store) -> RecorderLoad {
    let out = TempFolder::new();
    let before = usage::resident() as f64;
    let (folder, _) = Clips::open(out.path()).expect("an empty folder");
    let settings = Settings {
        store,
        preroll_bytes: PREROLL_BYTES * if store == Store::Disk { 4 } else { 1 },
        max_length: Duration::from_secs(600),
        folder: out.path().to_owned(),
        clock: "monotonic".to_owned(),
        prefault: true,
    };
    let settings_bytes = settings.preroll_bytes;
    let recorder = Arc::new(Mutex::new(Recorder::new(folder, settings).expect("a recorder")));
    let mut loopback = Loopback::new();
    let traffic = Traffic::new();
    let topics = traffic
        .topics()
        .iter()
        .map(|name| subscribe(&mut loopback, &recorder, name))
        .collect::<Vec<_>>();
    let header = header();
    let rules = Manifest::parse(MANIFEST, "lambda.toml")
        .expect("a manifest")
        .record
        .expect("with [record]");
    let lambda = {
        let mut recorder = recorder.lock().expect("one thread");
        recorder.add_lambda(LambdaSpec { header, rules, digest: "0".repeat(64), topics })
    };

    let (started, cpu) = (Instant::now(), usage::cpu_seconds());
    let (mut bytes, mut peak, mut preroll) = (0, before, 0.0_f64);
    for n in 0..seconds * FRAMES_PER_S {
        let at_ns = (n * 1_000_000_000 / FRAMES_PER_S) as i64;
        // Wait until this frame is due.
        if let Some(early) = Duration::from_nanos(at_ns as u64).checked_sub(started.elapsed()) {
            thread::sleep(early);
        }
        traffic.frame(n, at_ns, |name, meta, cdr| {
            loopback.publish(name, meta, cdr).expect("the topic exists");
            bytes += cdr.len();
        });
        let mut recorder = recorder.lock().expect("one thread");
        recorder.wake(lambda, &wake(n, at_ns + 30_000_000)).expect("the disk has room");
        // In memory the preroll is one block of that size; on disk its files are measured.
        let held = recorder.counts().preroll_highest as f64;
        drop(recorder);
        let taken = if store == Store::Disk { files(&out.path().join("preroll")) } else { held };
        preroll = preroll.max(100.0 * taken / settings_bytes as f64);
        peak = peak.max(usage::resident() as f64);
    }
    let passed = started.elapsed().as_secs_f64();
    let cpu_s = self::usage::cpu_seconds() - cpu;
    let mut recorder = recorder.lock().expect("one thread");
    recorder.finish((seconds * 1_000_000_000) as i64).expect("the disk has room");
    let recorded: i64 = recorder
        .clips()
        .iter()
        .map(|clip| clip.last_ns.unwrap_or(0) - clip.first_ns.unwrap_or(0))
        .sum();
    RecorderLoad {
        megabytes_per_s: bytes as f64 / 1e6 / passed,
        cpu_percent: 100.0 * cpu_s / passed,
        memory_mib: (peak - before) / f64::from(1 << 20),
        preroll_percent: preroll,
        recorded_percent: 100.0 * recorded as f64 / 1e9 / seconds as f64,
    }
}

const MANIFEST: &str = r#"
[lambda]
name = "load"
version = "0.1.0"
kind = "wasm"
entry = "load.wasm"
[schedule]
period = "33ms"
[record]
topics = ["/camera"]
preroll = "5s"
postroll = "5s"
"#;

fn subscribe(loopback: &mut Loopback, recorder: &Arc<Mutex<Recorder>>, name: &str) -> TopicId {
    let type_name = TYPE;
    loopback.add_topic(name, type_name, "");
    let topic = TopicSchema {
        name: name.to_owned(),
        type_name: type_name.to_owned(),
        ..TopicSchema::default()
    };
    let topic = recorder.lock().expect("one thread").add_topic(topic).expect("few topics");
    let spec = TopicSpec {
        topic: name.to_owned(),
        type_name: type_name.to_owned(),
        queue: 1,
        max_bytes: 1 << 20,
        qos: Default::default(),
    };
    loopback
        .subscribe(&spec, Arc::new(RecorderSink { recorder: recorder.clone(), topic }))
        .expect("the topic exists");
    topic
}

/// A trigger every 15 s.
fn wake(n: u64, at_ns: i64) -> JournalEntry {
    super::wake(at_ns, n % (15 * FRAMES_PER_S) == 5 * FRAMES_PER_S)
}

/// Total size of the files in a folder, in bytes.
fn files(folder: &std::path::Path) -> f64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.metadata().ok()).map(|metadata| metadata.len() as f64).sum()
}
