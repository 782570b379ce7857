use std::fs;
use std::path::Path;
use std::sync::Arc;

use gleaner_trust::sha256;
use tempfile::TempDir;
use tokio::task::JoinHandle;

use super::super::fake_cloud::{FakeAnswers, FakeCloud, soon};
use super::super::settings::CloudSettings;
use super::super::{Cloud, CloudLink};
use super::*;
use crate::durable::DurableFile;
use crate::orchestrator::Orchestrator;

const CONTENT: &[u8] = b"content";

/// The answer to one request: its head and its body.
type FakeAnswer = (&'static str, &'static str);

/// A cloud that gives these answers, one after the other on each of its connections; the handle
/// returns the requests.
async fn cloud(connections: Vec<Vec<FakeAnswer>>) -> (CloudHttp, JoinHandle<Vec<String>>) {
    let cloud = FakeCloud::start().await;
    let http = cloud.http.clone();
    let served = tokio::spawn(async move {
        let mut requests = Vec::new();
        for answers in connections {
            let mut connection = cloud.accept().await;
            for (head, body) in answers {
                requests.push(connection.request().await.unwrap());
                connection.answer(head, body.as_bytes()).await;
            }
            connection.close().await;
        }
        requests
    });
    (http, served)
}

/// Downloads `CONTENT`; returns the outcome, and the requests.
async fn download(folder: &Path, answers: Vec<FakeAnswer>) -> (Result<(), Failure>, Vec<String>) {
    let (http, served) = cloud(answers.into_iter().map(|it| vec![it]).collect()).await;
    let sha256 = sha256(CONTENT);
    let target = folder.join("object");
    let download = Download { http: &http, sha256: &sha256, length: 7, target };
    let done = download.run_with(Duration::from_millis(1)).await;
    (done, served.await.unwrap())
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    entries.map(|it| it.unwrap().file_name().into_string().unwrap()).collect()
}

const WHOLE: &str = "200 OK\r\ncontent-length: 7";
const REST: &str = "206 Partial Content\r\ncontent-length: 4\r\ncontent-range: bytes 3-6/7";

#[tokio::test]
async fn a_download_goes_on_where_it_broke_off_also_of_an_earlier_process() {
    let folder = TempDir::new().unwrap();
    let (done, requests) = download(folder.path(), vec![(WHOLE, "con"), (REST, "tent")]).await;
    done.unwrap();
    assert!(!requests[0].contains("range:"), "{}", requests[0]);
    assert!(requests[1].contains("range: bytes=3-\r\n"), "{}", requests[1]);
    assert_eq!(names(folder.path()), ["object"]);
    assert_eq!(fs::read(folder.path().join("object")).unwrap(), CONTENT);

    fs::remove_file(folder.path().join("object")).unwrap();
    fs::write(folder.path().join("object.partial"), "con").unwrap();
    download(folder.path(), vec![(REST, "tent")]).await.0.unwrap();
    assert_eq!(fs::read(folder.path().join("object")).unwrap(), CONTENT);
}

#[tokio::test]
async fn a_cloud_that_does_not_continue_sends_the_whole_file() {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("object.partial"), "con").unwrap();
    download(folder.path(), vec![(WHOLE, "content")]).await.0.unwrap();
    assert_eq!(fs::read(folder.path().join("object")).unwrap(), CONTENT);
}

#[tokio::test]
async fn a_damaged_part_is_fetched_again_from_its_begin() {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("object.partial"), "xxx").unwrap();
    download(folder.path(), vec![(REST, "tent"), (WHOLE, "content")]).await.0.unwrap();
    assert_eq!(fs::read(folder.path().join("object")).unwrap(), CONTENT);
    // One that is too long, such as after a power cut.
    fs::write(folder.path().join("object.partial"), "content and more").unwrap();
    let (done, requests) = download(folder.path(), vec![(WHOLE, "content")]).await;
    assert!(done.is_ok() && !requests[0].contains("range:"));
}

#[tokio::test]
async fn another_file_than_signed_is_refused_and_leaves_nothing() {
    let chunked = "200 OK\r\ntransfer-encoding: chunked";
    for (answers, expected) in [
        (vec![(WHOLE, "contend")], "the SHA-256"),
        (vec![(chunked, "9\r\ncontent a\r\n")], "it is longer than 7 bytes"),
        (vec![(WHOLE, "con"), (REST, "tend"), (WHOLE, "contend")], "the SHA-256"),
    ] {
        let folder = TempDir::new().unwrap();
        let (done, _) = download(folder.path(), answers).await;
        let refused = done.unwrap_err();
        assert_eq!(refused.exit, Exit::Denied);
        assert!(refused.to_string().contains(expected), "{refused}");
        assert_eq!(names(folder.path()), Vec::<String>::new());
    }
}

