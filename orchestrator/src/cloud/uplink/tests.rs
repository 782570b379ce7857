//! A vehicle comes back after seven days, or after a power cut: what its spools have arrives once,
//! in order, and what they lost is named.

use std::io;
use std::num::NonZeroU8;
use std::path::PathBuf;
use std::sync::mpsc;

use gleaner_base::ByteSize;
use gleaner_fleet::decompress;
use gleaner_lambda::{LogLevel, LogLine};
use gleaner_protocol::SpooledRecord;
use gleaner_protocol::vehicle_api::StreamLine;
use gleaner_spool::{BUDGET_MIN, BootId, SegmentFile, SpoolConfig, SpoolTime, SpoolWriter};
use gleaner_test_support::simulated_disk::{DiskFault, SimulatedDisk};
use serde_json::Value;
use tempfile::TempDir;
use tokio::sync::mpsc::{Receiver as FrameReceiver, channel};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use super::*;
use crate::cloud::LinkState;
use crate::durable::DurableFile;
use crate::spools::STREAMS;

mod full_disk;

const DAY_NS: u64 = 86_400_000_000_000;
/// The first day, in ns since 1970.
const BEGIN_NS: i64 = 1_800_000_000_000_000_000;
const STREAMS_HERE: [&str; 4] = ["events", "lambdas/brake", "lambdas/moved", "orchestrator"];
const DEADLINE: Duration = Duration::from_secs(60);

/// The spools of a vehicle, one writer each, and all records that were durable in them.
struct Spools {
    folder: TempDir,
    writers: BTreeMap<&'static str, SpoolWriter>,
    durable: BTreeMap<&'static str, Vec<(u64, String)>>,
}

/// The records of a vehicle in the cloud, which stores them by the rules of the real one.
#[derive(Default)]
struct StoredRecords {
    cursors: BTreeMap<String, Cursor>,
    /// The lines of each stream as they came, with their lives.
    lines: BTreeMap<String, Vec<(u64, StreamLine)>>,
}

/// A connection of a vehicle, as its cloud and its users see it.
struct OpenUplink {
    frames: FrameReceiver<Body>,
    orders: mpsc::SyncSender<UplinkOrder>,
    sent: JoinHandle<()>,
    view: Cloud,
}

#[derive(Clone, Copy)]
enum LinkCut {
    /// Not before everything is stored.
    Never,
    /// With the batch after so many, before it is stored.
    Before(usize),
    /// With the batch after so many, before it is acknowledged.
    Unacknowledged(usize),
}

impl Spools {
    fn new() -> Self {
        let folder = TempDir::new().unwrap();
        std::fs::create_dir(folder.path().join("lambdas")).unwrap();
        Self { folder, writers: BTreeMap::new(), durable: BTreeMap::new() }
    }

    fn path(&self, stream: &str) -> PathBuf {
        self.folder.path().join(stream)
    }

    /// Starts the machine: the boot of this number. A queue that was not committed is lost.
    fn boot(&mut self, number: u8) {
        self.writers.clear();
        for stream in STREAMS_HERE {
            let budget = if stream == "lambdas/brake" { BUDGET_MIN } else { ByteSize::mib(4) };
            let (boot, of) = (BootId([number; 16]), last_part(stream).to_owned());
            let config = SpoolConfig { stream: of, boot, budget };
            self.writers.insert(stream, SpoolWriter::open(&self.path(stream), config).unwrap());
        }
    }

