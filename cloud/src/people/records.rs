//! Records of a vehicle in the order of their arrival, those of each piece by their times: as lines
//! of JSON, or as server-sent events for a client that accepts these. It goes on after a lost
//! connection by `Last-Event-ID`.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::extract::{Path, Query};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use futures_util::stream::try_unfold;
use gleaner_protocol::vehicle_api::{LinePlace, in_order};
use schemars::JsonSchema;
use serde::Deserialize;
use tokio::sync::watch;
use tokio::time::sleep;

use super::{Actor, bearer};
use crate::cloud::{Call, Cloud};
use crate::error::{CloudError, CloudResult};
use crate::live_streams::TailReader;
use crate::readers::{ReaderSlot, ReaderToken};
use crate::store::TokenUser;

/// Number of lines in a piece that has none of chunks.
const PIECE: i64 = 256;

/// Time without a record after which a sign of life is sent among events.
const QUIET: Duration = Duration::from_secs(10);

const EVENTS: &str = "text/event-stream";

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

/// The records that a path names: those of a lambda, or the events of a vehicle.
#[derive(Debug, Deserialize)]
pub(super) struct RecordPath {
    name: String,
    id: Option<String>,
}

struct RecordReader {
    cloud: Arc<Cloud>,
    vehicle: String,
    streams: [String; 2],
    from: u64,
    /// Number of the last arrival that was sent.
    arrival: i64,
    is_events: bool,
    first: Vec<String>,
    /// Lines about what was removed so far.
    removed: Vec<String>,
    arrivals: Option<watch::Receiver<()>>,
    slot: ReaderSlot,
    token: ReaderToken,
    /// Lets the vehicle send at once what is followed.
    _tail: Option<TailReader>,
}

pub(super) async fn lines(
    Call(cloud, TokenUser { user, .. }): Actor,
    Path(RecordPath { name: vehicle, id }): Path<RecordPath>,
    Query(query): Query<RecordQuery>,
    headers: HeaderMap,
) -> CloudResult<Response> {
    let streams = match id {
        Some(id) => {
            let stream = format!("lambdas/{id}");
            [stream.clone(), stream]
        }
        None if query.from.is_some() => {
            let message = "`from` counts records of one stream, and these are several";
            return Err(CloudError::usage(message, "use `last`"));
        }
        None => ["events", "orchestrator"].map(str::to_owned),
    };
    let accepts = |value: &header::HeaderValue| value.to_str().is_ok_and(|it| it.contains(EVENTS));
    let is_events = headers.get(header::ACCEPT).is_some_and(accepts);
    let slot = cloud.readers.open(&user.name)?;
    let token = ReaderToken::new(bearer(&headers).unwrap_or_default(), &user);
    // Before the first look, so that nothing arrives in between.
    let arrivals = query.follow.then(|| cloud.hub.arrivals(&vehicle));
    let from = query.from.unwrap_or(0);
    cloud.store.vehicle_exists(&vehicle).await?;
    let names = streams.each_ref().map(|name| &**name);
    let removed = cloud.store.removed(&vehicle, names, from).await?;
    let tail = query.follow.then(|| cloud.live_streams.read(&vehicle, &streams));
    let mut reader = RecordReader {
        cloud,
        vehicle,
        streams,
        from,
        arrival: 0,
        is_events,
        first: removed.clone(),
        removed,
        arrivals,
        slot,
        token,
        _tail: tail,
    };
    let last_event = headers.get("last-event-id").filter(|_| is_events);
    reader.begin(last_event, query.last).await?;
    let pieces = try_unfold(reader, RecordReader::next);
    let kind = if is_events { EVENTS } else { "application/x-ndjson" };
    let headers = [
        (header::CONTENT_TYPE, kind),
        (header::HeaderName::from_static("x-accel-buffering"), "no"),
    ];
    Ok((headers, Body::from_stream(pieces)).into_response())
}