#[tokio::test]
async fn another_range_than_requested_is_refused() {
    for head in [
        "206 Partial Content\r\ncontent-length: 4\r\ncontent-range: bytes 2-6/7",
        "206 Partial Content\r\ncontent-length: 4\r\ncontent-range: bytes 3-6/8",
        "206 Partial Content\r\ncontent-length: 4",
    ] {
        let folder = TempDir::new().unwrap();
        fs::write(folder.path().join("object.partial"), "con").unwrap();
        let refused = download(folder.path(), vec![(head, "tent")]).await.0.unwrap_err();
        assert!(refused.to_string().contains("another part"), "{refused}");
        assert_eq!(names(folder.path()), ["object.partial"]);
        assert_eq!(fs::read(folder.path().join("object.partial")).unwrap(), b"con");
    }
}

#[tokio::test]
async fn a_cloud_that_breaks_off_is_not_tried_for_ever_and_a_busy_one_longer() {
    let folder = TempDir::new().unwrap();
    let busy = ["429 Busy", "503 Away"];
    let busy = busy.map(|it| &*format!("{it}\r\nretry-after: 0\r\ncontent-length: 0").leak());
    let answers = [busy.repeat(3), vec![WHOLE; 5]].concat();
    let answers = answers.into_iter().map(|it| (it, "")).collect();
    let (done, requests) = download(folder.path(), answers).await;
    let failure = done.unwrap_err();
    assert_eq!((failure.exit, requests.len()), (Exit::Unreachable, 6 + 5));
    assert_eq!(names(folder.path()), ["object.partial"], "the next attempt goes on there");
}

#[tokio::test]
async fn a_wait_for_a_busy_cloud_has_a_reason_and_an_end() {
    let folder = TempDir::new().unwrap();
    let core = Orchestrator::in_folder(folder.path(), gleaner_lambda::Vehicle::default());
    let (cloud, _) = Cloud::load(DurableFile::new(core.layout.cloud()));
    let (fake, answers) = (FakeCloud::start().await, FakeAnswers::default());
    let settings = fake.settings.clone();
    let http = CloudLink { core, cloud: cloud.clone() }.http(&settings).unwrap();
    let _channels = fake.serve(Arc::clone(&answers));
    let answer = |head: &str, body: &[u8]| {
        answers.lock().unwrap().insert("/file".to_owned(), (head.to_owned(), body.to_vec()));
    };
    answer("503 Away\r\nretry-after: 0\r\ncontent-length: 0", b"");
    cloud.set(settings.clone()).unwrap();
    let reason = || cloud.status().unwrap().reason;
    let got = tokio::spawn(async move { http.get("/file", 7).await });
    let busy = soon(async {
        loop {
            match reason() {
                Some(reason) => return reason,
                None => sleep(Duration::from_millis(2)).await,
            }
        }
    })
    .await;
    assert!(busy.contains("503") && busy.contains("30 more min"), "{busy}");
    cloud.set(CloudSettings { address: "another:1".to_owned(), ..settings.clone() }).unwrap();
    assert_eq!(reason(), None, "that of another cloud");
    cloud.set(settings).unwrap();
    assert!(reason().is_some(), "it lasts");
    answer(WHOLE, CONTENT);
    assert_eq!(soon(got).await.unwrap().unwrap(), CONTENT);
    assert_eq!(reason(), None);
}

#[tokio::test]
async fn requests_share_a_connection_that_is_kept_and_go_on_over_another_one() {
    let (http, served) = cloud(vec![vec![(WHOLE, "content"); 2], vec![(WHOLE, "content")]]).await;
    let http = http.keeping();
    for path in ["/first", "/second", "/third"] {
        assert_eq!(http.get(path, 7).await.unwrap(), CONTENT, "{path}");
    }
    assert_eq!(served.await.unwrap().len(), 3);
}

#[tokio::test]
async fn a_body_that_breaks_off_takes_no_other_request_with_it() {
    let broken = [vec![(WHOLE, "content"), (WHOLE, "con")], vec![(WHOLE, "content"); 2]];
    let (http, served) = cloud(broken.to_vec()).await;
    let http = http.keeping();
    assert_eq!(http.get("/first", 7).await.unwrap(), CONTENT);
    let failure = http.get("/second", 7).await.unwrap_err();
    assert_eq!(failure.exit, Exit::Unreachable);
    assert!(failure.to_string().contains("the connection was lost"), "{failure}");
    // What is left of an answer is not taken for another one.
    for path in ["/third", "/fourth"] {
        assert_eq!(http.get(path, 7).await.unwrap(), CONTENT, "{path}");
    }
    assert_eq!(served.await.unwrap().len(), 4);
}

#[tokio::test]
async fn a_body_that_is_too_long_takes_no_other_request_with_it() {
    let answers = [vec![(WHOLE, "content")], vec![(WHOLE, "content")]];
    let (http, _served) = cloud(answers.to_vec()).await;
    let http = http.keeping();
    // It is refused before its end, which still arrives.
    let failure = http.get("/first", 3).await.unwrap_err();
    assert!(failure.to_string().contains("it has more than 3 bytes"), "{failure}");
    assert_eq!(http.get("/second", 7).await.unwrap(), CONTENT);
}
