use std::collections::BTreeMap;
use std::fs;
use std::sync::atomic::{AtomicUsize, Ordering};

use gleaner_fleet::clips::{ClipBudget, ClipFacts};
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use super::super::fake_cloud::{FakeCloud, soon};
use super::*;

/// Returns the task of a vehicle with these clips.
fn sender(cloud: &FakeCloud, clips: &[(&str, &[u8])]) -> (TempDir, watch::Sender<u64>, ClipSender) {
    let folder = TempDir::new().unwrap();
    let core = Orchestrator::in_folder(folder.path(), gleaner_lambda::Vehicle::default());
    let own = ClipFolder(core.layout.clips());
    fs::create_dir(own.0.join("clips")).unwrap();
    let mut list = String::new();
    for (name, content) in clips {
        let file = format!("clips/{name}.mcap");
        fs::write(own.0.join(&file), content).unwrap();
        let image = format!("clips/{name}.jpg");
        let line = json!({ "file": file, "thumbnail": image, "bytes": content.len(), "from_ns": 1,
            "to_ns": 9, "first_ns": null, "last_ns": null, "triggers": 1, "moments": [],
            "topics": [], "lambdas": [], "incomplete": [], "recovered": null });
        list += &format!("{line}\n");
    }
    fs::write(own.0.join("clips.jsonl"), list).unwrap();
    let (generation, wanted) = watch::channel(0);
    let sender = ClipSender::new(core, own, cloud.http.clone(), wanted, Arc::default());
    (folder, generation, sender)
}

/// Answers the requests of a vehicle in turn; returns these, and the failure after the last one.
async fn served(
    cloud: &FakeCloud,
    sender: &mut ClipSender,
    answers: &[Value],
) -> (Vec<ClipReport>, String) {
    let answering = async {
        let mut reports = Vec::new();
        for answer in answers {
            reports.push(answered(cloud, answer).await);
        }
        reports
    };
    let (Err(failure), reports) = soon(async { tokio::join!(sender.serve(), answering) }).await;
    (reports, failure.to_string())
}

/// Answers the next request of a vehicle, and returns that.
async fn answered(cloud: &FakeCloud, answer: &Value) -> ClipReport {
    let mut connection = cloud.accept().await;
    let request = connection.request().await.unwrap();
    let (_, body) = request.split_once("\r\n\r\n").unwrap();
    let answer = answer.to_string();
    let head = format!("200 OK\r\ncontent-length: {}", answer.len());
    connection.answer(&head, answer.as_bytes()).await;
    serde_json::from_str(body).unwrap()
}

fn orders(cursor: &Value, thumbnails: Value, wanted: Value) -> Value {
    json!({ "cursor": cursor, "thumbnails": thumbnails, "wanted": wanted })
}

#[tokio::test]
async fn orders_of_a_hostile_cloud_are_refused_or_answered_with_the_reason() {
    let cloud = FakeCloud::start().await;
    let (_folder, _wanted, mut sender) = sender(&cloud, &[("a", b"abc")]);
    let nothing = orders(&Value::Null, json!([]), json!([]));
    // Without the position after them, the vehicle does not send the same clips for ever.
    let answers = [nothing.clone(), nothing.clone()];
    let (reports, failure) = served(&cloud, &mut sender, &answers).await;
    assert_eq!((&*reports[1].clips[0].name.to_string(), reports[1].clips[0].bytes), ("a", 3));
    assert!(failure.contains("did not store the list"), "{failure}");

    let cursor = json!(reports[1].cursor);
    let piece = |name: &str, bytes: u64, from: Option<u64>| {
        let wanted = json!([{ "name": name, "bytes": bytes, "sha256": "", "part": 0,
            "from": from }]);
        orders(&cursor, json!([]), wanted)
    };
    let answers = [
        orders(&cursor, json!(["gone"]), json!([])),
        piece("gone", 3, Some(0)),
        piece("a", 1 << 60, Some(0)),
        piece("a", 3, Some(3)),
        piece("a", 3, Some(u64::MAX)),
        piece("../../state.json", 3, Some(0)),
    ];
    let (reports, failure) = served(&cloud, &mut sender, &answers).await;
    assert!(failure.contains("its answer cannot be parsed"), "{failure}");
    let gone = reports[1..].iter().map(|report| &report.gone[0]);
    let gone: Vec<_> = gone.map(|it| (it.name.as_str(), it.is_thumbnail, &*it.reason)).collect();
    let (deleted, other) = ("the vehicle has deleted the file", "unexpected end of file");
    let other = ("a", false, other);
    assert_eq!(gone, [("gone", true, deleted), ("gone", false, deleted), other, other, other]);
    let (_, failure) = served(&cloud, &mut sender, &[piece("a", 3, None)]).await;
    assert!(failure.contains("takes no pieces"), "{failure}");
}