impl RecordReader {
    /// Moves to the position after the last event that a client has, or before the newest records.
    async fn begin(
        &mut self,
        last_event: Option<&header::HeaderValue>,
        last: Option<usize>,
    ) -> CloudResult<()> {
        let names = self.streams.each_ref().map(|name| &**name);
        let (cloud, vehicle) = (&self.cloud, &self.vehicle);
        let has_all = match (last_event, last) {
            (Some(id), _) => {
                let id = id.to_str().ok().and_then(|id| id.parse().ok());
                let help = "use the id of an event of this stream as it is";
                let wrong = || CloudError::usage("the header `Last-Event-ID` has no id", help);
                self.arrival = id.filter(|id: &i64| *id >= 0).ok_or_else(wrong)?;
                // What was removed is news unless a record before the position is still kept.
                let oldest = cloud.store.oldest_arrival(vehicle, names, self.from).await?;
                oldest.is_some_and(|oldest| oldest <= self.arrival)
            }
            (None, Some(last)) => {
                self.arrival = cloud.records.arrival_before(vehicle, names, last).await?;
                self.arrival > 0
            }
            (None, None) => false,
        };
        if has_all {
            self.first.clear();
        }
        Ok(())
    }

    /// Returns the next piece; `None` at the end.
    async fn next(mut self) -> Result<Option<(String, Self)>, std::io::Error> {
        loop {
            let failed = |error: CloudError| std::io::Error::other(error.reason());
            if self.slot.has_ended()
                || !self.token.is_valid(&self.cloud.store).await.map_err(failed)?
            {
                return Ok(None);
            }
            let mut lines = std::mem::take(&mut self.first);
            let names = self.streams.each_ref().map(|name| &**name);
            let (from, after) = (self.from, self.arrival);
            let page =
                self.cloud.records.record_page(&self.vehicle, names, from, after, PIECE).await;
            let page = page.map_err(failed)?;
            lines.extend(self.removed_since(after).await.map_err(failed)?);
            self.arrival = page.arrival;
            lines.extend(page.lines);
            // Only the last line of a piece has a position: the others may be in any order.
            if self.streams[0] != self.streams[1] {
                lines = in_order(lines, |line| LinePlace::of_json(line));
            }
            if !lines.is_empty() {
                return Ok(Some((self.text(&lines), self)));
            }
            // It closes when the server stops.
            let Some(arrivals) = &mut self.arrivals else { return Ok(None) };
            tokio::select! {
                changed = arrivals.changed() => if changed.is_err() {
                    return Ok(None);
                },
                () = self.slot.ended() => return Ok(None),
                () = self.token.ended(&self.cloud.store) => return Ok(None),
                () = sleep(QUIET), if self.is_events => return Ok(Some((":\n\n".to_owned(), self))),
            }
        }
    }

    /// Returns lines about records that were removed since the last look, unless records before a
    /// position are still kept: then none of those after it are missing.
    async fn removed_since(&mut self, position: i64) -> CloudResult<Vec<String>> {
        let names = self.streams.each_ref().map(|name| &**name);
        let store = &self.cloud.store;
        let removed = store.removed(&self.vehicle, names, self.from).await?;
        if removed == self.removed {
            return Ok(Vec::new());
        }
        let oldest = store.oldest_arrival(&self.vehicle, names, self.from).await?;
        self.removed = removed;
        let is_missing = oldest.is_none_or(|oldest| oldest > position);
        Ok(if is_missing { self.removed.clone() } else { Vec::new() })
    }

    /// Returns lines as they are sent. The last event of a piece has the position after it: a
    /// client that lost a part of the piece gets all of it again.
    fn text(&self, lines: &[String]) -> String {
        if !self.is_events {
            return lines.iter().flat_map(|line| [&**line, "\n"]).collect();
        }
        let mut text = String::new();
        for (index, line) in lines.iter().enumerate() {
            if index + 1 == lines.len() {
                text += &format!("id: {}\n", self.arrival);
            }
            // Those of earlier versions may have a carriage return, which would end the field.
            text += &format!("data: {}\n\n", line.replace('\r', " "));
        }
        text
    }
}
