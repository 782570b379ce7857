use std::sync::Arc;

use gleaner_fleet::Cursor;
use gleaner_protocol::vehicle_api::StreamLine;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::packing::{pack, remove_old};
use super::search::RecordSearch;
use super::{ChunkFiles, RecordArchive};
use crate::folder::DataFolder;
use crate::place::FilePlace;
use crate::store::tests::connected;
use crate::store::{ChunkSizes, CloudStore, Retention, StreamBatch, now};

const CAR: &str = "car-7";
const SIZES: ChunkSizes = ChunkSizes { chunk: 2000, rows: 1000 };
const STREAMS: [&str; 2] = ["events", "orchestrator"];
const BRAKE: &str = "lambdas/brake";

struct Recorded {
    folder: TempDir,
    cloud: Arc<RecordArchive>,
    epoch: u64,
}

impl Recorded {
    async fn start() -> Self {
        let folder = TempDir::new().unwrap();
        let data = DataFolder::create(&folder.path().join("data")).unwrap();
        let chunks = ChunkFiles::new(FilePlace::open(data.records(), None, "").unwrap());
        let store = Arc::new(CloudStore::of_test(&folder).await);
        let cloud = Arc::new(RecordArchive::new(&store, chunks, 30));
        let epoch = connected(&cloud.store, CAR).await;
        Self { folder, cloud, epoch }
    }

    async fn append(&self, stream: &str, seqs: std::ops::Range<u64>) {
        self.append_within(stream, seqs, Retention::DEFAULT).await;
    }

    async fn append_within(&self, stream: &str, seqs: std::ops::Range<u64>, bounds: Retention) {
        let lines = seqs.map(|seq| (seq, String::new(), line(stream, seq))).collect();
        self.append_lines(stream, lines, bounds).await;
    }

    /// Appends a record whose message has some more bytes.
    async fn append_long(&self, stream: &str, seq: u64, more: usize) {
        let line = line(stream, seq).replace("slips", &"s".repeat(more));
        self.append_lines(stream, vec![(seq, String::new(), line)], Retention::DEFAULT).await;
    }

    async fn append_lines(
        &self,
        stream: &str,
        lines: Vec<(u64, String, String)>,
        bounds: Retention,
    ) {
        let last = lines.last().unwrap().0;
        let cursor = Cursor {
            stream: stream.to_owned(),
            life: 1,
            next: last + 1,
            seq: last,
            boot: "b".to_owned(),
            boot_ns: 7,
        };
        let batch = StreamBatch { lines, cursor };
        self.cloud.store.append(CAR, self.epoch, batch, bounds).await.unwrap();
    }

    /// Returns all records of both streams, page by page.
    async fn all(&self, streams: [&str; 2]) -> Vec<String> {
        let (mut lines, mut after) = (Vec::new(), 0);
        loop {
            let page = self.cloud.record_page(CAR, streams, 0, after, 7).await.unwrap();
            if page.lines.is_empty() {
                return lines;
            }
            assert!(page.arrival > after);
            after = page.arrival;
            lines.extend(page.lines);
        }
    }

    /// Returns the numbers of what a search finds, part by part.
    async fn found(&self, search: RecordSearch) -> Vec<u64> {
        self.found_lines(search).await.iter().map(|it| it.seq).collect()
    }

    async fn found_lines(&self, mut search: RecordSearch) -> Vec<StreamLine> {
        let mut lines = Vec::new();
        loop {
            let found = self.cloud.search(&search).await.unwrap();
            assert!(found.items.iter().all(|it| it.vehicle == CAR));
            lines.extend(found.items.into_iter().map(|it| it.line));
            let Some(next) = found.next else { return lines };
            assert_ne!(search.after.as_ref(), Some(&next), "it goes on");
            search.after = Some(next);
        }
    }

    /// Returns the pages of a time line, from the newest record back.
    async fn back(&self, streams: [&str; 2], most: usize) -> Vec<String> {
        let streams = streams.map(str::to_owned);
        let (mut before, mut back) = (i64::MAX, Vec::new());
        loop {
            let newest = self.cloud.newest(CAR, &streams, (0, before), most).await.unwrap();
            back.extend(newest.lines.into_iter().map(|(_, line)| line));
            before = newest.oldest_read;
            if !newest.has_more {
                back.reverse();
                return back;
            }
        }
    }

    fn files(&self) -> Vec<std::path::PathBuf> {
        let files = self.folder.path().join("data/records").read_dir().unwrap();
        files.map(|file| file.unwrap().path()).collect()
    }

    async fn chunks(&self) -> Vec<crate::store::StoredChunk> {
        let (mut chunks, mut after) = (Vec::new(), 0);
        let of = (CAR, "events");
        while let Some(chunk) = self.cloud.store.chunk_after(of, (after, 0)).await.unwrap() {
            after = chunk.last_arrival;
            chunks.push(chunk);
        }
        chunks
    }
}

