//! Streams of records: server-sent events, each with the number of its last arrival, after which a
//! browser goes on when it connects again.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Path, Query};
use axum::http::HeaderMap;
use axum::response::IntoResponse;
use axum::response::sse::{Event, Sse};
use futures_util::stream::unfold;
use maud::html;
use serde::Deserialize;
use tokio::sync::watch;
use tokio::time::sleep;

use super::layout::PageResult;
use super::records::RecordSource;
use super::session::{Call, PageUser, Visit};
use crate::cloud::Cloud;
use crate::live_streams::TailReader;
use crate::readers::{ReaderSlot, next_look};

/// Maximum number of records in a message.
const MESSAGE_MAX: usize = 100;
/// Least time between two messages.
const PAUSE: Duration = Duration::from_millis(500);
/// Time without a record after which a sign of life is sent.
const QUIET: Duration = Duration::from_secs(10);

/// The start of a stream, as the address has it.
#[derive(Debug, Deserialize)]
pub(super) struct StreamStart {
    after: Option<i64>,
}

struct RecordFollower {
    cloud: Arc<Cloud>,
    user: PageUser,
    source: RecordSource,
    position: i64,
    arrivals: watch::Receiver<()>,
    slot: ReaderSlot,
    /// Lets the vehicle send at once what is followed.
    _tail: TailReader,
}

pub(super) async fn follow(
    Call(cloud, user): Visit,
    Path(source): Path<RecordSource>,
    Query(start): Query<StreamStart>,
    headers: HeaderMap,
) -> PageResult {
    let slot = cloud.readers.open(&user.user.name)?;
    let last = headers.get("last-event-id").and_then(|it| it.to_str().ok()?.parse().ok());
    let position = last.or(start.after).unwrap_or(0);
    // Before the first look, so that nothing arrives in between.
    let mut arrivals = cloud.hub.arrivals(&source.vehicle);
    arrivals.mark_changed();
    let tail = cloud.live_streams.read(&source.vehicle, &source.followed());
    let follower = RecordFollower { cloud, user, source, position, arrivals, slot, _tail: tail };
    let events = unfold(follower, RecordFollower::next);
    // Asks proxies not to keep events back.
    Ok(([("x-accel-buffering", "no")], Sse::new(events)).into_response())
}

impl RecordFollower {
    /// Returns the next event; `None` at the end: of the server, or of the session.
    async fn next(mut self) -> Option<(Result<Event, Infallible>, Self)> {
        let quiet = sleep(QUIET);
        tokio::pin!(quiet);
        loop {
            tokio::select! {
                changed = self.arrivals.changed() => match changed {
                    Ok(()) => break,
                    Err(_) => return None,
                },
                // Also without an arrival that was noticed: a record may have come another way.
                () = &mut quiet => break,
                () = self.slot.ended() => return None,
                () = next_look() => if !self.user.is_current(&self.cloud).await {
                    return None;
                },
            }
        }
        if !self.user.is_current(&self.cloud).await {
            return None;
        }
        let event = self.message().await?;
        Some((Ok(event), self))
    }

    async fn message(&mut self) -> Option<Event> {
        let range = (self.position, i64::MAX);
        let newest = self.source.newest(&self.cloud, range, MESSAGE_MAX).await.ok()?;
        self.position = newest.position;
        if newest.lines.is_empty() {
            return Some(Event::default().comment("nothing new"));
        }
        let markup = html! {
            (self.source.lines(newest.texts()))
            @if newest.has_more {
                div.line { span.kind.warn { "left out" } span.words {
                    "More records came at once than are shown here: load the page again, and go to \
                     older ones." } }
            }
        };
        // A vehicle that sends more does not make a browser busy.
        sleep(PAUSE).await;
        let id = self.position.to_string();
        Some(Event::default().event("records").id(id).data(markup.into_string()))
    }
}
