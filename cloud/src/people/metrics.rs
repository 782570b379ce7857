//! The health of the cloud for balancers, and its numbers as text for Prometheus.

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde_json::json;
use std::fmt::Write;
use tokio::time::{Duration, Instant, timeout};

use crate::cloud::Services;
use crate::counts::{COUNTS, Count};
use crate::error::CloudResult;

const TEXT: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Labels of a sample, or the end of its name, and its value.
type Sample = (String, f64);

/// Returns whether the database can be read; without the reason, as no token is needed.
pub(super) async fn health(State(cloud): Services) -> Response {
    // Anyone may ask: the database is asked once a second at most. A busy one is not down.
    let mut last = cloud.health.lock().await;
    if last.is_none_or(|(asked, _)| asked.elapsed() >= Duration::from_secs(1)) {
        let asked = timeout(Duration::from_secs(2), cloud.store.version()).await;
        match asked {
            Ok(Ok(version)) => *last = Some((Instant::now(), version)),
            Ok(Err(_)) => *last = None,
            Err(_) => *last = last.filter(|(asked, _)| asked.elapsed() < Duration::from_secs(15)),
        }
    }
    let (status, database) = match *last {
        Some((_, version)) => (StatusCode::OK, Some(version)),
        None => (StatusCode::SERVICE_UNAVAILABLE, None),
    };
    let ready = database.is_some();
    (
        status,
        Json(json!({ "ready": ready, "version": gleaner_base::version(), "database": database })),
    )
        .into_response()
}

pub(super) async fn metrics(State(cloud): Services) -> CloudResult<Response> {
    let (vehicles, releases) = cloud.store.states().await?;
    let vehicles = by_state(&vehicles, ["invited", "online", "offline", "revoked"]);
    let releases = by_state(&releases, ["running", "paused", "aborted", "complete"]);
    let clips = cloud.store.clip_counts().await?;
    let one = |value: u64| vec![(String::new(), value as f64)];
    let links = one(cloud.hub.open_links(None).len() as u64);
    let lag = vec![(String::new(), cloud.store.age_lag() as f64)];
    let version = vec![(format!("{{version=\"{}\"}}", gleaner_base::version()), 1.0)];
    let (records, refused) = (COUNTS.records.read(), COUNTS.refused_links.read());
    let mut text = String::new();
    for (name, kind, help, samples) in [
        ("build_info", "gauge", "Version of the program", version),
        ("vehicles", "gauge", "Vehicles, by state", vehicles),
        ("links", "gauge", "Vehicles that are connected to this process", links),
        ("refused_links_total", "counter", "Connections ended with an error", one(refused)),
        ("records_total", "counter", "Records that were acknowledged", one(records)),
        ("releases", "gauge", "Releases, by the state of their waves", releases),
        ("clips", "gauge", "Clips that are stored", one(clips.stored)),
        ("clip_bytes", "gauge", "Bytes of the clips that are stored", one(clips.bytes)),
        ("removed_clips_total", "counter", "Clips that were removed", one(clips.removed)),
        ("age_lag_seconds", "gauge", "Clock of the machine less that of ages", lag),
        ("write_seconds", "summary", "Transactions of what vehicles send", writes()),
        ("http_answers_total", "counter", "Answers, by HTTP status", answers()),
    ] {
        let name = format!("gleaner_cloud_{name}");
        let _ = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
        for (labels, value) in samples {
            let _ = writeln!(text, "{name}{labels} {value}");
        }
    }
    Ok(([(header::CONTENT_TYPE, TEXT)], text).into_response())
}

/// Returns a sample of each state, also of one that nothing has.
fn by_state(counts: &[(String, i64)], states: [&str; 4]) -> Vec<Sample> {
    let count = |state: &str| counts.iter().find(|it| it.0 == state).map_or(0, |it| it.1);
    states.map(|it| (format!("{{state=\"{it}\"}}"), count(it) as f64)).into()
}

/// Returns the sum of latencies in s, and their number.
fn writes() -> Vec<Sample> {
    let seconds = COUNTS.write_us.read() as f64 / 1e6;
    vec![("_sum".to_owned(), seconds), ("_count".to_owned(), COUNTS.writes.read() as f64)]
}

fn answers() -> Vec<Sample> {
    let counts = COUNTS.answers.iter().map(Count::read).enumerate().filter(|it| it.1 > 0);
    counts.map(|(code, count)| (format!("{{code=\"{code}\"}}"), count as f64)).collect()
}