/// Serves as a cloud that keeps what has come of each piece, and no thumbnail, until it has so many
/// clips; returns these.
async fn stored(cloud: &FakeCloud, count: usize) -> BTreeMap<ClipName, Vec<u8>> {
    let (mut clips, mut files) = (Vec::new(), BTreeMap::new());
    let mut orders = ClipOrders::default();
    loop {
        let mut connection = cloud.accept().await;
        let Some((head, body, is_whole)) = connection.request_so_far().await else { continue };
        let path: Vec<_> = head.split(' ').nth(1).unwrap().split('/').collect();
        if let [_, _, _, name, "from", begin] = path[..] {
            let file: &mut Vec<u8> = files.entry(name.parse().unwrap()).or_default();
            assert_eq!(begin, file.len().to_string(), "it goes on where the cloud is");
            file.extend(body);
        } else if !path.contains(&"thumbnail") {
            let report: ClipReport = serde_json::from_slice(&body).unwrap();
            orders.cursor = report.cursor.or(orders.cursor);
            clips.extend(report.clips);
        }
        let wanted = clips.iter().map(|ClipFacts { name, bytes, .. }| {
            let from = files.get(name).map_or(0, |file| file.len() as u64);
            let (name, sha256) = (name.clone(), String::new());
            WantedClip { name, bytes: *bytes, sha256, part: 0, from: Some(from) }
        });
        orders.wanted = wanted.filter(|it| it.from < Some(it.bytes)).collect();
        let images = clips.iter().filter(|facts| facts.thumbnail.is_some());
        orders.thumbnails = images.map(|facts| facts.name.clone()).collect();
        if is_whole {
            let answer = serde_json::to_vec(&orders).unwrap();
            let head = format!("200 OK\r\ncontent-length: {}", answer.len());
            connection.answer(&head, &answer).await;
        }
        if clips.len() == count && orders.wanted.is_empty() {
            return files;
        }
    }
}

/// Forwards connections, and ends each after so many bytes of the vehicle; also counts these.
async fn cutting(target: String, most: usize) -> (String, Arc<AtomicUsize>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let (address, sent) =
        (listener.local_addr().unwrap().to_string(), Arc::<AtomicUsize>::default());
    let count = Arc::clone(&sent);
    tokio::spawn(async move {
        loop {
            let (mut vehicle, _) = listener.accept().await.unwrap();
            let mut cloud = TcpStream::connect(&target).await.unwrap();
            let ((mut from, mut to), (mut answers, mut pieces)) = (vehicle.split(), cloud.split());
            let forward = async {
                let (mut left, mut piece) = (most, [0; 1000]);
                while left > 0 {
                    let room = left.min(piece.len());
                    let read = from.read(&mut piece[..room]).await.unwrap_or(0);
                    if read == 0 || pieces.write_all(&piece[..read]).await.is_err() {
                        return;
                    }
                    left -= read;
                    count.fetch_add(read, Ordering::Relaxed);
                }
            };
            tokio::select! { () = forward => {}, _ = tokio::io::copy(&mut answers, &mut to) => {} }
            // Closed with unread answers, the kernel would drop bytes that were forwarded.
            let _ = pieces.shutdown().await;
            let _ = tokio::io::copy(&mut answers, &mut tokio::io::sink()).await;
        }
    });
    (address, sent)
}

#[tokio::test]
async fn a_clip_arrives_over_connections_that_end_and_little_more_than_it_is_sent() {
    for (length, most) in [(3_000_000, 1_000_000), (600_000, 100_000), (300_000, 60_000)] {
        let content: Vec<u8> = (0..length).map(|byte| (byte / 7) as u8).collect();
        let cloud = FakeCloud::start().await;
        let (_folder, _wanted, mut sender) = sender(&cloud, &[("a", &content)]);
        let (address, sent) = cutting(cloud.http.address.clone(), most).await;
        sender.http.address = address;
        let sending = tokio::spawn(sender.run());
        let files = soon(stored(&cloud, 1)).await;
        sending.abort();
        assert!(files.values().eq([&content]), "{most}");
        let sent = sent.load(Ordering::Relaxed);
        assert!(sent * 10 <= length * 12, "{sent} of {length} over {most} at a time");
    }
}

