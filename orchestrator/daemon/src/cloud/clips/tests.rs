use std::fs;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::super::fake_cloud::{FakeCloud, soon};
use super::*;

/// Answers the requests of a vehicle in turn; returns these, and the failure after the last one.
async fn served(
    cloud: &FakeCloud,
    sender: &mut ClipSender,
    answers: &[Value],
) -> (Vec<ClipReport>, String) {
    let answering = async {
        let mut reports = Vec::new();
        for answer in answers {
            let mut connection = cloud.accept().await;
            let request = connection.request().await.unwrap();
            let (_, body) = request.split_once("\r\n\r\n").unwrap();
            reports.push(serde_json::from_str(body).unwrap());
            let body = answer.to_string();
            let head = format!("200 OK\r\ncontent-length: {}", body.len());
            connection.answer(&head, body.as_bytes()).await;
        }
        reports
    };
    let (Err(failure), reports) = soon(async { tokio::join!(sender.serve(), answering) }).await;
    (reports, failure.to_string())
}

#[tokio::test]
async fn orders_of_a_hostile_cloud_are_refused_or_answered_with_the_reason() {
    let folder = TempDir::new().unwrap();
    let api = crate::api::tests::vehicle(folder.path(), gleaner_lambda::Vehicle::default());
    let cloud = FakeCloud::start().await;
    let clips = ClipFolder(api.layout.clips());
    fs::create_dir(clips.0.join("clips")).unwrap();
    fs::write(clips.0.join("clips/a.mcap"), "abc").unwrap();
    let line = json!({ "file": "clips/a.mcap", "thumbnail": null, "bytes": 3, "from_ns": 1,
        "to_ns": 9, "first_ns": null, "last_ns": null, "triggers": 1, "moments": [],
        "topics": [], "lambdas": [], "incomplete": [], "recovered": null });
    fs::write(clips.0.join("clips.jsonl"), format!("{line}\n")).unwrap();
    let (_wanted, wanted) = watch::channel(0);
    let mut sender = ClipSender::new(api.core, clips, cloud.http.clone(), wanted);

    let orders = |cursor: &Value, thumbnails: Value, wanted: Value| json!({ "cursor": cursor, "thumbnails": thumbnails, "wanted": wanted });
    let nothing = orders(&Value::Null, json!([]), json!([]));
    // Without the position after them, the vehicle does not send the same clips for ever.
    let answers = [nothing.clone(), nothing.clone()];
    let (reports, failure) = served(&cloud, &mut sender, &answers).await;
    assert_eq!((&*reports[1].clips[0].name.to_string(), reports[1].clips[0].bytes), ("a", 3));
    assert!(failure.contains("did not store the list"), "{failure}");

    let cursor = json!(reports[1].cursor);
    let part = |name: &str, bytes: u64, part: u64| {
        let wanted = json!([{ "name": name, "bytes": bytes, "sha256": "", "part": part }]);
        orders(&cursor, json!([]), wanted)
    };
    let answers = [
        orders(&cursor, json!(["gone"]), json!([])),
        part("gone", 3, 0),
        part("a", 1 << 60, 0),
        part("a", 3, 1),
        part("a", 3, u64::MAX),
        part("../../state.json", 3, 0),
    ];
    let (reports, failure) = served(&cloud, &mut sender, &answers).await;
    assert!(failure.contains("its answer cannot be parsed"), "{failure}");
    let gone = reports[1..].iter().map(|report| &report.gone[0]);
    let gone: Vec<_> = gone.map(|it| (it.name.as_str(), it.is_thumbnail, &*it.reason)).collect();
    let (deleted, other) = ("the vehicle has deleted the file", "unexpected end of file");
    let other = ("a", false, other);
    assert_eq!(gone, [("gone", true, deleted), ("gone", false, deleted), other, other, other]);
}
