use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::unix::net::UnixListener;
use std::thread;

use super::*;

fn head(stream: &mut impl Read) -> String {
    let (mut request, mut byte) = (Vec::new(), [0]);
    while !request.ends_with(b"\r\n\r\n") {
        stream.read_exact(&mut byte).unwrap();
        request.push(byte[0]);
    }
    String::from_utf8(request).unwrap()
}

fn serve_without_end(mut stream: impl Read + Write, status: &str) {
    head(&mut stream);
    let head = format!("HTTP/1.1 {status}\r\ncontent-type: application/json\r\n\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let piece = vec![b' '; 1 << 20];
    while stream.write_all(&piece).is_ok() {}
}

#[test]
fn an_answer_without_end_is_refused_with_its_socket_and_the_maximum() {
    let folder = tempfile::tempdir().unwrap();
    let listener = UnixListener::bind(folder.path().join(API_SOCKET)).unwrap();
    let args = VehicleArgs { run_dir: Some(folder.path().to_owned()), json: true };
    type Request = fn(&VehicleClient) -> Result<(), Failure>;
    let requests: [(&str, Request); 3] = [
        ("200 OK", |client| client.status().map(drop)),
        ("500 Internal Server Error", |client| client.delete("/v1/deployments/id")),
        ("200 OK", |client| client.lines("/v1/events", |_| Ok(()))),
    ];
    for (status, request) in requests {
        let failure = thread::scope(|scope| {
            let served = scope.spawn(|| serve_without_end(listener.accept().unwrap().0, status));
            let client = VehicleClient::new(&args).unwrap();
            let failure = request(&client).unwrap_err().to_string();
            // It closes the connection.
            drop(client);
            served.join().unwrap();
            failure
        });
        for part in ["control.sock` has more than 64 MiB", "help:"] {
            assert!(failure.contains(part), "{failure}");
        }
    }
}

struct OneAnswer(TcpListener);

impl OneAnswer {
    fn new() -> Self {
        Self(TcpListener::bind("127.0.0.1:0").unwrap())
    }

    fn client(&self, token: &str) -> VehicleClient {
        let url = format!("http://{}", self.0.local_addr().unwrap()).parse().unwrap();
        let account = CloudAccount { url, token: token.to_owned() };
        VehicleClient::to(Endpoint::Cloud(account), "/v1/vehicles/car-7".to_owned()).unwrap()
    }

    /// Answers `request` with these bytes and the end of the connection; returns the head of the
    /// request and its result.
    fn to<T: Send>(
        &self,
        answer: &str,
        token: &str,
        request: impl FnOnce(&VehicleClient) -> Result<T, Failure> + Send,
    ) -> (String, Result<T, Failure>) {
        thread::scope(|scope| {
            let asked = scope.spawn(|| request(&self.client(token)));
            let mut stream = self.0.accept().unwrap().0;
            let head = head(&mut stream);
            stream.write_all(answer.as_bytes()).unwrap();
            drop(stream);
            (head, asked.join().unwrap())
        })
    }
}

fn get(client: &VehicleClient) -> Result<serde_json::Value, Failure> {
    client.get("/v1/status")
}

#[test]
fn a_request_to_a_cloud_has_the_token_and_the_vehicle() {
    let answer = "HTTP/1.1 200 OK\r\ncontent-length: 7\r\n\r\n{\"a\":1}";
    let (head, value) = OneAnswer::new().to(answer, "secret", get);
    assert_eq!(value.unwrap(), serde_json::json!({ "a": 1 }));
    assert!(head.starts_with("GET /v1/vehicles/car-7/status HTTP/1.1\r\n"), "{head}");
    assert!(head.contains("authorization: Bearer secret\r\n"), "{head}");
    let (head, _) = OneAnswer::new().to(answer, "", get);
    assert!(!head.contains("authorization"), "{head}");
}

#[test]
fn a_bad_answer_of_a_cloud_is_an_error_with_its_exit_code() {
    let problem = r#"{"title":"no such thing","causes":["a cause"],"exit":"#;
    for (status, body, length, token, exit, parts) in [
        ("401 Unauthorized", "", None, "t", Exit::Denied, &["401", "gleaner login URL"][..]),
        ("401 Unauthorized", problem, Some("3}"), "t", Exit::Denied, &["a cause", "gleaner login"]),
        ("401 Unauthorized", problem, Some("3}"), "", Exit::Denied, &["no such thing"]),
        ("403 Forbidden", problem, Some("3}"), "t", Exit::Denied, &["no such thing", "a cause"]),
        ("403 Forbidden", "<html>", None, "t", Exit::Denied, &["gleaner-cloud answers 403"]),
        ("404 Not Found", problem, Some("2}"), "t", Exit::Usage, &["no such thing"]),
        ("404 Not Found", "<html>", None, "t", Exit::Internal, &["gleaner-cloud answers 404"]),
        ("200 OK", "<html>", None, "t", Exit::Internal, &["cannot parse the answer"]),
    ] {
        let body = format!("{body}{}", length.unwrap_or_default());
        let answer = format!("HTTP/1.1 {status}\r\ncontent-length: {}\r\n\r\n{body}", body.len());
        let failure = OneAnswer::new().to(&answer, token, get).1.unwrap_err();
        assert_eq!(failure.exit, exit, "{failure}");
        let text = failure.to_string();
        assert!(parts.iter().all(|part| text.contains(part)), "{text}");
        assert_eq!(text.contains("gleaner login"), status.starts_with("401") && !token.is_empty());
    }
}

#[test]
fn a_connection_that_ends_within_an_answer_is_lost() {
    let cloud = OneAnswer::new();
    let lines = |client: &VehicleClient| client.lines("/v1/events", |_| Ok(()));
    let cut = "HTTP/1.1 200 OK\r\ncontent-length: 700\r\n\r\n{\"a\"";
    let chunked = "HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n5\r\n{\"a\"";
    for failure in [
        cloud.to(cut, "t", get).1.unwrap_err(),
        cloud.to("", "t", get).1.unwrap_err(),
        cloud.to("no HTTP\r\n\r\n", "t", get).1.unwrap_err(),
        cloud.to(chunked, "t", lines).1.unwrap_err(),
    ] {
        assert_eq!(failure.exit, Exit::Unreachable, "{failure}");
        let place = cloud.0.local_addr().unwrap().to_string();
        assert!(failure.to_string().contains(&place), "{failure}");
    }
}

#[test]
fn a_cloud_that_is_gone_or_never_stops_is_an_error() {
    let cloud = OneAnswer::new();
    let failure = thread::scope(|scope| {
        let served = scope.spawn(|| serve_without_end(cloud.0.accept().unwrap().0, "200 OK"));
        let client = cloud.client("t");
        let failure = get(&client).unwrap_err().to_string();
        drop(client);
        served.join().unwrap();
        failure
    });
    assert!(failure.contains("has more than 64 MiB"), "{failure}");
    let client = cloud.client("t");
    drop(cloud);
    let failure = get(&client).unwrap_err();
    assert_eq!(failure.exit, Exit::Unreachable);
    assert!(failure.to_string().contains("cannot reach the cloud at http://127.0.0.1:"));
}

#[test]
fn a_request_that_creates_is_sent_again_with_its_key_after_a_lost_connection() {
    let cloud = OneAnswer::new();
    let done = "HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}";
    let problem = r#"{"title":"its secret is not kept","exit":2}"#;
    let refused = format!("HTTP/1.1 409 Conflict\r\ncontent-length: 43\r\n\r\n{problem}");
    let body = serde_json::json!({});
    for (answer, is_done) in [(done, true), (&*refused, false)] {
        let (keys, result) = thread::scope(|scope| {
            let asked =
                scope.spawn(|| cloud.client("t").create::<serde_json::Value>("/v1/users", &body));
            let keys = ["", answer].map(|answer| {
                let mut stream = cloud.0.accept().unwrap().0;
                let head = head(&mut stream);
                stream.write_all(answer.as_bytes()).unwrap();
                let key = head.lines().find(|line| line.starts_with("idempotency-key: "));
                key.unwrap().to_owned()
            });
            (keys, asked.join().unwrap())
        });
        assert_eq!(keys[0], keys[1]);
        assert_eq!(result.is_ok(), is_done, "{result:?}");
    }
}