#[tokio::test]
async fn a_thumbnail_that_no_connection_can_carry_keeps_no_clip_back() {
    let cloud = FakeCloud::start().await;
    let (_folder, _wanted, mut sender) = sender(&cloud, &[("a", b"abc"), ("b", b"other")]);
    fs::write(sender.folder.0.join("clips/a.jpg"), [7; 150_000]).unwrap();
    sender.http.address = cutting(cloud.http.address.clone(), 100_000).await.0;
    let sending = tokio::spawn(sender.run());
    let files = soon(stored(&cloud, 2)).await;
    sending.abort();
    assert!(files.values().eq([&b"abc"[..], b"other"]));
}

#[tokio::test]
async fn an_unreadable_clip_is_announced_with_its_cause_and_again_once_it_can_be_read() {
    let cloud = FakeCloud::start().await;
    let (_folder, _wanted, mut sender) = sender(&cloud, &[("a", b"abc"), ("b", b"other")]);
    let bad = sender.folder.0.join("clips/a.bad");
    fs::write(&bad, "").unwrap();
    let nothing = orders(&Value::Null, json!([]), json!([]));
    let (reports, _) = served(&cloud, &mut sender, &[nothing.clone(), nothing.clone()]).await;
    let [first, second] = &reports[1].clips[..] else { panic!("{reports:?}") };
    assert!(first.unreadable.as_ref().is_some_and(|cause| cause.contains("os error 9")));
    assert_eq!((second.name.as_str(), &second.unreadable), ("b", &None));
    assert_eq!(sender.tracked(|it| it.status().unreadable), 1);

    // After a restart, only the cloud has noted it.
    fs::remove_file(&bad).unwrap();
    sender.tracked(|it| *it = ClipTracker::default());
    let listed = json!({ "cursor": reports[1].cursor, "thumbnails": [], "wanted": [],
        "unreadable": ["a"] });
    let (reports, _) = served(&cloud, &mut sender, &[listed.clone(), json!("no orders")]).await;
    let [again] = &reports[1].clips[..] else { panic!("{reports:?}") };
    assert_eq!((again.name.as_str(), again.sha256.is_some()), ("a", true));
    let status = sender.tracked(|it| it.status());
    assert_eq!((status.unannounced_bytes, status.unreadable), (Some(0), 1), "it was not stored");
    let (current, _) = sender.current.take().unwrap();
    assert_eq!(current.as_str(), "a", "it is to blame");
    sender.tracked(|it| it.announced(&current, true));
    assert_eq!(sender.tracked(|it| it.status().unreadable), 0);

    // Then a piece fails, and a connection ends before it has used the result of the next read.
    let wanted = json!([{ "name": "a", "bytes": 3, "sha256": "", "part": 0, "from": 0 }]);
    let wanted = orders(&listed["cursor"], json!([]), wanted);
    fs::write(&bad, "").unwrap();
    let reads = sender.tracked(|it| Arc::clone(&it.reads));
    for (it, is_unreadable) in [(&wanted, true), (&wanted, true), (&listed, false)] {
        assert!(reads.lock().await.1.take().is_some(), "others are not read at once after it");
        let (reports, _) = served(&cloud, &mut sender, &[it.clone(), json!("no orders")]).await;
        assert_eq!(reports[1].clips[0].unreadable.is_some(), is_unreadable);
        if bad.exists() {
            sender.read(None, Some(current.clone())).await.unwrap();
            fs::remove_file(&bad).unwrap();
        }
    }
}

#[tokio::test]
async fn a_clip_that_takes_longer_to_read_than_connections_last_is_announced() {
    let cloud = FakeCloud::start().await;
    let (_folder, _wanted, mut sender) = sender(&cloud, &[("a", b"abc")]);
    let slow = sender.folder.0.join("clips/a.slow");
    fs::write(&slow, "").unwrap();
    let nothing = orders(&Value::Null, json!([]), json!([]));
    let reads = sender.tracked(|it| Arc::clone(&it.reads));
    for _ in 0..5 {
        let reading = async {
            answered(&cloud, &nothing).await;
            while reads.try_lock().is_ok() {
                sleep(Duration::from_millis(1)).await;
            }
        };
        tokio::select! { _ = sender.serve() => {}, () = soon(reading) => {} }
    }
    let stuck = sender.tracked(|it| it.status().stuck.unwrap());
    assert_eq!((stuck.name, stuck.attempts, &*stuck.cause), (None, 5, "the connection ended"));
    fs::remove_file(slow).unwrap();
    let digest = gleaner_trust::sha256(b"abc").to_string();
    assert_eq!(soon(reads.lock()).await.0[0].1, Ok(digest.clone()), "no connection is needed");
    let (reports, _) = served(&cloud, &mut sender, &[nothing.clone(), nothing]).await;
    assert_eq!(reports[1].clips[0].sha256, Some(digest));
}

