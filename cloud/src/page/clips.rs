//! Clips of the fleet: their list, and those of a time line, each with its thumbnail.

use axum::extract::Query;
use gleaner_fleet::clips::{ClipId, ClipState, FleetClip};
use maud::{Markup, html};
use serde::Deserialize;

use super::layout::{self, PageResult, empty};
use super::session::{Call, Visit};
use super::text::{bytes, moment, query, segment, shown};
use crate::request::PageLimit;
use crate::store::ClipQuery;

/// Number of clips on a page.
const SIZE: PageLimit = PageLimit::of(24);
/// Maximum number of labels that are shown of a clip in a list.
const LABELS_MAX: usize = 4;

/// The filters and the part of the list, as the address has them.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct ClipPart {
    vehicle: String,
    lambda: String,
    label: String,
    after: Option<u64>,
}

impl ClipPart {
    fn clips(&self) -> ClipQuery {
        ClipQuery {
            vehicle: Some(self.vehicle.trim().to_owned()),
            lambda: Some(self.lambda.trim().to_owned()),
            label: Some(self.label.trim().to_owned()),
            after: self.after,
            limit: SIZE,
            ..ClipQuery::default()
        }
    }

    /// Returns the address of a part of the same list.
    fn address(&self, after: Option<u64>) -> String {
        let after = after.map_or(String::new(), |after| after.to_string());
        let values = [
            ("vehicle", &*self.vehicle),
            ("lambda", &self.lambda),
            ("label", &self.label),
            ("after", &after),
        ];
        format!("/clips{}", query(&values))
    }
}

pub(super) async fn page(Call(cloud, user): Visit, Query(part): Query<ClipPart>) -> PageResult {
    let found = cloud.store.clips(&part.clips()).await?;
    let here = part.address(part.after);
    let next = found.next.as_ref().and_then(|next| next.parse().ok());
    let body = html! {
        h1 { "Clips" }
        (filters(&part))
        div id="clips" hx-get=(here) hx-trigger="every 10s" hx-select="#clips"
            hx-swap="outerHTML" {
            @if found.items.is_empty() {
                (empty("No clip fits. Vehicles announce their clips here once they are finished."))
            }
            (grid(&found.items, true))
        }
        nav.pages aria-label="Parts of the list" {
            @if part.after.is_some() { a href=(part.address(None)) { "Newest" } }
            @if let Some(next) = next { a href=(part.address(Some(next))) { "Older" } }
        }
    };
    Ok(layout::page("Clips", "/clips", Some(&user), body))
}

fn filters(part: &ClipPart) -> Markup {
    let fields = [
        ("vehicle", "Vehicle", &part.vehicle, "car-7"),
        ("lambda", "Lambda", &part.lambda, "brake-dark"),
        ("label", "Label", &part.label, "hard-brake"),
    ];
    html! {
        form.filters method="get" action="/clips" role="search" aria-label="Clips" {
            @for (name, title, value, example) in fields {
                div {
                    label for=(name) { (title) }
                    input id=(name) name=(name) value=(shown(value)) placeholder=(example);
                }
            }
            div { button { "Show" } " " a href="/clips" { "Show all" } }
        }
    }
}

/// Renders clips as a grid of cards; `has_vehicle` adds the name of the vehicle.
pub(super) fn grid(clips: &[FleetClip], has_vehicle: bool) -> Markup {
    html! {
        @if !clips.is_empty() {
            ul.clips aria-label="Clips" {
                @for clip in clips { li { (card(clip, has_vehicle)) } }
            }
        }
    }
}

fn card(clip: &FleetClip, has_vehicle: bool) -> Markup {
    let facts = &clip.facts;
    html! {
        a.clip href=(clip_path(&clip.id)) {
            (image(clip, ""))
            span.labels {
                b { (title(clip)) }
                @if has_vehicle { " " span.dim { "of " (shown(&clip.vehicle)) } }
            }
            span.dim { (moment(facts.from_ns)) }
            span.dim { (length(clip)) ", " (bytes(facts.bytes as f64)) }
            (state(clip))
        }
    }
}

/// Renders the thumbnail of a clip, or a box of its size.
pub(super) fn image(clip: &FleetClip, words: &str) -> Markup {
    html! {
        @if clip.has_thumbnail {
            img src=(format!("{}/thumbnail", clip_path(&clip.id))) alt=(words) loading="lazy";
        } @else {
            span.imageless { "no image" }
        }
    }
}

pub(super) fn title(clip: &FleetClip) -> String {
    let mut labels: Vec<&str> = Vec::new();
    for moment in &clip.facts.moments {
        if !labels.contains(&&*moment.label) {
            labels.push(&moment.label);
        }
    }
    let more = labels.len().saturating_sub(LABELS_MAX);
    labels.truncate(LABELS_MAX);
    match (labels.is_empty(), more) {
        (true, _) => "without a trigger".to_owned(),
        (false, 0) => shown(&labels.join(", ")),
        (false, more) => format!("{} and {more} more", shown(&labels.join(", "))),
    }
}

pub(super) fn length(clip: &FleetClip) -> String {
    format!("{:.1} s", clip.facts.to_ns.saturating_sub(clip.facts.from_ns) as f64 / 1e9)
}

pub(super) fn state(clip: &FleetClip) -> Markup {
    let (class, words) = match clip.state {
        ClipState::OnVehicle => ("other", "on the vehicle".to_owned()),
        ClipState::Wanted => ("waiting", "wanted".to_owned()),
        ClipState::Uploading => {
            let percent = clip.received.saturating_mul(100) / clip.facts.bytes.max(1);
            ("waiting", format!("on its way, {percent} %"))
        }
        ClipState::Stored => ("running", "in the cloud".to_owned()),
        ClipState::Gone => ("failed", "gone".to_owned()),
        ClipState::Failed => ("failed", "failed".to_owned()),
    };
    html! { span class={ "state " (class) } { (words) } }
}

pub(super) fn clip_path(id: &ClipId) -> String {
    format!("/clips/{}", segment(&id.to_string()))
}
