//! The time line of a vehicle, and the records of one lambda: the newest first, followed by a
//! stream.

use axum::extract::{Path, Query};
use gleaner_protocol::vehicle_api::{LinePlace, in_order};
use maud::{Markup, html};
use serde::Deserialize;

use super::clips;
use super::layout::{self, PageResult, empty};
use super::line::line;
use super::search::SearchPart;
use super::session::{Call, Visit};
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

#[derive(Debug, Clone, Deserialize)]
pub(super) struct RecordSource {
    #[serde(rename = "name")]
    pub(super) vehicle: String,
    /// Id of the deployment whose lambda has them; without one, the time line of the vehicle.
    #[serde(rename = "id")]
    pub(super) lambda: Option<String>,
}

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
            let mut newest = cloud.records.newest(&self.vehicle, &streams, range, READ).await?;
            newest.lines.retain(|(_, line)| super::line::is_of_time_line(line));
            newest.has_more |= newest.lines.len() > most;
            newest.lines.truncate(most);
            return Ok(newest);
        };
        let stream = [format!("lambdas/{lambda}")];
        cloud.records.newest(&self.vehicle, &stream, range, most).await
    }

    /// Returns the streams that its vehicle sends at once while it is followed: a time line has no
    /// log lines, and everything else of lambdas does not wait.
    pub(super) fn followed(&self) -> Vec<String> {
        match &self.lambda {
            None => ["events", "orchestrator"].map(str::to_owned).into(),
            Some(lambda) => vec![format!("lambdas/{lambda}")],
        }
    }

    /// Renders lines that came the newest first, those of several streams by their times.
    pub(super) fn lines<L: AsRef<str>>(
        &self,
        newest_first: impl DoubleEndedIterator<Item = L>,
    ) -> Markup {
        let lines = in_order(newest_first.rev(), |line| LinePlace::of_json(line.as_ref()));
        html! { @for text in lines.iter().rev() { (line(text.as_ref(), self.lambda.is_none())) } }
    }

    fn path(&self) -> String {
        let vehicle = vehicle_path(&self.vehicle);
        match &self.lambda {
            None => format!("{vehicle}/events"),
            Some(id) => format!("{vehicle}/lambdas/{}", segment(id)),
        }
    }
}

pub(super) async fn page(
    Call(cloud, user): Visit,
    Path(source): Path<RecordSource>,
    Query(RecordPart { before, search }): Query<RecordPart>,
) -> PageResult {
    let vehicle = find(&cloud, &source.vehicle).await?;
    // Reading takes memory.
    let _slot = cloud.page_readers.open(&user.user.name)?;
    let (here, up) = (source.path(), vehicle_path(&vehicle.name));
    let is_search = search.is_search();
    let records = match is_search {
        true => search.found(&cloud, &source, &here).await?,
        false => newest_before(&cloud, &source, &here, before).await?,
    };
    let title = source.lambda.as_deref().map_or("Time line".to_owned(), shown);
    let title = if is_search { format!("Search in {title}") } else { title };
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
        } @else {
            p.help { "Log lines, triggers, starts and ends, the newest first; times are in UTC." }
        }
        (search.form(&here))
        (records)
    };
    let title = format!("{title} of {}", vehicle.name);
    Ok(layout::page(&title, "/vehicles", Some(&user), body))
}

/// Renders the newest records, or those that came before others.
async fn newest_before(
    cloud: &Cloud,
    source: &RecordSource,
    here: &str,
    before: Option<i64>,
) -> CloudResult<Markup> {
    let newest = source.newest(cloud, (0, before.unwrap_or(i64::MAX)), SIZE).await?;
    let is_newest = before.is_none();
    let clips = match source.lambda {
        None => clips_of(cloud, &source.vehicle, !is_newest, &newest).await?,
        Some(_) => html! {},
    };
    Ok(html! {
        @if source.lambda.is_none() {
            div id="clips" hx-get=[is_newest.then_some(here)]
                hx-trigger=[is_newest.then_some("every 10s")]
                hx-select="#clips" hx-swap="outerHTML" {
                (clips)
            }
        }
        @if is_newest {
            (followed(source, here, &newest))
        } @else {
            p { a href=(here) { "Go to the newest" } }
            div.lines role="region" aria-label="Records" tabindex="0" {
                (source.lines(newest.texts()))
            }
            @if newest.lines.is_empty() { (empty("There are no older ones.")) }
        }
        @if let Some(before) = older(&newest) {
            nav.pages aria-label="Parts of the list" {
                a href=(format!("{here}{}", query(&[("before", &before.to_string())]))) { "Older" }
            }
        }
    })
}

/// Renders the clips of the time that these records are of; without an end, if they are the newest.
async fn clips_of(
    cloud: &Cloud,
    vehicle: &str,
    has_end: bool,
    newest: &NewestRecords,
) -> CloudResult<Markup> {
    let times = newest.texts().map(|line| LinePlace::of_json(line).time_ns);
    let times: Vec<_> = times.filter(|time| *time != 0).collect();
    let query = ClipQuery {
        vehicle: Some(vehicle.to_owned()),
        // Without older records, all clips from before are of this part.
        from_ns: times.iter().copied().min().filter(|_| newest.has_more),
        to_ns: times.iter().copied().max().filter(|_| has_end),
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
                data-lost="Connection lost; reconnecting." {
                noscript { "Without scripts, load the page again for new records." }
            }
            div.lines role="log" aria-label="Records" aria-live="polite" tabindex="0"
                sse-swap="records" hx-swap="afterbegin" {
                (source.lines(newest.texts()))
                @if newest.lines.is_empty() { (empty("There are no records yet.")) }
            }
        }
    }
}