    /// Appends records of a day, `group` of them before each commit.
    fn add(&mut self, stream: &'static str, day: u64, count: u64, group: u64) {
        let writer = self.writers.get_mut(stream).unwrap();
        let mut waiting = Vec::new();
        for number in 0..count {
            let since_boot_ns = DAY_NS / count * number;
            let wall_ns = BEGIN_NS + (day * DAY_NS + since_boot_ns).cast_signed();
            let text = format!("record {number} of {stream} on day {day}");
            let (kind, payload) = record(stream, &text);
            match writer.append(kind, SpoolTime { since_boot_ns, wall_ns }, &payload) {
                Ok(seq) => waiting.push((seq, text)),
                Err(error) => assert!(matches!(error, SpoolError::Refused { .. }), "{error}"),
            }
            if number % group == group - 1 || number + 1 == count {
                writer.commit().unwrap();
                self.durable.entry(stream).or_default().append(&mut waiting);
            }
        }
    }

    fn newest_segment(&self, stream: &str) -> PathBuf {
        let files = std::fs::read_dir(self.path(stream)).unwrap().map(|it| it.unwrap().path());
        files.filter(|it| it.extension().is_some_and(|it| it == "seg")).max().unwrap()
    }

    /// Interrupts a commit by a kill.
    fn tear(&mut self, stream: &str) {
        self.writers.remove(stream);
        let newest = self.newest_segment(stream);
        let mut segment = std::fs::File::options().append(true).open(newest).unwrap();
        std::io::Write::write_all(&mut segment, &[1; 100]).unwrap();
    }

    /// Removes a stream with all of its records, as a disk that is replaced.
    fn lose(&mut self, stream: &'static str) {
        self.writers.remove(stream);
        self.durable.remove(stream);
        std::fs::remove_dir_all(self.path(stream)).unwrap();
    }

    /// Returns the lines of a stream that are sent, from a number on.
    fn lines(&self, stream: &str, from: Option<u64>) -> Vec<StreamLine> {
        let of = last_part(stream);
        let reader = SpoolReader::open(&self.path(stream), of, from).unwrap();
        // As they arrive: JSON has no order of keys.
        let parse = |line| serde_json::from_slice(&serde_json::to_vec(&line).unwrap()).unwrap();
        let note = |gap: &SpoolGap| gap.reason == GapReason::Budget && gap.record.is_some();
        let is_sent = |item: &_| !matches!(item, Ok(SpoolItem::Gap(gap)) if note(gap));
        reader.filter(is_sent).map(|item| parse(line(of, item))).collect()
    }

    /// Opens a connection to a cloud that has `cursors`.
    fn open(&self, cursors: BTreeMap<String, Cursor>) -> OpenUplink {
        let (out, frames) = channel(4);
        let (orders, received) = mpsc::sync_channel(STREAMS_HERE.len());
        let cloud = Cloud::load(DurableFile::new(self.path("cloud.json"))).0;
        cloud.set_state(LinkState::Connected, None, None);
        let (spools, view) = (SpoolFolders(self.folder.path().to_owned()), cloud.clone());
        let uplink = Uplink::new(spools, cloud, cursors, out);
        let sent = tokio::task::spawn_blocking(move || uplink.run(&received));
        OpenUplink { frames, orders, sent, view }
    }

    /// Sends to a cloud over one connection.
    async fn connect(&self, cloud: &mut StoredRecords, end: LinkCut) {
        let OpenUplink { mut frames, orders, sent, .. } = self.open(cloud.cursors.clone());
        let mut batches = 0;
        while !self.are_in(cloud) {
            let batch = batch(&mut frames).await;
            if matches!(end, LinkCut::Before(most) if most == batches) {
                break;
            }
            let ack = cloud.store(&batch);
            if matches!(end, LinkCut::Unacknowledged(most) if most == batches) {
                break;
            }
            orders.send(UplinkOrder::Ack(ack)).unwrap();
            batches += 1;
        }
        assert_eq!(matches!(end, LinkCut::Never), self.are_in(cloud), "{batches} batches");
        drop((frames, orders));
        sent.await.unwrap();
    }

    fn are_in(&self, cloud: &StoredRecords) -> bool {
        let has = |stream: &&str| {
            let cursor = cloud.cursors.get(*stream);
            cursor.is_some_and(|it| self.lines(stream, Some(it.next)).is_empty())
        };
        self.writers.keys().all(has)
    }
}

