//! A server that gives set answers, and remembers the requests.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex, mpsc};
use std::thread;

use axum::Router;
use axum::body::Bytes;
use axum::http::{HeaderMap, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use serde_json::{Value, json};
use tokio::net::{TcpListener, UnixListener};

#[derive(Clone, Debug)]
pub struct SeenRequest {
    pub line: String,
    pub authorization: Option<String>,
    pub body: Vec<u8>,
}

#[derive(Default)]
struct Table {
    answers: BTreeMap<String, VecDeque<(u16, Value)>>,
    seen: Vec<SeenRequest>,
    /// SHA-256 of the envelope of the deployment that was sent last: answers have it for `$sent`.
    sent: String,
}

pub struct FakeServer {
    table: Arc<Mutex<Table>>,
    address: Option<SocketAddr>,
}

impl FakeServer {
    pub fn on_tcp() -> Self {
        let (sender, receiver) = mpsc::channel();
        let serve = async move |router: Router| {
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            sender.send(listener.local_addr().unwrap()).unwrap();
            axum::serve(listener, router).await.unwrap();
        };
        let table = Self::serve(serve);
        Self { table, address: Some(receiver.recv().unwrap()) }
    }

    pub fn on_socket(path: &Path) -> Self {
        let (sender, receiver) = mpsc::channel();
        let path = path.to_owned();
        let serve = async move |router: Router| {
            let listener = UnixListener::bind(&path).unwrap();
            sender.send(()).unwrap();
            axum::serve(listener, router).await.unwrap();
        };
        let table = Self::serve(serve);
        receiver.recv().unwrap();
        Self { table, address: None }
    }

    fn serve(serve: impl AsyncFnOnce(Router) + Send + 'static) -> Arc<Mutex<Table>> {
        let table = Arc::new(Mutex::new(Table::default()));
        let shared = Arc::clone(&table);
        thread::spawn(move || {
            let answer = async move |method: Method, uri: Uri, headers: HeaderMap, body: Bytes| {
                answer(&mut shared.lock().unwrap(), &method, &uri, &headers, &body)
            };
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            runtime.unwrap().block_on(serve(Router::new().fallback(answer)));
        });
        table
    }

    pub fn url(&self) -> String {
        format!("http://{}", self.address.unwrap())
    }

    /// Sets the answers to a request, in turn; the last one is given again and again.
    pub fn answers(&self, line: &str, answers: &[(u16, Value)]) {
        let answers = answers.iter().cloned().collect();
        self.table.lock().unwrap().answers.insert(line.to_owned(), answers);
    }

    pub fn answer(&self, line: &str) -> Value {
        self.table.lock().unwrap().answers[line][0].1.clone()
    }

    /// Returns the requests so far, and forgets them.
    pub fn seen(&self) -> Vec<SeenRequest> {
        std::mem::take(&mut self.table.lock().unwrap().seen)
    }
}

pub fn problem(exit: u8, title: &str) -> Value {
    json!({ "title": title, "causes": ["a cause"], "help": "a help", "exit": exit })
}

fn answer(
    table: &mut Table,
    method: &Method,
    uri: &Uri,
    headers: &HeaderMap,
    body: &[u8],
) -> Response {
    let line = format!("{method} {uri}");
    let authorization = headers.get(header::AUTHORIZATION);
    let authorization = authorization.map(|value| value.to_str().unwrap().to_owned());
    if line == "POST /v1/deployments" {
        let request: Value = serde_json::from_slice(body).unwrap();
        let envelope = request["deployment"].as_str().unwrap();
        table.sent = gleaner_trust::sha256(envelope.as_bytes()).to_string();
    }
    table.seen.push(SeenRequest { line: line.clone(), authorization, body: body.to_owned() });
    let Some(answers) = table.answers.get_mut(&line) else {
        let (status, exit) = (StatusCode::NOT_FOUND, 2);
        return (status, axum::Json(problem(exit, &format!("no answer to {line}"))))
            .into_response();
    };
    let next = match answers.len() {
        1 => answers[0].clone(),
        _ => answers.pop_front().unwrap(),
    };
    let status = StatusCode::from_u16(next.0).unwrap();
    match next.1 {
        // Lines of a stream.
        Value::String(text) => (status, text).into_response(),
        Value::Null => status.into_response(),
        value => {
            let text = value.to_string().replace("$sent", &table.sent);
            (status, [(header::CONTENT_TYPE, "application/json")], text).into_response()
        }
    }
}
