//! The time line of a vehicle, and the records of one lambda: the newest first, followed by a
//! stream.

use std::sync::Arc;

use axum::extract::{Extension, Path, Query, State};
use maud::{Markup, html};
use serde::Deserialize;

use super::clips;
use super::layout::{self, PageResult, empty};
use super::line::{line, time_ns};
use super::search::SearchPart;
use super::session::PageUser;
use super::text::{query, segment, shown, vehicle_path};
use super::vehicle::find;
use crate::cloud::Cloud;
use crate::error::CloudResult;
use crate::request::PageLimit;
use crate::store::{ClipQuery, NewestRecords};

/// Maximum number of records on a page.
const SIZE: usize = 100;
/// Number of records that are read for a page of the time line, which leaves log lines out.
const READ: usize = 1000;
/// Maximum number of clips above a time line.
const CLIPS: PageLimit = PageLimit::of(12);

#[derive(Debug, Clone)]
pub(super) struct RecordSource {
    pub(super) vehicle: String,
    /// Id of the deployment whose lambda has them; without one, the time line of the vehicle.
    pub(super) lambda: Option<String>,
}

/// The part of the records, as the address has it.
#[derive(Debug, Deserialize)]
pub(super) struct RecordPart {
    before: Option<i64>,
    #[serde(flatten)]
    search: SearchPart,
}

impl RecordSource {
    /// Returns the newest records between two arrivals, without both.
    pub(super) async fn newest(
        &self,
        cloud: &Cloud,
        range: (i64, i64),
        most: usize,
    ) -> CloudResult<NewestRecords> {
        let Some(lambda) = &self.lambda else {
            let streams = cloud.store.streams(&self.vehicle).await?;
            let mut newest = cloud.newest(&self.vehicle, &streams, range, READ).await?;
            newest.lines.retain(|(_, line)| super::line::is_of_time_line(line));
            newest.has_more |= newest.lines.len() > most;
            newest.lines.truncate(most);
            return Ok(newest);
        };
        let stream = [format!("lambdas/{lambda}")];
        cloud.newest(&self.vehicle, &stream, range, most).await
    }

    /// Returns the streams that its vehicle sends at once while it is followed: a time line has no
    /// log lines, and everything else of lambdas does not wait.
    pub(super) fn followed(&self) -> Vec<String> {
        match &self.lambda {
            None => ["events", "orchestrator"].map(str::to_owned).into(),
            Some(lambda) => vec![format!("lambdas/{lambda}")],
        }
    }

    pub(super) fn line(&self, text: &str) -> Markup {
        line(text, self.lambda.is_none())
    }

    fn path(&self) -> String {
        let vehicle = vehicle_path(&self.vehicle);
        match &self.lambda {
            None => format!("{vehicle}/events"),
            Some(id) => format!("{vehicle}/lambdas/{}", segment(id)),
        }
    }
}

pub(super) async fn time_line(
    State(cloud): State<Arc<Cloud>>,
    Extension(user): Extension<PageUser>,
    Path(vehicle): Path<String>,
    Query(part): Query<RecordPart>,
) -> PageResult {
    page(&cloud, &user, RecordSource { vehicle, lambda: None }, &part).await
}

pub(super) async fn lambda(
    State(cloud): State<Arc<Cloud>>,
    Extension(user): Extension<PageUser>,
    Path((vehicle, id)): Path<(String, String)>,
    Query(part): Query<RecordPart>,
) -> PageResult {
    page(&cloud, &user, RecordSource { vehicle, lambda: Some(id) }, &part).await
}