impl StoredRecords {
    fn store(&mut self, batch: &Records) -> Ack {
        let Records { stream, life, next, lines } = batch;
        let new = Cursor { stream: stream.clone(), life: *life, ..Cursor::default() };
        let cursor = self.cursors.entry(stream.clone()).or_insert(new);
        assert!(*life >= cursor.life, "life {life} of `{stream}` has ended");
        if *life > cursor.life {
            (cursor.life, cursor.next) = (*life, 0);
        }
        let before = cursor.next;
        for text in decompress(lines).unwrap().split(|byte| *byte == b'\n') {
            let Ok(line) = serde_json::from_slice::<StreamLine>(text) else {
                assert!(text.is_empty(), "no line: {text:?}");
                continue;
            };
            let is_gap = line.kind == "gap";
            if !is_gap && *next > before {
                (cursor.seq, cursor.boot_ns) = (line.seq, line.boot_ns);
                cursor.boot.clone_from(&line.boot);
            }
            // It would skip a record that it has, but none has to come again.
            assert!(is_gap || line.seq >= before, "record {} of `{stream}` came again", line.seq);
            let stored = self.lines.entry(stream.clone()).or_default();
            let missing = line.seq..=line.record["to"].as_u64().filter(|_| is_gap).unwrap_or(0);
            let has = |(it, other): &(u64, StreamLine)| {
                it == life && other.kind != "gap" && missing.contains(&other.seq)
            };
            assert!(!is_gap || !stored.iter().any(has), "it has records of {missing:?}");
            stored.push((*life, line));
        }
        cursor.next = before.max(*next);
        Ack { stream: stream.clone(), life: *life, next: cursor.next }
    }

    /// Returns the lines of a life, without those before the first `from`.
    fn of_life(&self, stream: &str, life: u64, from: usize) -> Vec<StreamLine> {
        let lines = self.lines[stream].iter().skip(from).filter(|(it, _)| *it == life);
        lines.map(|(_, line)| line.clone()).collect()
    }
}

fn record(stream: &str, text: &str) -> (NonZeroU8, Vec<u8>) {
    if STREAMS.contains(&stream) {
        let event = json!({ "event": "warning", "message": text });
        return (NonZeroU8::MIN, event.to_string().into_bytes());
    }
    let line = LogLine { at_ns: 1, level: LogLevel::Info, message: text.to_owned() };
    let record = SpooledRecord::Log(line);
    (record.kind(), record.to_payload())
}

async fn batch(frames: &mut FrameReceiver<Body>) -> Records {
    match timeout(DEADLINE, frames.recv()).await.expect("a batch comes in time") {
        Some(Body::Records(records)) => records,
        other => panic!("{other:?}"),
    }
}

/// Returns the first and the last number of each gap.
fn gaps(lines: &[StreamLine]) -> Vec<(u64, u64, &str)> {
    let gaps = lines.iter().filter(|line| line.kind == "gap");
    let gaps = gaps.map(|it| (it.seq, &it.record["to"], it.record["reason"].as_str().unwrap()));
    gaps.map(|(from, to, reason)| (from, to.as_u64().unwrap(), reason)).collect()
}

