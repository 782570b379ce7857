//! Tests random damage, in a process of its own, because it checks the memory of its process.

use std::process::Command;

use gleaner_drives::{Replay, read_extras};
use gleaner_messages::transport::Transport;
use gleaner_test_support::drives::DiscardSink;
use gleaner_test_support::random::XorShift64;
use mcap::{Compression, WriteOptions};

use crate::support::{begun, drive, file, run, small_chunks, spec, ticking};

/// Set in the process that the test starts.
const CHILD: &str = "GLEANER_DRIVES_TEST";

/// Returns the peak of the address space of this process, in KiB, if known.
fn peak_kib() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmPeak:"))?;
    line.split_whitespace().nth(1)?.parse().ok()
}

#[test]
fn random_byte_flips_never_panic_hang_or_take_much_memory() {
    if std::env::var_os(CHILD).is_some() {
        return flip_random_bytes();
    }
    let name = "flips::random_byte_flips_never_panic_hang_or_take_much_memory";
    let mut again = Command::new(std::env::current_exe().unwrap());
    let output = again.args(["--exact", name, "--nocapture"]).env(CHILD, "1").output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && text.contains("1 passed"), "{text}");
}

fn flip_random_bytes() {
    // Without checksums, flips pass the first check.
    let unchecked = |options: WriteOptions| {
        options
            .calculate_chunk_crcs(false)
            .calculate_data_section_crc(false)
            .calculate_summary_section_crc(false)
    };
    let messages = ticking(&["/a", "/b"], 40, 1000);
    let drives: Vec<Vec<u8>> = [
        small_chunks(),
        unchecked(small_chunks()),
        unchecked(small_chunks().compression(None)),
        unchecked(small_chunks().compression(Some(Compression::Lz4))),
        unchecked(small_chunks().use_chunks(false)),
        unchecked(small_chunks().emit_summary_records(false)),
    ]
    .map(|options| drive(options, &messages))
    .into();
    let before = peak_kib();
    let mut random = XorShift64(0x9e37_79b9_7f4a_7c15);
    for case in 0..2000 {
        let mut bytes = drives[case % drives.len()].clone();
        for _ in 0..1 + random.below(4) {
            let at = random.below(bytes.len());
            bytes[at] = random.below(256) as u8;
        }
        let path = file(&bytes);
        if let Ok(mut replay) = Replay::open(std::slice::from_ref(&path)) {
            let topics: Vec<String> = replay.topics().into_iter().map(|t| t.topic).collect();
            for topic in ["/a", "/b"] {
                // A flip may have renamed the topic or its type.
                let is_there = topics.iter().any(|name| name == topic);
                if is_there && replay.definitions(topic).is_ok() {
                    let _ = replay.subscribe(&spec(topic), std::sync::Arc::new(DiscardSink));
                }
            }
            let (steps, _) = run(&mut replay);
            assert!(steps.len() <= messages.len(), "case {case}");
        }
        let _ = read_extras(&path, 1 << 20);
        std::fs::remove_file(path).unwrap();
    }
    if let (Some(before), Some(after)) = (before, peak_kib()) {
        assert!(after - before < 256 * 1024, "grew by {} MiB", (after - before) / 1024);
    }
    // The undamaged drives are still readable.
    for bytes in drives {
        let (mut replay, _) = begun(&[file(&bytes)], &["/a", "/b"]);
        assert_eq!(run(&mut replay).0.len(), messages.len());
    }
}
