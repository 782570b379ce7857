//! The recorder under load: 20 MB/s on ten topics, from the loopback transport, at the pace of a
//! vehicle.
//!
//! - `inline`: as a replay runs it, in one thread.
//! - `process`: the whole program as a vehicle runs it, except for the network and the process
//!   boundary.

mod inline;
mod process;

use gleaner_bench::{Figure, quantile};
use gleaner_journal::{JournalEntry, JournalHeader};
use gleaner_lambda::manifest::Store;
use gleaner_lambda::{Trigger, TriggerKind};
use gleaner_messages::transport::{Guid, SampleMeta};

use inline::record;
use process::record_live;

const TYPE: &str = "std_msgs/msg/ByteMultiArray";
/// Bytes of a camera frame, chosen so that all topics together make 20 MB/s.
const FRAME_BYTES: usize = 652_000;
const FRAMES_PER_S: u64 = 30;
const IMU_BYTES: usize = 324;
const IMU_PER_FRAME: u64 = 10;
const STATUS_BYTES: usize = 1000;
const STATUS_TOPICS: usize = 8;

/// All figures.
pub fn figures(quick: bool) -> Vec<Figure> {
    let mut figures = Vec::new();
    for (name, store) in [("memory", Store::Ram), ("disk", Store::Disk)] {
        let load = record(if quick { 2 } else { 60 }, store);
        let mut add = |what: &str, unit, value| {
            figures.push(Figure::without_goal(
                &format!("recorder at 20 MB/s, preroll in {name}: {what}"),
                unit,
                &[value],
            ));
        };
        add("arrived", "MB/s", load.megabytes_per_s);
        add("share of time in clips", "%", load.recorded_percent);
        add("share of a core", "%", load.cpu_percent);
        // 64 MiB for a preroll in memory, and 16 MiB for a chunk of a clip and its compression.
        let bound = if store == Store::Ram { 64.0 + 16.0 } else { 16.0 };
        let memory = format!("recorder at 20 MB/s, preroll in {name}: memory");
        figures.push(Figure::at_most(&memory, "MiB", bound, &[load.memory_mib]));
        let name = format!("recorder at 20 MB/s, preroll in {name}: preroll against its limit");
        figures.push(Figure::at_most(&name, "%", 100.0, &[load.preroll_percent]));
    }

    let live = record_live(if quick { 4 } else { 60 });
    let opened_ms = |share| quantile(&live.opened_ms, share);
    figures.push(Figure::without_goal(
        "trigger to window open, at 20 MB/s: p50",
        "ms",
        &[opened_ms(0.5)],
    ));
    figures.push(Figure::at_most(
        "trigger to window open, at 20 MB/s: p99",
        "ms",
        1.0,
        &[opened_ms(0.99)],
    ));
    figures.push(Figure::without_goal(
        "trigger to window open, at 20 MB/s: max",
        "ms",
        &live.opened_ms[live.opened_ms.len().max(1) - 1..],
    ));
    figures.push(Figure::without_goal(
        "live recorder at 20 MB/s: max time to accept a sample",
        "ms",
        &[live.longest_ms],
    ));
    figures.push(Figure::without_goal(
        "live recorder: time to send a wake, p50",
        "us",
        &[quantile(&live.sent_us, 0.5)],
    ));
    figures.push(Figure::at_most(
        "live recorder at 20 MB/s: lost samples",
        "samples",
        0.0,
        &[live.lost as f64],
    ));
    figures
}

/// The published data: a camera, an IMU, and eight topics with small messages.
struct Traffic {
    names: Vec<String>,
    frame: Vec<u8>,
    status: Vec<u8>,
}

impl Traffic {
    fn new() -> Traffic {
        let status = (0..STATUS_TOPICS).map(|n| format!("/status_{n}"));
        let names = ["/camera".to_owned(), "/imu".to_owned()].into_iter().chain(status).collect();
        // Incompressible, like a JPEG.
        let mut noise = 0x2545_f491_4f6c_dd1d_u64;
        let noise = std::iter::repeat_with(|| {
            noise ^= noise << 13;
            noise ^= noise >> 7;
            noise ^= noise << 17;
            noise as u8
        });
        Traffic { names, frame: noise.take(FRAME_BYTES).collect(), status: vec![7; STATUS_BYTES] }
    }

    fn topics(&self) -> &[String] {
        &self.names
    }

    /// Publishes frame `n` at `at_ns`, and the messages up to the next frame.
    fn frame(&self, n: u64, at_ns: i64, mut publish: impl FnMut(&str, &SampleMeta, &[u8])) {
        let mut publish = |name: &str, at_ns: i64, seq: u64, cdr: &[u8]| {
            publish(name, &SampleMeta::new(at_ns, Guid::default(), seq), cdr);
        };
        publish("/camera", at_ns, n + 1, &self.frame);
        for i in 0..IMU_PER_FRAME {
            publish(
                "/imu",
                at_ns + i as i64 * 3_000_000,
                n * IMU_PER_FRAME + i + 1,
                &self.frame[..IMU_BYTES],
            );
        }
        for name in &self.names[2..] {
            publish(name, at_ns + 30_000_000, n + 1, &self.status);
        }
    }
}

fn header() -> JournalHeader {
    JournalHeader {
        gleaner: env!("CARGO_PKG_VERSION").to_owned(),
        engine: "none".to_owned(),
        machine: std::env::consts::ARCH.to_owned(),
        lambda: "load".to_owned(),
        version: "0.1.0".to_owned(),
        clock: "monotonic".to_owned(),
        ..JournalHeader::default()
    }
}

fn wake(at_ns: i64, triggers: bool) -> JournalEntry {
    let trigger = Trigger {
        kind: TriggerKind::Event,
        label: "load".to_owned(),
        score: None,
        attributes: serde_json::Map::new(),
    };
    JournalEntry {
        at_ns,
        triggers: if triggers { vec![trigger] } else { Vec::new() },
        fuel: Some(1000),
        ..JournalEntry::default()
    }
}
