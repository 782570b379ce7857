//! Tests results in a spool: order, kills of the shim, full disks, and two shims at a time.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_lambda::FaultKind;
use gleaner_protocol::{ItemLosses, SpooledRecord};
use gleaner_spool::{GapReason, SpoolGap, SpoolItem, SpoolReader, SpoolRecord};

use crate::{ITEMS, ResultsFolder, SHIM, stderr};

const STREAM: &str = "brake-dark";

/// Generous time for an event.
const PATIENCE: Duration = Duration::from_secs(60);

/// Arguments of the shim for process `start` of a lambda, before those of the script.
fn arguments(start: u32) -> [String; 2] {
    let origin = r#"{"lambda":"brake-dark","revision":"0a1b","generation":3,"start":START}"#;
    ["--origin".to_owned(), origin.replace("START", &start.to_string())]
}

fn shim(spool: &Path, start: u32, more: &[&str], script: &str) -> Command {
    let mut shim = Command::new(SHIM);
    shim.arg("--spool").arg(spool).args(arguments(start)).args(more);
    shim.args(["--", "bash", "-c", &format!("{ITEMS}{script}")]);
    shim
}

fn run(folder: &ResultsFolder, more: &[&str], script: &str) -> Output {
    shim(&folder.out(), 0, more, script).output().unwrap()
}

fn parsed(record: &SpoolRecord) -> SpooledRecord {
    SpooledRecord::parse(record.kind, &record.payload).unwrap()
}

/// All records of a spool and their numbers, and all gaps.
fn read(spool: &Path) -> (Vec<(u64, SpooledRecord)>, Vec<SpoolGap>) {
    let (mut records, mut gaps) = (Vec::new(), Vec::new());
    for item in SpoolReader::open(spool, STREAM, Some(0)).unwrap() {
        match item.unwrap() {
            SpoolItem::Record(record) => records.push((record.seq, parsed(&record))),
            SpoolItem::Gap(gap) => gaps.push(gap),
            // A commit may be in progress.
            SpoolItem::Torn(_) => {}
        }
    }
    (records, gaps)
}

/// A short form of a record, for comparisons.
fn short(record: &SpooledRecord) -> String {
    match record {
        SpooledRecord::Started(start) => format!("started {}", start.start),
        SpooledRecord::Decision(decision) => format!("decision {}", decision.at_ns),
        SpooledRecord::Log(line) => format!("log {}", line.at_ns),
        SpooledRecord::Summary(status) => format!("summary {}", status.unwritten),
        SpooledRecord::Ended(record) => format!("ended {:?}", record.code.or(record.signal)),
        SpooledRecord::Lost(losses) => format!("lost {}", losses.total()),
        SpooledRecord::Omitted(omitted) => format!("omitted {:?}", omitted.at_ns),
    }
}

fn shorts(spool: &Path) -> Vec<String> {
    read(spool).0.iter().map(|(_, record)| short(record)).collect()
}

#[test]
fn a_process_has_its_records_in_order_and_its_start_is_written_before_it_runs() {
    let folder = ResultsFolder::of("spool-order");
    let (spool, copy) = (folder.out(), folder.0.join("copy"));
    let script = format!(
        "cp -r {} {}; woken; tick 1; log 2; tick 3; last; asked",
        spool.display(),
        copy.display()
    );
    let output = run(&folder, &[], &script);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let (records, gaps) = read(&spool);
    assert!(gaps.is_empty() && records.iter().map(|(seq, _)| *seq).eq(0..6), "{records:?}");
    let expected = ["started 0", "decision 1", "log 2", "decision 3", "summary 5", "ended Some(0)"];
    assert_eq!(shorts(&spool), expected);
    assert_eq!(read(&copy).0, records[..1]);
    let (_, SpooledRecord::Started(start)) = &records[0] else { panic!() };
    assert_eq!(
        (start.lambda.as_str(), start.revision.as_str(), start.generation),
        (STREAM, "0a1b", 3)
    );
    assert!(start.pid > 0 && start.software == env!("CARGO_PKG_VERSION"));
    // The next process continues the stream.
    assert!(shim(&spool, 1, &[], "woken; log 4; asked").status().unwrap().success());
    assert_eq!(shorts(&spool)[6..], ["started 1", "log 4", "ended Some(0)"]);
}