/// Returns a record of some length: each tenth one is a warning.
fn line(stream: &str, seq: u64) -> String {
    let name = crate::store::name_in_lines(stream);
    let level = if seq.is_multiple_of(10) { "warn" } else { "info" };
    let record = json!({ "at_ns": 1, "level": level, "message": format!("Wheel {seq} \"slips\"") });
    let line = StreamLine {
        stream: name.to_owned(),
        seq,
        time_ns: 1000 + i64::try_from(seq).unwrap(),
        boot_ns: seq,
        boot: "b".to_owned(),
        kind: "log".to_owned(),
        record,
    };
    serde_json::to_string(&line).unwrap()
}

fn search(query: &str) -> RecordSearch {
    let values = query.split('&').filter_map(|part| part.split_once('='));
    let values = values.map(|(key, value)| {
        let number = value.parse::<i64>().ok().filter(|_| key != "text").map(Value::from);
        (key.to_owned(), number.unwrap_or_else(|| Value::from(value)))
    });
    serde_json::from_value(Value::Object(values.collect())).unwrap()
}

mod interruptions;
mod long_records;

#[tokio::test]
async fn records_in_chunks_and_rows_are_one_sequence() {
    let recorded = Recorded::start().await;
    let cloud = &recorded.cloud;
    // Two streams by turns, of which one stays in rows for some time.
    let mut expected = Vec::new();
    for seq in 0..100 {
        recorded.append("events", seq..seq + 1).await;
        expected.push(line("events", seq));
        if seq.is_multiple_of(5) {
            recorded.append("orchestrator", seq..seq + 1).await;
            expected.push(line("orchestrator", seq));
        }
    }
    assert_eq!(recorded.all(STREAMS).await, expected);
    let count = expected.len();
    for is_packed in [false, true] {
        if is_packed {
            assert!(pack(cloud, SIZES).await.unwrap() > 5);
        }
        assert_eq!(recorded.all(STREAMS).await, expected);
        assert_eq!(recorded.all(["events"; 2]).await.len(), 100);
        // From any position on, as after a lost connection.
        for after in [1, 17, 50, 119] {
            let page = cloud.record_page(CAR, STREAMS, 0, after, 3).await.unwrap();
            assert_eq!(page.lines[0], expected[usize::try_from(after).unwrap()]);
        }
        for last in [1, 7, 40, 110] {
            let after = cloud.arrival_before(CAR, STREAMS, last).await.unwrap();
            assert_eq!(after, i64::try_from(count - last).unwrap());
        }
        assert_eq!(cloud.arrival_before(CAR, STREAMS, count).await.unwrap(), 0);
        assert_eq!(recorded.back(STREAMS, 9).await, expected);
        // Records from a number on.
        let page = cloud.record_page(CAR, ["events"; 2], 30, 0, 3).await.unwrap();
        assert_eq!(page.lines[0], line("events", 30));
    }
    recorded.append("events", 98..102).await;
    assert_eq!(recorded.all(STREAMS).await.len(), count + 2, "what comes again is stored once");
    recorded.append("events", 0..3).await;
    assert_eq!(recorded.all(STREAMS).await.len(), count + 2, "also what is in a chunk");
}

#[tokio::test]
async fn two_processes_that_pack_at_once_lose_nothing_and_leave_no_file() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..100).await;
    let expected = recorded.all(STREAMS).await;
    let cloud = &recorded.cloud;
    let (one, other) = tokio::join!(pack(cloud, SIZES), pack(cloud, SIZES));
    let made = one.unwrap() + other.unwrap();
    assert_eq!(recorded.all(STREAMS).await, expected);
    remove_old(cloud, 0).await.unwrap();
    let chunks = recorded.chunks().await;
    assert_eq!((chunks.len() as u64, recorded.files().len() as u64), (made, made));
    assert_eq!(recorded.all(STREAMS).await, expected);
}

#[tokio::test]
async fn a_chunk_that_cannot_be_used_is_a_line_and_no_gap_or_failure() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..100).await;
    pack(&recorded.cloud, SIZES).await.unwrap();
    let chunks = recorded.chunks().await;
    let folder = recorded.folder.path().join("data/records");
    std::fs::remove_file(folder.join(&chunks[0].sha256)).unwrap();
    std::fs::write(folder.join(&chunks[2].sha256), b"another").unwrap();
    let lie = "UPDATE chunks SET records = 3 WHERE sha256 = $1";
    recorded.cloud.store.execute_with(lie, &[&chunks[3].sha256]).await;
    let lines = recorded.all(STREAMS).await;
    let damaged = || lines.iter().filter(|line| line.contains("\"damaged\""));
    let lost = chunks[0].records + chunks[2].records + chunks[3].records;
    assert_eq!(lines.len() as u64, 100 - lost + 3);
    for (line, (chunk, reason)) in damaged().zip([
        (&chunks[0], "it is missing"),
        (&chunks[2], "its bytes were changed"),
        (&chunks[3], "it has other records than the index states"),
    ]) {
        assert!(line.contains(&chunk.sha256) && line.contains(reason), "{line}");
        let line: StreamLine = serde_json::from_str(line).unwrap();
        assert_eq!((line.seq, &line.record["to"]), (chunk.first_seq, &json!(chunk.last_seq)));
    }
    // Each is there once, however short the pages are.
    for most in [1, 9, 1000] {
        assert_eq!(recorded.back(STREAMS, most).await, lines, "pages of {most}");
    }
    // A search states them, too: the text may be there.
    for query in ["text=wheel 1 ", "text=wheel 1 &limit=1"] {
        let found = recorded.found_lines(search(query)).await;
        assert_eq!(found.iter().filter(|it| it.kind == "damaged").count(), 3, "{query}");
    }
}