#[tokio::test]
async fn after_seven_days_offline_each_record_arrives_once_in_order_and_losses_are_named() {
    let (mut vehicle, mut cloud) = (Spools::new(), StoredRecords::default());
    vehicle.boot(0);
    for stream in STREAMS_HERE {
        vehicle.add(stream, 0, 20, 20);
    }
    vehicle.connect(&mut cloud, LinkCut::Never).await;
    let before = cloud.cursors.clone();
    let lines_before: BTreeMap<_, _> =
        cloud.lines.iter().map(|(stream, lines)| (stream.clone(), lines.len())).collect();

    // From here on it is offline, and starts again each day.
    for day in 1..=7 {
        match day {
            3 => vehicle.lose("lambdas/moved"),
            4 => vehicle.tear("orchestrator"),
            _ => {}
        }
        vehicle.boot(day as u8);
        vehicle.add("events", day, 1440, 360);
        // On one day, it logs more at once than fits into the queue.
        vehicle.add("lambdas/brake", day, 200, if day == 6 { 100 } else { 25 });
        vehicle.add("lambdas/moved", day, 50, 50);
        vehicle.add("orchestrator", day, 5, 5);
    }

    vehicle.connect(&mut cloud, LinkCut::Before(0)).await;
    vehicle.connect(&mut cloud, LinkCut::Unacknowledged(1)).await;
    vehicle.connect(&mut cloud, LinkCut::Before(3)).await;
    // It is not idle meanwhile.
    vehicle.add("events", 8, 10, 10);
    vehicle.connect(&mut cloud, LinkCut::Unacknowledged(4)).await;
    assert!(!vehicle.are_in(&cloud), "there is something left for the last connection");
    vehicle.connect(&mut cloud, LinkCut::Never).await;

    for stream in STREAMS_HERE {
        let life = cloud.cursors[stream].life;
        assert_eq!(life, if stream == "lambdas/moved" { 2 } else { 1 }, "{stream}");
        let from = (life == before[stream].life).then_some(before[stream].next);
        let arrived = cloud.of_life(stream, life, lines_before[stream]);
        assert_eq!(arrived, vehicle.lines(stream, from), "{stream}");
        // Each record that was durable is there, or in a gap.
        let all = cloud.of_life(stream, life, 0);
        let gaps = gaps(&all);
        let records: Vec<_> = all.iter().filter(|line| line.kind != "gap").collect();
        assert!(records.is_sorted_by(|a, b| a.seq < b.seq), "{stream}");
        let texts: BTreeMap<_, _> = records.iter().map(|it| (it.seq, &it.record)).collect();
        let mut lost = 0;
        for (seq, text) in &vehicle.durable[stream] {
            let is_lost = gaps.iter().any(|(from, to, _)| (from..=to).contains(&seq));
            match texts.get(seq) {
                Some(record) => assert_eq!(record["message"], Value::from(text.as_str())),
                None => assert!(is_lost, "record {seq} of {stream} is missing"),
            }
            lost += u64::from(!texts.contains_key(seq));
        }
        let has = |reason| gaps.iter().any(|(.., it)| *it == reason);
        match stream {
            "lambdas/brake" => assert!(has("Budget") && has("QueueFull") && lost > 500, "{gaps:?}"),
            "orchestrator" => assert_eq!((has("Torn"), lost), (true, 0), "{gaps:?}"),
            _ => assert_eq!((gaps.len(), lost), (0, 0), "{gaps:?}"),
        }
    }
}

#[tokio::test]
async fn after_a_power_cut_on_a_disk_that_lies_the_cloud_has_each_record_once() {
    let (mut vehicle, mut cloud) = (Spools::new(), StoredRecords::default());
    vehicle.boot(0);
    for stream in STREAMS_HERE {
        vehicle.add(stream, 0, 20, 10);
    }
    let newest = vehicle.newest_segment("lambdas/moved");
    let kept = std::fs::read(&newest).unwrap();
    // Later in the same boot.
    vehicle.add("lambdas/moved", 1, 100, 50);
    vehicle.connect(&mut cloud, LinkCut::Never).await;

    // The disk reported them as written.
    std::fs::write(newest, kept).unwrap();
    vehicle.boot(1);
    vehicle.add("lambdas/moved", 2, 120, 60);
    vehicle.connect(&mut cloud, LinkCut::Never).await;
    let lines = &cloud.lines["lambdas/moved"];
    let days = |life: u64| {
        let lines = lines.iter().filter(move |(it, _)| *it == life);
        lines.map(|(_, line)| (line.seq, (line.time_ns - BEGIN_NS) / DAY_NS.cast_signed()))
    };
    let expected = (0..120_u64).map(|seq| (seq, i64::from(seq >= 20)));
    assert!(days(1).eq(expected), "{lines:?}");
    assert!(days(2).eq((20..140_u64).map(|seq| (seq, 2_i64))), "{lines:?}");
}

