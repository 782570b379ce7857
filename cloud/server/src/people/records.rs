//! Records of a vehicle, as lines of JSON in the order of their arrival.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::{Extension, Path, Query, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use futures_util::stream::try_unfold;
use gleaner_fleet::people::User;
use schemars::JsonSchema;
use serde::Deserialize;
use tokio::sync::watch;

use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};
use crate::readers::ReaderSlot;

/// Number of lines in a piece.
const PIECE: i64 = 256;

/// Choice of the records of a stream, as on a vehicle.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct RecordQuery {
    /// Number of the first record; without one, the oldest that is kept.
    from: Option<u64>,
    /// Number of the newest records to send instead.
    last: Option<usize>,
    /// True to go on with new records until the client closes the connection.
    #[serde(default)]
    follow: bool,
}

/// Reads records piece by piece.
struct RecordReader {
    cloud: Arc<Cloud>,
    vehicle: String,
    streams: [String; 2],
    from: u64,
    /// Number of the last arrival that was sent.
    arrival: i64,
    /// Lines to send first.
    first: Vec<String>,
    arrivals: Option<watch::Receiver<()>>,
    slot: ReaderSlot,
}

pub(super) async fn events(
    State(cloud): State<Arc<Cloud>>,
    Extension(user): Extension<User>,
    Path(name): Path<String>,
    Query(query): Query<RecordQuery>,
) -> CloudResult<Response> {
    if query.from.is_some() {
        let message = "`from` counts records of one stream, and these are several";
        return Err(CloudError::usage(message, "use `last`"));
    }
    lines((cloud, user), name, ["events".to_owned(), "orchestrator".to_owned()], query).await
}

pub(super) async fn lambda(
    State(cloud): State<Arc<Cloud>>,
    Extension(user): Extension<User>,
    Path((name, id)): Path<(String, String)>,
    Query(query): Query<RecordQuery>,
) -> CloudResult<Response> {
    let stream = format!("lambdas/{id}");
    lines((cloud, user), name, [stream.clone(), stream], query).await
}

async fn lines(
    (cloud, user): (Arc<Cloud>, User),
    vehicle: String,
    streams: [String; 2],
    query: RecordQuery,
) -> CloudResult<Response> {
    let slot = cloud.readers.open(&user.name)?;
    // Before the first look, so that nothing arrives in between.
    let arrivals = query.follow.then(|| cloud.hub.arrivals(&vehicle));
    let names = [&*streams[0], &*streams[1]];
    let from = query.from.unwrap_or(0);
    let mut first = cloud.store.removed(&vehicle, names, from).await?;
    let arrival = match query.last {
        Some(last) => cloud.store.arrival_before(&vehicle, names, last).await?,
        None => 0,
    };
    if arrival > 0 {
        first.clear();
    }
    let reader = RecordReader { cloud, vehicle, streams, from, arrival, first, arrivals, slot };
    let pieces = try_unfold(reader, RecordReader::next);
    Ok(([(header::CONTENT_TYPE, "application/x-ndjson")], Body::from_stream(pieces))
        .into_response())
}

impl RecordReader {
    /// Returns the next piece; `None` at the end.
    async fn next(mut self) -> Result<Option<(String, Self)>, std::io::Error> {
        loop {
            if self.slot.has_ended() {
                return Ok(None);
            }
            let mut lines = std::mem::take(&mut self.first);
            let names = self.streams.each_ref().map(|name| &**name);
            let store = &self.cloud.store;
            let page = store.page(&self.vehicle, names, self.from, self.arrival, PIECE).await;
            let page = page.map_err(|error| std::io::Error::other(error.reason()))?;
            self.arrival = page.arrival;
            lines.extend(page.lines);
            if !lines.is_empty() {
                let text: String = lines.iter().flat_map(|line| [&**line, "\n"]).collect();
                return Ok(Some((text, self)));
            }
            // It closes when the server stops.
            let Some(arrivals) = &mut self.arrivals else { return Ok(None) };
            tokio::select! {
                changed = arrivals.changed() => if changed.is_err() {
                    return Ok(None);
                },
                () = self.slot.ended() => return Ok(None),
            }
        }
    }
}