#[test]
fn the_wake_of_a_killed_runtime_is_a_decision_before_its_end() {
    let folder = ResultsFolder::of("spool-killed");
    let output = run(&folder, &[], "woken; tick 1; kill -KILL $$");
    let (records, _) = read(&folder.out());
    let kinds: Vec<_> = records.iter().map(|(_, record)| record.kind().get()).collect();
    assert_eq!(kinds, [1, 2, 2, 5], "{}", stderr(&output));
    let (_, SpooledRecord::Decision(interrupted)) = &records[2] else { panic!() };
    assert_eq!(interrupted.fault.as_ref().unwrap().kind, FaultKind::Killed);
    assert_eq!(interrupted.topic.as_deref(), Some("/camera"));
    assert!(shorts(&folder.out()).ends_with(&["ended Some(9)".to_owned()]));
}

#[test]
fn decisions_with_a_fault_are_written_while_the_runtime_runs() {
    let folder = ResultsFolder::of("spool-urgent");
    // The script ends when it finds its decision.
    let script = format!(
        "woken; item '{{\"decision\":{{\"at_ns\":1,\"cause\":\"tick\",\"triggers\":[],\
         \"fault\":{{\"kind\":\"trap\",\"message\":\"m\"}},\"run_ns\":1}}}}'; \
         until grep -q '\"trap\"' {}/*.seg; do sleep 0.01; done; asked",
        folder.out().display()
    );
    let output = run(&folder, &[], &script);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(shorts(&folder.out()), ["started 0", "decision 1", "ended Some(0)"]);
}

