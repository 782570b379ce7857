//! An object store with the interface of S3, as far as the cloud uses it, for tests.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, mpsc};

use axum::Router;
use axum::body::Bytes;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use tokio::net::TcpListener;

/// User of the store, in each signature.
pub const KEY: &str = "test-key";

type BucketContent = Arc<Mutex<BTreeMap<String, Bytes>>>;

/// Starts a store in a thread, which lives as long as the process; returns its address.
pub fn serve() -> SocketAddr {
    let (sender, address) = mpsc::channel();
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let listener = TcpListener::bind(("127.0.0.1", 0)).await.unwrap();
            sender.send(listener.local_addr().unwrap()).unwrap();
            let router = Router::new().fallback(answer).with_state(BucketContent::default());
            axum::serve(listener, router).await.unwrap();
        });
    });
    address.recv().unwrap()
}

async fn answer(State(content): State<BucketContent>, request: Request) -> Response {
    let (method, uri, headers) =
        (request.method().clone(), request.uri().clone(), request.headers().clone());
    let body = axum::body::to_bytes(request.into_body(), 64 << 20).await;
    match (is_signed(&uri), body) {
        (false, _) => (StatusCode::FORBIDDEN, "<Code>AccessDenied</Code>").into_response(),
        (true, Err(_)) => StatusCode::BAD_REQUEST.into_response(),
        (true, Ok(body)) => answer_signed(&content, &method, &uri, &headers, body),
    }
}

fn is_signed(uri: &Uri) -> bool {
    let query = uri.query().unwrap_or_default();
    query.contains(&format!("X-Amz-Credential={KEY}%2F")) && query.contains("X-Amz-Signature=")
}

fn answer_signed(
    content: &BucketContent,
    method: &Method,
    uri: &Uri,
    headers: &HeaderMap,
    body: Bytes,
) -> Response {
    let mut content = content.lock().unwrap();
    let key = uri.path().to_owned();
    match *method {
        Method::PUT => {
            content.insert(key, body);
            StatusCode::OK.into_response()
        }
        Method::DELETE => {
            content.remove(&key);
            StatusCode::NO_CONTENT.into_response()
        }
        _ if key.ends_with('/') => {
            let queries = form_urlencoded::parse(uri.query().unwrap_or_default().as_bytes());
            let queries: BTreeMap<String, String> = queries.into_owned().collect();
            let names = content.keys().filter_map(|name| name.strip_prefix(&key));
            let listed = names.filter(|name| name.starts_with(&queries["prefix"]));
            let listed = listed.map(|name| format!("<Contents><Key>{name}</Key></Contents>"));
            listed.collect::<String>().into_response()
        }
        _ => {
            let Some(object) = content.get(&key).cloned() else {
                return (StatusCode::NOT_FOUND, "<Code>NoSuchKey</Code>").into_response();
            };
            let range = headers.get(header::RANGE).and_then(|it| it.to_str().ok());
            let begin: Option<usize> =
                range.and_then(|it| it.strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok());
            match begin {
                Some(begin) => (StatusCode::PARTIAL_CONTENT, object.slice(begin..)).into_response(),
                None => object.into_response(),
            }
        }
    }
}
