//! The program `gleaner-ingress` over the sample drive, with readers in this process.

use std::collections::HashSet;
use std::io::{BufRead, BufReader};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};

use gleaner_messages::transport::StoredMeta;
use gleaner_protocol::Handover;
use gleaner_protocol::ingress::{
    AddReader, IngressControl, IngressReport, IngressStatus, PinGrant, TopicGrant,
};
use gleaner_samples::Feed;

use crate::support::{TIMEOUT, grant};

/// The sample drive, and its messages on `/imu/data`.
const DRIVE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/data/highway_drive.mcap");
const IMU: u64 = 4170;

/// A started program; killed when it is dropped.
struct Program {
    child: Child,
    control: Option<IngressControl>,
    _handover: UnixStream,
    reports: Receiver<IngressReport>,
}

impl Program {
    fn start(args: &[&str]) -> Self {
        let (handover, stdin) = UnixStream::pair().unwrap();
        let (control, ingress_end) = IngressControl::pair().unwrap();
        let connections = Handover { control: Some(ingress_end), ..Handover::default() };
        connections.send(&handover).unwrap();
        drop(connections);
        let mut child = Command::new(env!("CARGO_BIN_EXE_gleaner-ingress"))
            .args(args)
            .stdin(OwnedFd::from(stdin))
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, reports) = channel();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                let report = serde_json::from_str(&line).unwrap();
                if sender.send(report).is_err() {
                    return;
                }
            }
        });
        Self { child, control: Some(control), _handover: handover, reports }
    }

    fn reader(&mut self, name: &str, topics: Vec<TopicGrant>) -> Feed {
        let add = AddReader { name: name.to_owned(), topics, publishes: Vec::new() };
        Feed::connect(self.control.as_mut().unwrap().add_reader(&add).unwrap()).unwrap()
    }

    fn report<T>(&self, mut find: impl FnMut(IngressReport) -> Option<T>) -> T {
        loop {
            if let Some(found) = find(self.reports.recv_timeout(TIMEOUT).expect("a report")) {
                return found;
            }
        }
    }

    fn ended(&mut self) -> (ExitStatus, IngressStatus) {
        let last = self.report(|report| match report {
            IngressReport::Ended(status) => Some(*status),
            _ => None,
        });
        (self.child.wait().unwrap(), last)
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn imu(id: u32, depth: u32) -> TopicGrant {
    TopicGrant {
        type_name: Some("sensor_msgs/msg/Imu".to_owned()),
        queue: 100,
        max_bytes: Some(4096),
        depth,
        holds: PinGrant { windows: 2, window: 16, singles: 4 },
        digests: true,
        ..grant(id, "/imu/data")
    }
}

#[test]
fn the_program_plays_the_sample_drive_to_its_readers() {
    let mut program = Program::start(&["--rate", "20", "--drive", DRIVE]);
    program.report(|report| matches!(report, IngressReport::Ready).then_some(()));
    let mut first = program.reader("first", vec![imu(0, 8192)]);
    let mut second = program.reader("second", vec![imu(3, 8192)]);
    let topics = [first.topic(0, TIMEOUT).unwrap(), second.topic(3, TIMEOUT).unwrap()];
    assert!(topics[0].info.definitions.as_deref().is_some_and(|text| text.contains("Quaternion")));
    program.control.as_mut().unwrap().begin().unwrap();
    program.report(|report| matches!(report, IngressReport::DriveEnded).then_some(()));
    for topic in &topics {
        assert_eq!(topic.reader.head(), IMU);
        let mut last_at = i64::MIN;
        let mut seen = HashSet::new();
        for position in 0..IMU {
            let sample = topic.reader.get(position).unwrap().expect("all are shown");
            let meta = StoredMeta::of_words(sample.meta()).sample;
            assert!(meta.at_ns >= last_at && seen.insert((meta.writer, meta.seq)));
            last_at = meta.at_ns;
        }
    }
    program.control.as_mut().unwrap().stop().unwrap();
    let (status, last) = program.ended();
    assert!(status.success(), "{status}");
    assert_eq!((last.readers, last.topics[0].received), (2, IMU));
    assert!(first.poll().is_err() || first.poll().is_err(), "its connection has ended");
    let held = topics[1].reader.newest_before(u64::MAX).unwrap().unwrap();
    assert!(!held.is_empty(), "the memory stays");
}

#[test]
fn the_program_ends_with_its_starter_and_at_a_signal() {
    let mut program = Program::start(&["--drive", DRIVE]);
    let mut reader = program.reader("one", vec![imu(0, 64)]);
    reader.topic(0, TIMEOUT).unwrap();
    let limits = std::fs::read_to_string(format!("/proc/{}/limits", program.child.id())).unwrap();
    let open_files = limits.lines().find(|line| line.starts_with("Max open files")).unwrap();
    let words: Vec<_> = open_files.split_whitespace().collect();
    assert_eq!(words[3], words[4], "the soft limit is raised to the maximum");
    program.control = None;
    assert!(program.ended().0.success(), "the starter has ended");
    let mut program = Program::start(&["--drive", DRIVE]);
    program.report(|report| matches!(report, IngressReport::Ready).then_some(()));
    let pid = rustix::process::Pid::from_child(&program.child);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    assert!(program.ended().0.success(), "SIGTERM");
}

#[test]
fn the_program_needs_a_starter_and_a_drive_that_exists() {
    let run = |stdin: Stdio, args: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_gleaner-ingress"))
            .args(args)
            .stdin(stdin)
            .output()
            .unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, text) = run(Stdio::null(), &[]);
    assert!(code != Some(0) && text.contains("gleaner run"), "{text}");
    let (handover, stdin) = UnixStream::pair().unwrap();
    let (_control, ingress_end) = IngressControl::pair().unwrap();
    let connections = Handover { control: Some(ingress_end), ..Handover::default() };
    connections.send(&handover).unwrap();
    let (code, text) = run(OwnedFd::from(stdin).into(), &["--drive", "/no/such/drive.mcap"]);
    assert_eq!(code, Some(2), "{text}");
    assert!(text.contains("/no/such/drive.mcap"), "{text}");
}
