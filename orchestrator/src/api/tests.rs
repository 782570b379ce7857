//! Requests with odd paths, over a socket.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;

use super::*;
use crate::durable::DurableFile;

/// Sends a request; returns the whole answer.
fn answer(socket: &Path, method: &str, path: &str) -> String {
    let mut stream = UnixStream::connect(socket).unwrap();
    let request = format!("{method} {path} HTTP/1.1\r\nhost: v\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[test]
fn odd_ids_are_refused_and_leave_all_files() {
    let folder = tempfile::tempdir().unwrap();
    let core = Orchestrator::in_folder(folder.path(), gleaner_lambda::Vehicle::default());
    let (cloud, _) = Cloud::load(DurableFile::new(core.layout.cloud()));
    let api = Api { core, cloud };
    let (socket, state) = (api.core.layout.control_socket(), folder.path().join("state"));
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    let _entered = runtime.enter();
    let listener = tokio::net::UnixListener::bind(&socket).unwrap();
    runtime.spawn(async move { axum::serve(listener, api.router()).await });
    let before = std::fs::read(state.join("state.json")).unwrap();
    let long = "a".repeat(300);
    for id in ["", ".", "..", "%2e%2e", "%2e%2e%2fstate", "a%2fb", "%00", "%0a%1b[31m", &long] {
        for (method, end) in [("DELETE", ""), ("POST", "/stop"), ("POST", "/rollback")] {
            let answer = answer(&socket, method, &format!("/v1/deployments/{id}{end}"));
            assert!(answer.starts_with("HTTP/1.1 400 "), "{id}: {answer}");
            let (_, body) = answer.split_once("\r\n\r\n").unwrap();
            let problem: Problem = serde_json::from_str(body).unwrap();
            let is_named = problem.title.starts_with("there is no deployment `")
                || problem.title == "there is nothing under this path";
            assert!(is_named && problem.title.len() < 200, "{id}: {problem:?}");
            assert!(!problem.title.contains(char::is_control), "{id}: {problem:?}");
        }
    }
    // Bytes that are no text.
    assert!(answer(&socket, "DELETE", "/v1/deployments/%ff").starts_with("HTTP/1.1 400 "));
    assert_eq!(std::fs::read(state.join("state.json")).unwrap(), before);
    assert!(["records", "clips", "spool"].iter().all(|name| state.join(name).is_dir()));
}

#[test]
fn the_committed_description_is_that_of_the_api() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/api/vehicle.json");
    let what = "The API of a vehicle, on a socket of it.";
    let described = gleaner_fleet::openapi::describe("Gleaner vehicle", what, &endpoints());
    if std::env::var_os("GLEANER_BLESS").is_some() {
        std::fs::write(path, &described).unwrap();
    }
    let is_same = std::fs::read_to_string(path).unwrap() == described;
    assert!(is_same, "run `cargo xtask bless`, which writes docs/api/vehicle.json");
}