#[test]
fn long_records_leave_their_size_and_invalid_items_their_count() {
    let folder = ResultsFolder::of("spool-long");
    let long =
        format!(r#"{{"log":{{"at_ns":7,"level":"info","message":"{}"}}}}"#, "x".repeat(5000));
    let script = format!("woken; item x; item '{long}'; log 8; last; asked");
    let output = run(&folder, &["--spool-budget", "65536"], &script);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let (records, _) = read(&folder.out());
    let omitted = records.iter().find_map(|(_, record)| match record {
        SpooledRecord::Omitted(omitted) => Some(omitted),
        _ => None,
    });
    let omitted = omitted.unwrap();
    assert_eq!((omitted.kind, omitted.at_ns, omitted.allowed), (3, Some(7), 2048));
    assert!(omitted.bytes > 5000);
    let losses = ItemLosses { invalid: 1, refused: 0, too_long: 1 };
    assert!(
        records.iter().any(|(_, record)| *record == SpooledRecord::Lost(losses)),
        "{records:?}"
    );
    let shorts = shorts(&folder.out());
    // Two losses of the shim, and five of the runtime.
    assert!(shorts.contains(&"log 8".to_owned()) && shorts.contains(&"summary 7".to_owned()));
}

#[test]
fn a_flood_into_the_smallest_spool_loses_only_what_the_budget_removes() {
    let folder = ResultsFolder::of("spool-small");
    let script = format!("woken; {}; last; asked", flood(1, 20_000));
    let output = run(&folder, &["--spool-budget", "65536"], &script);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let (records, gaps) = read(&folder.out());
    let shorts = shorts(&folder.out());
    assert_eq!(shorts[shorts.len() - 3..], ["log 20000", "summary 5", "ended Some(0)"]);
    assert!(gaps.iter().all(|gap| matches!(gap.reason, GapReason::Budget | GapReason::Missing)));
    assert!(records.len() > 100 && !shorts.iter().any(|record| record.starts_with("lost")));
    let bytes: u64 = fs::read_dir(folder.out())
        .unwrap()
        .map(|file| file.unwrap())
        .filter(|file| file.path().extension().is_some_and(|it| it == "seg"))
        .map(|file| file.metadata().unwrap().len())
        .sum();
    assert!(bytes <= 64 << 10, "{bytes}");
}

/// A command that sends log lines with the times `from` to `to`.
fn flood(from: u64, to: u64) -> String {
    let line = r#"{"log":{"at_ns":%.0f,"level":"info","message":"m"}}"#;
    format!("seq -f '{line}' {from} {to} > /proc/self/fd/$GLEANER_RESULTS")
}

/// A reader that keeps all records that it has seen.
struct Follower {
    reader: Option<SpoolReader>,
    seen: BTreeMap<u64, SpoolRecord>,
}

impl Follower {
    fn read(&mut self, spool: &Path) {
        if self.reader.is_none() {
            self.reader = SpoolReader::open(spool, STREAM, Some(0)).ok();
        }
        for item in self.reader.iter_mut().flatten() {
            if let SpoolItem::Record(record) = item.unwrap() {
                let before = self.seen.insert(record.seq, record);
                assert!(before.is_none(), "number {} twice", before.unwrap().seq);
            }
        }
    }
}

#[test]
fn no_record_that_was_read_is_lost_by_kills_of_the_shim() {
    let long = std::env::var("GLEANER_LONG").is_ok_and(|value| value == "1");
    let kills = std::env::var("GLEANER_KILLS")
        .map_or(if long { 400 } else { 20 }, |kills| kills.parse().unwrap());
    let folder = ResultsFolder::of("spool-kills");
    let spool = folder.out();
    let mut follower = Follower { reader: None, seen: BTreeMap::new() };
    for start in 0..kills {
        let script = format!("woken; exec {}", flood(1, 1_000_000_000));
        let mut child =
            shim(&spool, start, &["--spool-budget", "4000000000"], &script).spawn().unwrap();
        let wanted = follower.seen.len() + 50 + start as usize * 97 % 1000;
        let since = Instant::now();
        while follower.seen.len() < wanted {
            assert!(since.elapsed() < PATIENCE && child.try_wait().unwrap().is_none());
            follower.read(&spool);
        }
        child.kill().unwrap();
        child.wait().unwrap();
        follower.read(&spool);
    }
    assert!(shim(&spool, kills, &[], "woken; log 1; asked").status().unwrap().success());
    let (records, gaps) = read(&spool);
    assert!(gaps.iter().all(|gap| gap.reason == GapReason::Torn), "{gaps:?}");
    let by_seq: BTreeMap<u64, &SpooledRecord> =
        records.iter().map(|(seq, record)| (*seq, record)).collect();
    assert_eq!(by_seq.len(), records.len(), "no number twice");
    for (seq, record) in &follower.seen {
        assert_eq!(by_seq.get(seq), Some(&&parsed(record)), "record {seq}");
    }
    // Each process has its start and a first part of its lines.
    let mut expected = 0;
    let mut starts = 0;
    for (seq, record) in &records {
        match record {
            SpooledRecord::Started(start) => {
                assert_eq!(start.start, starts);
                (starts, expected) = (starts + 1, 1);
            }
            SpooledRecord::Log(line) => {
                assert_eq!(line.at_ns, expected, "record {seq}");
                expected += 1;
            }
            SpooledRecord::Ended(_) => assert_eq!(starts, kills + 1),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(starts, kills + 1);
}

/// Script for a mount namespace: the disk is a small tmpfs, whose files are copied out at the end.
const ON_A_SMALL_DISK: &str = r#"
mount -t tmpfs -o size=1m tmpfs "$1" || exit 99
disk=$1 copy=$2
shift 2
code=0
"$@" 2> "$copy/stderr" || code=$?
cp -a "$disk/spool" "$copy/spool"
exit "$code"
"#;

fn in_namespace(args: &[&OsStr]) -> Command {
    let mut unshare = Command::new("unshare");
    unshare.args(["--user", "--map-root-user", "--mount", "sh", "-c", ON_A_SMALL_DISK, "sh"]);
    unshare.args(args);
    unshare
}

#[test]
fn items_that_a_full_disk_refuses_are_counted_and_marked_and_later_ones_are_written() {
    let folder = ResultsFolder::of("spool-full");
    let (disk, copy) = (folder.0.join("disk"), folder.0.join("copy"));
    fs::create_dir(&disk).unwrap();
    fs::create_dir(&copy).unwrap();
    // The lines are more than pipe and queue hold.
    let script = format!(
        "woken; cat /dev/zero > {disk}/fill 2> /dev/null; \
         until grep -q 'are retried' {copy}/stderr; do log 0; n=$((n+1)); done; \
         {flood}; rm {disk}/fill; \
         until grep -q 'written again' {copy}/stderr; do log 0; n=$((n+1)); done; \
         log 7; echo $n > {copy}/others; asked",
        disk = disk.display(),
        copy = copy.display(),
        flood = flood(1, 5000),
    );
    let spool = disk.join("spool");
    let (shim, origin) = (OsStr::new(SHIM), arguments(0));
    let script = format!("{ITEMS}{script}");
    let mut args: Vec<&OsStr> = vec![disk.as_os_str(), copy.as_os_str(), shim];
    args.extend(["--spool".as_ref(), spool.as_os_str()]);
    args.extend(["--spool-budget", "524288"].map(OsStr::new));
    args.extend(origin.iter().map(OsStr::new));
    args.extend(["--", "bash", "-c", &script].map(OsStr::new));
    let output = in_namespace(&args).output().unwrap();
    let stderr = fs::read_to_string(copy.join("stderr")).unwrap_or_default();
    if stderr.is_empty() {
        println!("skipped: no tmpfs can be mounted here");
        return;
    }
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("No space left") && stderr.contains("free space"), "{stderr}");
    let (records, gaps) = read(&copy.join("spool"));
    assert!(gaps.iter().any(|gap| gap.reason == GapReason::DiskFull), "{gaps:?}");
    let lost = records.iter().rev().find_map(|(_, record)| match record {
        SpooledRecord::Lost(losses) => Some(losses),
        _ => None,
    });
    let others: u64 = fs::read_to_string(copy.join("others")).unwrap().trim().parse().unwrap();
    let refused = lost.unwrap().refused;
    let is_log = |record: &&(u64, SpooledRecord)| matches!(record.1, SpooledRecord::Log(_));
    let logged = records.iter().filter(is_log).count() as u64;
    let removed = gaps.iter().filter(|gap| gap.reason == GapReason::Budget);
    let removed: u64 = removed.map(|gap| gap.to - gap.from + 1).sum();
    assert!(refused > 0 && removed == 0, "{gaps:?}");
    assert_eq!(logged + refused, 5000 + others + 1);
    let shorts: Vec<_> = records.iter().map(|(_, record)| short(record)).collect();
    assert_eq!(shorts[0], "started 0");
    assert_eq!(shorts[shorts.len() - 2..], ["log 7", "ended Some(0)"]);
}

/// Starts a shim whose runtime runs until its standard input ends.
fn holder(spool: &Path) -> Child {
    let mut child = shim(spool, 0, &[], "woken; log 1; read -r line; asked")
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    let since = Instant::now();
    while !spool.exists() || !shorts(spool).contains(&"log 1".to_owned()) {
        assert!(since.elapsed() < PATIENCE && child.try_wait().unwrap().is_none());
        thread::sleep(Duration::from_millis(10));
    }
    child
}

#[test]
fn a_second_shim_waits_for_the_first_and_is_refused_if_that_does_not_end() {
    let folder = ResultsFolder::of("spool-busy");
    let mut first = holder(&folder.out());
    let started = folder.0.join("started");
    let touch = format!("touch {}", started.display());
    let output = shim(&folder.out(), 1, &[], &touch).output().unwrap();
    let stderr = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    let expected = ["cannot open the spool", "another writer uses", "end the other writer first"];
    assert!(expected.iter().all(|part| stderr.contains(part)), "{stderr}");
    assert!(stderr.contains(&folder.out().display().to_string()), "{stderr}");
    assert!(!started.exists());
    let second = shim(&folder.out(), 2, &[], "woken; log 2; asked").spawn().unwrap();
    drop(first.stdin.take());
    assert!(first.wait().unwrap().success());
    assert!(second.wait_with_output().unwrap().status.success());
    let expected = ["started 0", "log 1", "ended Some(0)", "started 2", "log 2", "ended Some(0)"];
    assert_eq!(shorts(&folder.out()), expected);
}

#[test]
fn wrong_options_and_unsafe_folders_are_errors_before_the_program_starts() {
    let folder = ResultsFolder::of("spool-wrong");
    let started = folder.0.join("started");
    let touch = format!("touch {}", started.display());
    let refused = |command: &mut Command, code: i32, parts: &[&str]| {
        let output = command.output().unwrap();
        let stderr = stderr(&output);
        assert_eq!(output.status.code(), Some(code), "{stderr}");
        assert!(parts.iter().all(|part| stderr.contains(part)), "{stderr}");
        assert!(!started.exists());
    };
    let mut no_origin = Command::new(SHIM);
    no_origin.arg("--spool").arg(folder.out()).args(["--", "sh", "-c", &touch]);
    refused(&mut no_origin, 2, &["--origin"]);
    let mut wrong = Command::new(SHIM);
    wrong.arg("--spool").arg(folder.out()).args(["--origin", r#"{"lambda":"l"}"#]);
    refused(wrong.args(["--", "sh", "-c", &touch]), 2, &["missing field"]);
    let small = &["--spool-budget", "1000"];
    refused(&mut shim(&folder.out(), 0, small, &touch), 2, &["budget", "64 KiB"]);
    let both = &["--results", "x"];
    refused(&mut shim(&folder.out(), 0, both, &touch), 2, &["cannot be used with"]);
    let link = folder.0.join("link");
    std::os::unix::fs::symlink(&folder.0, &link).unwrap();
    refused(&mut shim(&link, 0, &[], &touch), 1, &["cannot open the spool", "link", "help:"]);
}