async fn page(
    cloud: &Cloud,
    user: &PageUser,
    source: RecordSource,
    part: &RecordPart,
) -> PageResult {
    let vehicle = find(cloud, &source.vehicle).await?;
    // Reading takes memory.
    let _slot = cloud.page_readers.open(&user.user.name)?;
    let RecordPart { before, search } = part;
    if search.is_search() {
        let here = source.path();
        let title = source.lambda.as_deref().map_or("Time line".to_owned(), shown);
        let title = format!("Search in {title} of {}", shown(&vehicle.name));
        let body = html! {
            nav.crumbs aria-label="Path" {
                a href="/vehicles" { "Fleet" } " / "
                a href=(vehicle_path(&vehicle.name)) { (shown(&vehicle.name)) }
            }
            h1 { (title) }
            (search.form(&here))
            (search.found(cloud, &source, &here).await?)
        };
        return Ok(layout::page(&title, "/vehicles", Some(user), body));
    }
    let newest = source.newest(cloud, (0, before.unwrap_or(i64::MAX)), SIZE).await?;
    let clips = match source.lambda {
        None => clips_of(cloud, &source.vehicle, before.is_some(), &newest).await?,
        Some(_) => html! {},
    };
    let here = source.path();
    let up = vehicle_path(&vehicle.name);
    let title = source.lambda.as_deref().map_or("Time line".to_owned(), shown);
    let body = html! {
        nav.crumbs aria-label="Path" {
            a href="/vehicles" { "Fleet" } " / " a href=(up) { (shown(&vehicle.name)) }
        }
        h1 { (title) " " span.dim { "of " (shown(&vehicle.name)) } }
        @if source.lambda.is_none() {
            nav.tabs aria-label="Vehicle" {
                a href=(up) { "Status" }
                a href=(here) aria-current="page" { "Time line" }
            }
            p.help { "Clips, events and triggers, the newest first; times are in UTC. Log lines \
                      are with their lambda." }
            div id="clips" hx-get=[before.is_none().then_some(&here)]
                hx-trigger=[before.is_none().then_some("every 10s")]
                hx-select="#clips" hx-swap="outerHTML" {
                (clips)
            }
        } @else {
            p.help { "Log lines, triggers, starts and ends, the newest first; times are in UTC." }
        }
        (search.form(&here))
        @if before.is_none() {
            (followed(&source, &here, &newest))
        } @else {
            p { a href=(here) { "Go to the newest" } }
            (lines(&source, &newest))
        }
        @if newest.lines.is_empty() && before.is_some() { (empty("There are no older ones.")) }
        @if let Some(before) = older(&newest) {
            nav.pages aria-label="Parts of the list" {
                a href=(format!("{here}{}", query(&[("before", &before.to_string())]))) { "Older" }
            }
        }
    };
    let title = format!("{title} of {}", vehicle.name);
    Ok(layout::page(&title, "/vehicles", Some(user), body))
}

/// Renders the clips of the time that these records are of; without an end, if they are the newest.
async fn clips_of(
    cloud: &Cloud,
    vehicle: &str,
    has_end: bool,
    newest: &NewestRecords,
) -> CloudResult<Markup> {
    let times = || newest.lines.iter().filter_map(|(_, line)| time_ns(line));
    let query = ClipQuery {
        vehicle: Some(vehicle.to_owned()),
        // Without older records, all clips from before are of this part.
        from_ns: times().min().filter(|_| newest.has_more),
        to_ns: times().max().filter(|_| has_end),
        limit: CLIPS,
        ..ClipQuery::default()
    };
    let found = cloud.store.clips(&query).await?;
    let all = format!("/clips{}", super::text::query(&[("vehicle", vehicle)]));
    Ok(html! {
        @if !found.items.is_empty() {
            (clips::grid(&found.items, false))
            p.help { a href=(all) { "All clips of this vehicle" } }
        }
    })
}

/// Returns the arrival before which older records are, if there may be any.
fn older(newest: &NewestRecords) -> Option<i64> {
    match newest.has_more {
        true => newest.lines.last().map(|(arrival, _)| *arrival).or(Some(newest.oldest_read)),
        false => None,
    }
}

/// Renders records with the stream of those that come after them.
fn followed(source: &RecordSource, here: &str, newest: &NewestRecords) -> Markup {
    let stream = format!("{here}/stream?after={}", newest.position);
    html! {
        div hx-ext="sse" sse-connect=(stream) {
            p.live role="status" data-live="Following: new records appear at the top."
                data-lost="The connection is lost; it is opened again." {
                noscript { "Without scripts, load the page again for new records." }
            }
            div.lines role="log" aria-label="Records" aria-live="polite" tabindex="0"
                sse-swap="records" hx-swap="afterbegin" {
                @for (_, text) in &newest.lines { (source.line(text)) }
                @if newest.lines.is_empty() { (empty("There are no records yet.")) }
            }
        }
    }
}

fn lines(source: &RecordSource, newest: &NewestRecords) -> Markup {
    html! {
        div.lines role="region" aria-label="Records" tabindex="0" {
            @for (_, text) in &newest.lines { (source.line(text)) }
        }
    }
}
