//! The recorder as a replay has it: one thread, which writes as well. Fed at the pace of a vehicle.

use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_journal::Entry;
use gleaner_lambda::manifest::{Manifest, Store};
use gleaner_recorder::{Folder as Clips, Member, Recorder, Settings, Topic, TopicId};
use gleaner_tests::Folder;
use gleaner_transport::loopback::Loopback;
use gleaner_transport::{SampleMeta, Sink, TopicSpec, Transport, Verdict};
use gleaner_vitals::usage;

use super::{FRAMES_PER_S, TYPE, Traffic, header};

const PREROLL_BYTES: u64 = 64 << 20;

/// What a vehicle would feel of a recorder.
pub struct Load {
    /// MB/s that arrived.
    pub megabytes_per_s: f64,
    /// Time on a core, in % of the time that passed.
    pub cpu_percent: f64,
    /// Memory of the process beyond what it had before, in MiB, at most.
    pub memory_mib: f64,
    /// The most that the preroll took, in % of its bound.
    pub preroll_percent: f64,
    /// Part of the time that is in a clip, in %.
    pub recorded_percent: f64,
}

struct Lane {
    recorder: Arc<Mutex<Recorder>>,
    topic: TopicId,
}

impl Sink for Lane {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Verdict {
        self.recorder
            .lock()
            .expect("one thread")
            .sample(self.topic, meta, cdr)
            .expect("the disk has room");
        Verdict::Taken
    }
}

/// Records for `seconds`, with a trigger every 15 s and windows of 5 s and 5 s.
pub fn record(seconds: u64, store: Store) -> Load {
    let out = Folder::new();
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
        recorder.add_lambda(Member { header, rules, digest: "0".repeat(64), topics })
    };

    let (started, cpu) = (Instant::now(), usage::cpu_seconds());
    let (mut bytes, mut peak, mut preroll) = (0, before, 0.0_f64);
    for n in 0..seconds * FRAMES_PER_S {
        let at_ns = (n * 1_000_000_000 / FRAMES_PER_S) as i64;
        // Until the moment of this frame.
        if let Some(early) = Duration::from_nanos(at_ns as u64).checked_sub(started.elapsed()) {
            thread::sleep(early);
        }
        traffic.frame(n, at_ns, |name, meta, cdr| {
            loopback.publish(name, meta, cdr).expect("the topic is there");
            bytes += cdr.len();
        });
        let mut recorder = recorder.lock().expect("one thread");
        recorder.wake(lambda, &wake(n, at_ns + 30_000_000)).expect("the disk has room");
        // In memory it is one block of that size; on disk the system tells.
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
    Load {
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
    let topic = Topic {
        name: name.to_owned(),
        type_name: type_name.to_owned(),
        definitions: None,
        offered_qos: None,
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
        .subscribe(&spec, Arc::new(Lane { recorder: recorder.clone(), topic }))
        .expect("the topic is there");
    topic
}

/// A trigger every 15 s.
fn wake(n: u64, at_ns: i64) -> Entry {
    super::wake(at_ns, n % (15 * FRAMES_PER_S) == 5 * FRAMES_PER_S)
}

/// Bytes of all files in a folder.
fn files(folder: &std::path::Path) -> f64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.metadata().ok()).map(|metadata| metadata.len() as f64).sum()
}
