//! Results that tests write.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use tempfile::TempDir;

/// A result folder, removed when the test ends.
pub(crate) struct Out(TempDir);

pub(crate) const START_NS: i64 = 1_700_000_000_000_000_000;

impl Out {
    /// Creates results without decisions.
    pub(crate) fn new() -> Out {
        let out = Out(tempfile::Builder::new().prefix("gleaner-report-").tempdir().unwrap());
        out.write("summary.json", summary().to_string());
        out.write("decisions.jsonl", "");
        out.write("log.jsonl", "");
        out
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }

    pub(crate) fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        let path = self.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, content).unwrap();
    }

    pub(crate) fn decisions(&self, decisions: &[Value]) {
        self.write(
            "decisions.jsonl",
            decisions.iter().map(|decision| format!("{decision}\n")).collect::<String>(),
        );
    }
}

/// Returns the summary of a replay over 40 s.
pub(crate) fn summary() -> Value {
    json!({
        "lambda": "hello", "version": "0.1.0", "kind": "wasm", "drive": ["a.mcap"], "out": "out", "wakes": 400, "triggers": 2, "faults": 1,
        "skipped": 0, "missed_ticks": 0, "out_of_order": 0, "log_lines": 1, "log_dropped": 0, "triggers_refused": 0, "backed_off": 0,
        "start_ns": START_NS, "end_ns": START_NS + 40_000_000_000_i64, "wall_s": 0.5, "run_s": 0.25, "decode_s": 0.0, "wakes_per_s": 800.0,
        "peak_rss_bytes": 1 << 20, "clips": 0, "clips_replaced": 0, "in_cooldown": 0, "ignored": 0, "damaged": null,
        "topics": [{
            "name": "imu", "topic": "/imu", "type_name": "sensor_msgs/msg/Imu", "received": 400, "lost": null, "overwritten": 3, "no_slot": 0,
            "too_big": 0,
        }],
    })
}

pub(crate) fn wake(ms: i64, triggers: Value, fault: Value) -> Value {
    json!({
        "at_ns": START_NS + ms * 1_000_000, "cause": "event", "input": "imu", "topic": "/imu", "writer": null, "seq": ms, "triggers": triggers,
        "fault": fault, "fuel": 100, "run_ns": 2000,
    })
}

pub(crate) fn trigger(label: &str, score: f64) -> Value {
    json!({"kind": "event", "label": label, "score": score, "attributes": {"mps2": -1.5, "serial": 9_007_199_254_740_993_i64}})
}