#[tokio::test]
async fn chunks_that_are_too_many_or_too_old_are_removed_and_counted() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..100).await;
    pack(&recorded.cloud, SIZES).await.unwrap();
    let store = &recorded.cloud.store;
    let removed = async || {
        let gap = store.removed(CAR, STREAMS, 0).await.unwrap().remove(0);
        let gap: StreamLine = serde_json::from_str(&gap).unwrap();
        let left: StreamLine = serde_json::from_str(&recorded.all(STREAMS).await[0]).unwrap();
        let (to, count) = (gap.record["to"].as_u64(), gap.record["records"].as_u64().unwrap());
        assert_eq!((to, left.seq), (Some(count - 1), count), "nothing is missing silently");
        count
    };
    let few = Retention { records: 60, ..Retention::DEFAULT };
    recorded.append_within("events", 100..101, few).await;
    let count = removed().await;
    assert!((41..60).contains(&count), "{count} with whole chunks");
    assert_eq!(store.kept(CAR, STREAMS).await.unwrap(), 101 - count);
    // What has arrived until 40 days ago, of which a part is in rows.
    let day = now() / 86_400;
    store.note_arrivals_on(day - 40).await.unwrap();
    recorded.append("events", 101..103).await;
    store.note_arrivals_on(day - 30).await.unwrap();
    recorded.append("events", 103..104).await;
    remove_old(&recorded.cloud, 3600).await.unwrap();
    assert_eq!(removed().await, 101);
    assert_eq!(recorded.all(STREAMS).await.len(), 3);
    assert_eq!(recorded.files().len(), 0, "files go after their rows");
    remove_old(&recorded.cloud, 3600).await.unwrap();
    assert_eq!(recorded.all(STREAMS).await.len(), 3);
}

#[tokio::test]
async fn a_search_finds_records_in_chunks_and_rows_and_goes_on() {
    let recorded = Recorded::start().await;
    connected(&recorded.cloud.store, "car-8").await;
    let labels = "UPDATE vehicles SET labels = '{\"site\":\"oslo\"}' WHERE name = 'car-7'";
    recorded.cloud.store.execute(labels).await;
    recorded.append(BRAKE, 0..100).await;
    recorded.append("events", 0..10).await;
    pack(&recorded.cloud, SIZES).await.unwrap();
    assert!(recorded.files().len() > 5);
    let tens: Vec<_> = (0..10).rev().map(|it| it * 10).collect();
    for (query, expected) in [
        ("text=wheel 57 \"SLIPS&lambda=brake", vec![57]),
        ("text=wheel 9&limit=1", [9].into_iter().chain((90..100).rev()).chain([9]).collect()),
        ("level=warn&lambda=brake&limit=3", tens.clone()),
        ("level=warn&lambda=brake&vehicle=car-7", tens),
        ("level=error", vec![]),
        ("kind=decision", vec![]),
        ("kind=trigger", vec![]),
        ("kind=fault", vec![]),
        ("from_ns=1098&lambda=brake&kind=log", vec![99, 98]),
        ("to_ns=1001&lambda=brake&limit=1", vec![1, 0]),
        ("text=wheel 3 &label=site=oslo", vec![3, 3]),
        ("text=wheel 3 &label=site=bergen", vec![]),
        ("text=message", vec![]),
        ("text=wheel 3 &lambda=other", vec![]),
        ("vehicle=car-8", vec![]),
    ] {
        assert_eq!(recorded.found(search(query)).await, expected, "{query}");
    }
    assert_eq!(recorded.found(search("limit=7")).await.len(), 110);
}

#[tokio::test]
async fn a_search_that_cannot_be_carried_out_is_refused() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..10).await;
    let long = format!("text={}", "x".repeat(257));
    for (query, reason) in [
        (&*long, "has 257 bytes"),
        ("kind=foo", "no records of kind `foo`"),
        ("after=x", "not a position of a search"),
        ("vehicle=car-9", "no vehicle `car-9`"),
    ] {
        let refused = recorded.cloud.search(&search(query)).await.unwrap_err();
        assert!(refused.reason().contains(reason), "{}", refused.reason());
    }
    // A position that no answer had finds something else, or nothing.
    for position in [
        json!({ "vehicle": "car-7", "stream": "x", "before": i64::MIN }),
        json!({ "vehicle": "zzz", "stream": "", "before": 3 }),
        json!({ "vehicle": "", "stream": "'; DROP TABLE records", "before": null }),
    ] {
        let after = Some(position.to_string());
        recorded.found(RecordSearch { after, ..RecordSearch::default() }).await;
    }
}