#[tokio::test]
async fn a_portal_is_named_once_after_some_attempts_with_growing_pauses() {
    let cloud = FakeCloud::start().await;
    let (_folder, _wanted, mut sender) = sender(&cloud, &[("a", b"abc")]);
    let portal = async {
        let mut connection = cloud.accept().await;
        connection.request().await.unwrap();
        let head = "200 OK\r\ncontent-type: text/html; charset=utf-8\r\ncontent-length: 6";
        connection.answer(head, b"<html>").await;
    };
    let (Err(failure), ()) = soon(async { tokio::join!(sender.serve(), portal) }).await;
    for attempt in 1..=6 {
        let pause = sender.tracked(|it| it.fail(None, &failure));
        assert_eq!(pause, Duration::from_millis(1 << (attempt - 1)));
        let event = sender.tracked(|it| it.attempt(None));
        assert_eq!(event.is_some(), attempt == 5, "{event:?}");
    }
    let stuck = sender.tracked(|it| it.status().stuck.unwrap());
    assert_eq!((stuck.name, stuck.attempts), (None, 7));
    assert!(stuck.cause.contains("a portal or proxy is in between"), "{}", stuck.cause);
}

#[test]
fn a_clip_without_progress_waits_for_others_and_all_for_the_budget_of_the_next_day() {
    let mut tracker = ClipTracker::default();
    let wanted = |name: &str, from| WantedClip {
        name: name.parse().unwrap(),
        bytes: 9,
        sha256: String::new(),
        part: 0,
        from: Some(from),
    };
    let mut orders =
        ClipOrders { wanted: vec![wanted("a", 0), wanted("b", 0)], ..Default::default() };
    let budget = |day, is_spent| Some(ClipBudget { day, bytes: 10, is_spent });
    orders.budget = budget(1, false);
    orders.thumbnails = vec!["b".parse().unwrap()];
    assert_eq!(tracker.status().waiting, None);
    tracker.learn(&orders, 0);
    assert_eq!(tracker.status().waiting, Some(2));
    let next = |tracker: &mut ClipTracker| {
        let (name, wanted) = tracker.next()?;
        tracker.attempt(Some((name.clone(), wanted.is_none())));
        Some(format!("{name} {}", wanted.is_none()))
    };
    for expected in ["b true", "a false", "b false", "b true"] {
        assert_eq!(next(&mut tracker).as_deref(), Some(expected), "the fewest attempts are first");
    }
    assert_eq!(tracker.piece(), 64 << 10);
    tracker.arrived(64 << 10);
    assert_eq!((tracker.piece(), tracker.piece()), (128 << 10, 64 << 10));
    orders.wanted[1] = wanted("b", 5);
    tracker.learn(&orders, 0);
    assert_eq!(next(&mut tracker).as_deref(), Some("b false"), "it has made progress");
    tracker.send(10);
    assert_eq!(next(&mut tracker), None);
    assert!(tracker.status().paused.unwrap().contains("of today were sent"));
    orders.budget = budget(2, false);
    tracker.learn(&orders, 0);
    assert_eq!(next(&mut tracker).as_deref(), Some("a false"));
    // A cloud whose budget is used up wants nothing.
    tracker.learn(&ClipOrders { budget: budget(2, true), ..ClipOrders::default() }, 0);
    assert!(tracker.status().paused.unwrap().contains("of today were sent"));
    assert_eq!(tracker.status().waiting, None);
    for first in [1, 0] {
        let names = (first..first + 64).map(|name| name.to_string().parse().unwrap());
        tracker.learn(&ClipOrders { unreadable: names.collect(), ..Default::default() }, 0);
    }
    tracker.learn(&ClipOrders { wanted: vec![wanted("0", 0)], ..Default::default() }, 0);
    assert_eq!(next(&mut tracker), None, "a pulled one is listed first, beside 64 known ones");
    assert!(tracker.due().is_some());
    tracker.reads.try_lock().unwrap().1 = Some(Instant::now() + COMPARING);
    assert_eq!(tracker.due(), None, "reading them must not keep others waiting");
}
