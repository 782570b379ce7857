use std::io::{BufRead, BufReader};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::symlink;
use std::thread::JoinHandle;

use serde_json::json;

use super::*;
use crate::account::CloudAccount;

const SHA256: &str = "ed7002b439e9ac845f22357d822bac1444730fbdb6016d3ec9432297b9ec9f73";

fn clip() -> FleetClip {
    let clip = json!({ "id": "a@car-7", "vehicle": "car-7", "state": "stored", "received": 7,
        "reason": null, "has_thumbnail": false, "name": "a", "from_ns": 1, "to_ns": 2, "bytes": 7,
        "sha256": SHA256, "thumbnail": null, "lambdas": [], "triggers": 0, "moments": [] });
    serde_json::from_value(clip).unwrap()
}

/// Serves one request; returns a client, and the head of the request.
fn cloud(status: &'static str, body: &'static [u8]) -> (VehicleClient, JoinHandle<String>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap()).parse().unwrap();
    let served = std::thread::spawn(move || {
        let (mut stream, _): (TcpStream, _) = listener.accept().unwrap();
        let lines = BufReader::new(stream.try_clone().unwrap()).lines().map(Result::unwrap);
        let head: Vec<_> = lines.take_while(|line| !line.is_empty()).collect();
        let answer = format!("HTTP/1.1 {status}\r\ncontent-length: {}\r\n\r\n", body.len());
        stream.write_all(answer.as_bytes()).unwrap();
        // A client that refuses it closes the connection.
        let _ = stream.write_all(body);
        head.join("\n")
    });
    let account = CloudAccount { url, token: "token".to_owned() };
    (VehicleClient::of_cloud(account).unwrap(), served)
}

#[test]
fn a_download_goes_on_where_it_was_interrupted_and_comes_once() {
    let folder = tempfile::tempdir().unwrap();
    let (clip, to) = (clip(), folder.path().join("to"));
    fs::create_dir_all(to.join("car-7")).unwrap();
    fs::write(to.join("car-7/a.mcap.part"), "con").unwrap();
    let (client, served) = cloud("206 Partial Content", b"tent");
    let target = ClipTarget::of(&to, &clip).unwrap();
    let file = target.fetch(&client).unwrap();
    assert_eq!(fs::read(&file).unwrap(), b"content");
    assert_eq!(fs::read_dir(to.join("car-7")).unwrap().count(), 1);
    let head = served.join().unwrap();
    assert!(head.starts_with("GET /v1/clips/a@car-7/file"), "{head}");
    assert!(head.contains("range: bytes=3-"), "{head}");
    assert_eq!(target.fetch(&client).unwrap(), file, "without a request");
}

#[test]
fn another_file_than_announced_is_refused_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let clip = clip();
    for body in [&b"contend"[..], b"content and more", b"cont"] {
        let (client, served) = cloud("200 OK", body);
        let target = ClipTarget::of(folder.path(), &clip).unwrap();
        let refused = target.fetch(&client).unwrap_err();
        assert_eq!(refused.exit, Exit::Denied, "{refused}");
        served.join().unwrap();
        assert_eq!(fs::read_dir(folder.path().join("car-7")).unwrap().count(), 0);
    }
}

#[test]
fn files_are_not_replaced_and_links_are_not_followed() {
    let folder = tempfile::tempdir().unwrap();
    let (clip, secret) = (clip(), folder.path().join("secret"));
    fs::create_dir_all(folder.path().join("car-7")).unwrap();
    fs::write(&secret, "secret").unwrap();
    let (client, _) = cloud("200 OK", b"content");
    let target = ClipTarget::of(folder.path(), &clip).unwrap();
    let file = folder.path().join("car-7/a.mcap");
    fs::write(&file, "my own").unwrap();
    let refused = target.fetch(&client).unwrap_err().to_string();
    assert!(refused.contains("exists, and is another file"), "{refused}");
    assert_eq!(fs::read(&file).unwrap(), b"my own");
    fs::remove_file(&file).unwrap();
    symlink(&secret, folder.path().join("car-7/a.mcap.part")).unwrap();
    assert!(target.fetch(&client).is_err());
    assert_eq!(fs::read(&secret).unwrap(), b"secret");
    let other = folder.path().join("other");
    fs::create_dir(&other).unwrap();
    symlink(folder.path(), other.join("car-7")).unwrap();
    assert!(ClipTarget::of(&other, &clip).unwrap().fetch(&client).is_err());
}

#[test]
fn a_download_waits_for_another_one_of_the_same_file() {
    let folder = tempfile::tempdir().unwrap();
    let (clip, to) = (clip(), folder.path().to_owned());
    fs::create_dir_all(to.join("car-7")).unwrap();
    let part = to.join("car-7/a.mcap.part");
    let mut other = locked(&part).unwrap();
    let (client, _) = cloud("500 No", b"");
    let waiting = std::thread::spawn({
        let to = to.clone();
        move || ClipTarget::of(&to, &clip).unwrap().fetch(&client).map_err(|it| it.to_string())
    });
    other.write_all(b"content").unwrap();
    fs::rename(&part, to.join("car-7/a.mcap")).unwrap();
    drop(other);
    assert_eq!(waiting.join().unwrap().unwrap(), to.join("car-7/a.mcap"));
    assert_eq!(fs::read_dir(to.join("car-7")).unwrap().count(), 1, "and leaves nothing");
}

#[test]
fn a_vehicle_with_the_name_of_the_table_has_a_folder_beside_it() {
    let mut clip = serde_json::to_value(clip()).unwrap();
    clip["id"] = json!("a@events.jsonl");
    let clip: FleetClip = serde_json::from_value(clip).unwrap();
    let target = ClipTarget::of(Path::new("to"), &clip).unwrap();
    assert_eq!(target.file, Path::new("to/events.jsonl~/a.mcap"));
}