#[tokio::test]
async fn what_the_budget_removes_after_the_cloud_has_it_is_no_gap() {
    let (mut vehicle, mut cloud) = (Spools::new(), StoredRecords::default());
    vehicle.boot(0);
    for day in 0..12 {
        for stream in STREAMS_HERE {
            vehicle.add(stream, day, 100, 25);
        }
        vehicle.connect(&mut cloud, LinkCut::Never).await;
    }
    assert!(vehicle.lines("lambdas/brake", None)[0].seq > 0, "the budget has removed some");
    let arrived = cloud.of_life("lambdas/brake", 1, 0);
    assert!(gaps(&arrived).is_empty(), "{:?}", gaps(&arrived));
    assert!(arrived.iter().map(|line| line.seq).eq(0..1200_u64));
}

#[tokio::test]
async fn what_the_budget_removes_while_it_is_sent_is_no_gap_and_what_it_removes_before_is_one() {
    let (mut vehicle, mut cloud) = (Spools::new(), StoredRecords::default());
    vehicle.boot(0);
    vehicle.add("lambdas/brake", 0, 20, 20);
    let mut uplink = vehicle.open(BTreeMap::new());
    let first = batch(&mut uplink.frames).await;
    assert_eq!((&*first.stream, first.next), ("lambdas/brake", 20));
    vehicle.add("lambdas/brake", 1, 600, 25);
    let oldest = vehicle.lines("lambdas/brake", None)[0].seq;
    uplink.orders.send(UplinkOrder::Ack(cloud.store(&first))).unwrap();
    while !vehicle.lines("lambdas/brake", Some(cloud.cursors["lambdas/brake"].next)).is_empty() {
        let batch = batch(&mut uplink.frames).await;
        uplink.orders.send(UplinkOrder::Ack(cloud.store(&batch))).unwrap();
    }
    drop((uplink.frames, uplink.orders));
    uplink.sent.await.unwrap();
    let arrived = cloud.of_life("lambdas/brake", 1, 0);
    assert!(oldest > 20, "the budget has removed what was sent, too");
    // It may have read some before they were removed.
    let gaps = gaps(&arrived);
    assert!(matches!(gaps[..], [(20.., to, "Budget")] if to == oldest - 1), "{gaps:?}");
}

#[tokio::test]
async fn a_stream_that_cannot_be_read_is_named_until_it_is_gone() {
    let mut vehicle = Spools::new();
    vehicle.boot(0);
    vehicle.add("events", 0, 5, 5);
    let odd = vehicle.path("lambdas/odd");
    std::fs::write(&odd, "no folder").unwrap();
    let mut uplink = vehicle.open(BTreeMap::new());
    batch(&mut uplink.frames).await;
    let until = async |is_failing| {
        while uplink.view.lock().failing.is_empty() == is_failing {
            sleep(Duration::from_millis(2)).await;
        }
    };
    timeout(DEADLINE, until(true)).await.expect("it is named");
    let failing = uplink.view.lock().failing();
    assert_eq!((failing.len(), failing[0].streams), (1, 1));
    assert!(failing[0].example.starts_with("`lambdas/odd`: cannot use the spool folder"));
    std::fs::remove_file(odd).unwrap();
    timeout(DEADLINE, until(false)).await.expect("it is named until it is removed");
    let lambdas = vehicle.path("lambdas");
    std::fs::rename(&lambdas, vehicle.path("moved")).unwrap();
    std::fs::write(&lambdas, "no folder").unwrap();
    timeout(DEADLINE, until(true)).await.expect("the folder of all is named");
    drop(uplink.frames);
    uplink.sent.await.unwrap();
}

