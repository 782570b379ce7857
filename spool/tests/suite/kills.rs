//! A process that appends is killed again and again. It reports what is acknowledged on its
//! standard error.

use std::io::{BufRead, BufReader, Write};
use std::ops::Range;
use std::path::Path;
use std::process::{Command, Stdio};

use gleaner_base::ByteSize;
use gleaner_spool::{SpoolItem, SpoolReader, SpoolWriter};
use gleaner_test_support::simulated_disk::SpoolRandom;

use crate::model::{KIND, STREAM, TIME, config, times};

const FOLDER: &str = "GLEANER_SPOOL_OF_A_CHILD";

fn payload(seq: u64) -> Vec<u8> {
    vec![seq as u8; (seq * 37 % 300) as usize]
}

/// The child: appends until it is killed.
#[test]
fn child() {
    let Some(folder) = std::env::var_os(FOLDER) else { return };
    let mut writer = SpoolWriter::open(Path::new(&folder), config(ByteSize::gib(1))).unwrap();
    report(writer.status().next);
    loop {
        for _ in 0..=writer.status().next % 9 {
            let seq = writer.status().next;
            assert_eq!(writer.append(KIND, TIME, &payload(seq)).unwrap(), seq);
        }
        report(writer.commit().unwrap());
    }
}

fn report(number: u64) {
    std::io::stderr().write_all(format!("{number}\n").as_bytes()).unwrap();
}

#[test]
fn nothing_acknowledged_is_lost_by_kills() {
    let kills = times("GLEANER_KILLS", 20);
    let scratch = tempfile::tempdir().unwrap();
    let mut random = SpoolRandom(11);
    // The acknowledged numbers of each life.
    let mut lives: Vec<Range<u64>> = Vec::new();
    for _ in 0..kills {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "kills::child", "--nocapture"])
            .env(FOLDER, scratch.path())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let mut next = || -> u64 {
            let line = lines.next().expect("the child reports").unwrap();
            line.parse().unwrap_or_else(|_| panic!("{line}"))
        };
        let start = next();
        assert!(start >= lives.last().map_or(0, |life| life.end), "the numbers continue");
        let reported = (0..=random.below(20)).map(|_| next()).last().unwrap();
        // It is killed in the middle of anything.
        (0..random.below(200_000)).for_each(|_| std::hint::spin_loop());
        child.kill().unwrap();
        child.wait().unwrap();
        let late = lines.map_while(Result::ok).filter_map(|line| line.parse().ok());
        lives.push(start..late.fold(reported, u64::max));
        let before = lives.len().saturating_sub(2);
        check(scratch.path(), &lives, lives[before].start);
    }
    check(scratch.path(), &lives, 0);
    let acknowledged: u64 = lives.iter().map(|life| life.end - life.start).sum();
    println!("{acknowledged} records acknowledged in {kills} lives");
}

fn check(folder: &Path, lives: &[Range<u64>], from: u64) {
    let mut next = from;
    for item in SpoolReader::open(folder, STREAM, Some(from)).unwrap() {
        match item.unwrap() {
            SpoolItem::Record(record) => {
                assert_eq!((record.seq, record.payload), (next, payload(next)));
                next += 1;
            }
            // A commit was interrupted.
            SpoolItem::Gap(gap) => {
                let acknowledged =
                    lives.iter().find(|life| gap.from < life.end && gap.to >= life.start);
                assert_eq!(acknowledged, None, "{gap:?}");
                next = gap.record.expect("a gap record") + 1;
            }
            SpoolItem::Torn(_) => {}
        }
    }
    let durable = lives.last().map_or(0, |life| life.end);
    assert!(next >= durable, "record {next} is lost, {durable} were acknowledged");
}