/// Writes ten records in two segments without a sync, as commits in progress. Returns their
/// stream, and their lines.
fn unsynced(disk: &SimulatedDisk) -> (SentStream<SimulatedDisk>, Vec<u8>) {
    let mut vehicle = Spools::new();
    for number in 0..2 {
        vehicle.boot(number);
        vehicle.add("lambdas/brake", 0, 5, 5);
        let segment = std::fs::read(vehicle.newest_segment("lambdas/brake")).unwrap();
        disk.add(u64::from(number) * 5).append(&segment).unwrap();
    }
    (SentStream::new(1, SpoolReader::with_storage(disk.clone(), "brake", None)), lines_on(disk))
}

/// Returns the lines of all that is on a disk, as they are sent.
fn lines_on(disk: &SimulatedDisk) -> Vec<u8> {
    let lines = SpoolReader::with_storage(disk.clone(), "brake", None)
        .map(|item| serde_json::to_string(&line("brake", item)).unwrap() + "\n");
    lines.collect::<String>().into_bytes()
}

#[test]
fn a_power_cut_takes_nothing_that_was_sent() {
    for seed in 0..50 {
        let disk = SimulatedDisk::new(seed);
        let (mut stream, all) = unsynced(&disk);
        let sent = stream.batch("lambdas/brake", true, Instant::now()).0.unwrap();
        disk.power_cut();
        assert_eq!(sent.next, 10);
        assert_eq!(decompress(&sent.lines).unwrap(), all);
        assert_eq!(lines_on(&disk), all, "seed {seed}");
    }
}

/// A stream on a disk whose operations fail; also each list and each opening of its folder is one.
struct SimulatedSpool(SimulatedDisk);

impl SpoolSource for SimulatedSpool {
    type Storage = SimulatedDisk;

    fn streams(&self) -> (Vec<String>, io::Result<()>) {
        match self.0.list() {
            Ok(_) => (vec!["lambdas/brake".to_owned()], Ok(())),
            Err(error) => (Vec::new(), Err(error)),
        }
    }

    fn open(&self, stream: &str) -> Result<SimulatedDisk, SpoolError> {
        let failed = |source| SpoolError::Folder { path: stream.into(), source };
        self.0.list().map(|_| self.0.clone()).map_err(failed)
    }
}

#[test]
fn each_operation_that_fails_once_is_in_the_status_until_all_records_are_sent_once() {
    let folder = TempDir::new().unwrap();
    for at in 1..60 {
        let disk = SimulatedDisk::new(at);
        let (_, all) = unsynced(&disk);
        let cloud = Cloud::load(DurableFile::new(folder.path().join("cloud.json"))).0;
        let (view, (out, mut frames)) = (cloud.clone(), channel(9));
        let (spools, cursors) = (SimulatedSpool(disk.clone()), BTreeMap::new());
        let mut uplink = Uplink::new(spools, cloud, cursors, out);
        let (from, kind) = (disk.operations() + at, io::ErrorKind::Other);
        disk.set_fault(Some(DiskFault { from, count: 1, kind }));
        let (mut stored, mut sent) = (StoredRecords::default(), Vec::new());
        let (mut now, mut has_failed) = (Instant::now(), false);
        for _ in 0..30 {
            assert!(uplink.look(true, now));
            has_failed |= !view.lock().failing().is_empty();
            while let Ok(Body::Records(batch)) = frames.try_recv() {
                sent.extend(decompress(&batch.lines).unwrap());
                assert!(uplink.acknowledged(&stored.store(&batch), now));
                has_failed |= !view.lock().failing().is_empty();
            }
            now += INTERVAL;
        }
        assert_eq!(sent, all, "operation {at}");
        assert!(has_failed && view.lock().failing().is_empty(), "operation {at}");
        assert_eq!(disk.released().unwrap(), 10, "operation {at}");
    }
}
