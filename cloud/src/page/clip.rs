//! One clip: its facts, its thumbnail, its file, and the report of what is in it.

use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Redirect};
use gleaner_fleet::clips::{
    ClipFacts, ClipId, ClipMoment, ClipState, FleetClip, RecordedLambda, THUMBNAIL_MAX,
};
use gleaner_fleet::people::Role;
use maud::{Markup, html};

use super::account::CompletedChange;
use super::charts;
use super::clips::{clip_path, image, length, state, title};
use super::layout::{self, PageResult, done, form};
use super::recording::{self, Recording, TOPICS_MAX, whole};
use super::session::{Call, PageUser, Visit};
use super::text::{self, bytes, count, moment, segment, shown, vehicle_path};
use crate::clips::is_thumbnail;
use crate::cloud::Services;
use crate::error::{CloudError, CloudResult};

/// The image in the place of a thumbnail that is lost or damaged: a page has no broken image.
const NO_IMAGE: &str = r##"<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 160 90">
<rect width="160" height="90" fill="#8883"/><text x="80" y="50" text-anchor="middle"
font-family="sans-serif" font-size="12" fill="#888">no image</text></svg>"##;
/// Maximum number of attributes of a trigger that are shown.
const ATTRIBUTES_MAX: usize = 16;

pub(super) async fn page(
    Call(cloud, user): Visit,
    Path(id): Path<String>,
    Query(query): Query<CompletedChange>,
) -> PageResult {
    let clip = cloud.store.clip(&parse(&id)?).await?;
    let recording = match clip.state {
        ClipState::Stored => {
            // Reading takes memory.
            let _slot = cloud.page_readers.open(&user.user.name)?;
            // A file that is lost is no reason to hide the facts.
            recording::read(&cloud.clips, &clip).await.ok().flatten()
        }
        _ => None,
    };
    let (vehicle, here) = (vehicle_path(&clip.vehicle), clip_path(&clip.id));
    let title = title(&clip);
    let is_on_its_way = matches!(clip.state, ClipState::Wanted | ClipState::Uploading);
    let body = html! {
        nav.crumbs aria-label="Path" {
            a href="/vehicles" { "Fleet" } " / " a href=(vehicle) { (shown(&clip.vehicle)) }
            " / " a href=(format!("{vehicle}/events")) { "Time line" }
        }
        h1 { (title) " " span.dim { "of " (shown(&clip.vehicle)) } }
        (done(query.done.as_deref()))
        (warnings(&clip.facts))
        div.pair {
            section.card aria-label="Image" {
                figure.thumbnail { (image(&clip, &format!("The moment of {title}"))) }
            }
            section.card aria-labelledby="facts" {
                h2 id="facts" { "Facts" }
                (facts(&clip))
            }
        }
        section.card aria-labelledby="file" id="clip-file"
            hx-get=[is_on_its_way.then_some(&here)] hx-trigger=[is_on_its_way.then_some("every 3s")]
            hx-select=[is_on_its_way.then_some("#clip-file")]
            hx-swap=[is_on_its_way.then_some("outerHTML")] {
            h2 id="file" { "File" }
            (file_part(&clip, &user, &here))
        }
        (moments(&clip))
        @if clip.state == ClipState::Stored { (recorded(recording.as_ref())) }
    };
    Ok(layout::page(&format!("{title} of {}", clip.vehicle), "/clips", Some(&user), body))
}

/// Answers with the thumbnail, once it is what it claims to be. Its type is never guessed.
pub(super) async fn thumbnail(State(cloud): Services, Path(id): Path<String>) -> PageResult {
    let reply = match parse(&id) {
        Ok(id) => cloud.clips.thumbnail(&id).await,
        Err(error) => Err(error),
    };
    let bytes = match reply {
        Ok(reply) => whole(reply, THUMBNAIL_MAX).await.unwrap_or_default(),
        Err(error) if error.is_internal() => return Err(error.into()),
        Err(_) => Vec::new(),
    };
    if !is_thumbnail(&bytes) {
        let headers = [(header::CONTENT_TYPE, "image/svg+xml")];
        return Ok((StatusCode::NOT_FOUND, headers, NO_IMAGE).into_response());
    }
    let headers =
        [(header::CONTENT_TYPE, "image/jpeg"), (header::CACHE_CONTROL, "private, max-age=600")];
    Ok((headers, bytes).into_response())
}

pub(super) async fn file(
    Call(cloud, user): Visit,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> PageResult {
    let clip = parse(&id)?;
    let slot = cloud.transfers.open(&user.user.name)?;
    let reply = cloud.clips.recording(&clip, &headers, slot).await?;
    // Names of clips are letters, digits and `._-`.
    let name = format!("attachment; filename=\"{}.mcap\"", clip.name());
    Ok(([(header::CONTENT_DISPOSITION, name)], reply).into_response())
}

pub(super) async fn pull(Call(cloud, user): Visit, Path(id): Path<String>) -> PageResult {
    let id = parse(&id)?;
    cloud.clips.pull(&user.user.name, &id).await?;
    Ok(Redirect::to(&format!("{}?done=clip", clip_path(&id))).into_response())
}

fn parse(id: &str) -> CloudResult<ClipId> {
    id.parse().map_err(|reason: String| CloudError::missing(reason, "choose one from the list"))
}

fn warnings(facts: &ClipFacts) -> Markup {
    html! {
        @if facts.is_recovered {
            p.banner { "The recorder died while it wrote the clip, which was recovered later." }
        }
        @for reason in &facts.incomplete { p.banner { "Incomplete: " (shown(reason)) } }
    }
}

fn facts(clip: &FleetClip) -> Markup {
    let ClipFacts { from_ns, lambdas, triggers, sha256, .. } = &clip.facts;
    html! {
        dl {
            dt { "Name" } dd { code { (clip.id.name()) } }
            dt { "Begin" } dd { (moment(*from_ns)) }
            dt { "Length" } dd { (length(clip)) }
            dt { "Size" } dd { (bytes(clip.facts.bytes as f64)) }
            dt { "Triggers" } dd { (gleaner_base::grouped(*triggers)) }
            dt { "Lambdas" } dd {
                @for (index, it) in lambdas.iter().enumerate() {
                    @if index > 0 { ", " }
                    (lambda(clip, it))
                }
            }
            @if let Some(sha256) = sha256 { dt { "SHA-256" } dd { code { (shown(sha256)) } } }
        }
    }
}

/// Renders a lambda, with a link to its records if its deployment is known.
fn lambda(
    clip: &FleetClip,
    RecordedLambda { name, version, deployment, .. }: &RecordedLambda,
) -> Markup {
    let page = |id: &String| format!("{}/lambdas/{}", vehicle_path(&clip.vehicle), segment(id));
    html! {
        @match deployment {
            Some(id) => a href=(page(id)) { (shown(name)) },
            None => (shown(name)),
        }
        " " span.dim { (shown(version)) }
    }
}

fn file_part(clip: &FleetClip, user: &PageUser, here: &str) -> Markup {
    let may_pull = user.user.role >= Role::Operator;
    let words = match clip.state {
        ClipState::OnVehicle if may_pull => "Only the vehicle has the file.",
        ClipState::OnVehicle => "Only the vehicle has the file. Operators can fetch it.",
        ClipState::Wanted | ClipState::Uploading => {
            "The vehicle sends it when it is connected and has bytes left for today."
        }
        ClipState::Stored => "Stored in the cloud; its checksum matches.",
        ClipState::Gone => "The vehicle deleted it before it was fetched.",
        ClipState::Failed => "The vehicle has sent another file than announced.",
    };
    let can_be_pulled = may_pull && matches!(clip.state, ClipState::OnVehicle | ClipState::Failed);
    html! {
        p { (state(clip)) }
        p.help { (words) @if let Some(reason) = &clip.reason { " " (shown(reason)) } }
        @if can_be_pulled {
            (form(user, &format!("{here}/pull"), html! { button { "Fetch from the vehicle" } }))
        }
        @if clip.state == ClipState::Stored {
            p { a.button href=(format!("{here}/file")) download { "Download" } }
            p.help {
                "To look at it, download it, and choose \"Open local file\" in Foxglove. Foxglove \
                 cannot open it from here, as the file needs your session."
            }
            p.help { "To check its signature: "
                code { "gleaner verify " (clip.id.name()) ".mcap --trust VEHICLES" } }
        }
    }
}

fn moments(clip: &FleetClip) -> Markup {
    let ClipFacts { moments, from_ns, to_ns, triggers, .. } = &clip.facts;
    let span = to_ns.saturating_sub(*from_ns).max(1) as f64;
    let offset = |moment: &ClipMoment| moment.at_ns.saturating_sub(*from_ns) as f64;
    html! {
        section.card aria-labelledby="moments" {
            h2 id="moments" { "Triggers" }
            @if moments.is_empty() { p.dim { "No triggers." } } @else {
                (charts::ticks(moments.iter().map(|it| offset(it) / span)))
                div.scroll tabindex="0" role="region" aria-label="List of triggers" {
                    table.tight {
                        thead { tr {
                            th.number scope="col" { "Time" }
                            th scope="col" { "Label" } th.number scope="col" { "Score" }
                            th scope="col" { "Lambda" } th scope="col" { "Attributes" }
                        } }
                        tbody { @for it in moments { (row(it, offset(it))) } }
                    }
                }
                @if *triggers > moments.len() as u64 {
                    p.help { "The first of " (count(*triggers, "trigger"))
                        "; the file has all of them." }
                }
            }
        }
    }
}

fn row(moment: &ClipMoment, offset: f64) -> Markup {
    let ClipMoment { lambda, kind, label, score, attributes, source, .. } = moment;
    html! {
        tr {
            td.number { (format!("{:.2} s", offset / 1e9)) }
            th scope="row" {
                @if kind != "event" { (shown(kind)) " " }
                (shown(label))
            }
            td.number { @if let Some(score) = score { (text::score(*score)) } }
            td {
                (shown(lambda))
                @if let Some(source) = source { " " span.dim { "by " (shown(source)) } }
            }
            td.attributes {
                @match attributes {
                    None => span.dim { "too long for the list; the file has them" },
                    Some(all) => {
                        @for (name, value) in all.iter().take(ATTRIBUTES_MAX) {
                            span { (shown(name)) "=" (shown(&value.to_string())) } " "
                        }
                        @if all.len() > ATTRIBUTES_MAX {
                            span.dim { "and " (all.len() - ATTRIBUTES_MAX) " more" }
                        }
                    }
                }
            }
        }
    }
}

fn recorded(recording: Option<&Recording>) -> Markup {
    html! {
        section.card aria-labelledby="topics" {
            h2 id="topics" { "Recording" }
            @match recording {
                None => p.dim {
                    "The file has no list of its topics that can be read here; download it to look \
                     at it."
                },
                Some(recording) => (topics(recording)),
            }
        }
    }
}

fn topics(Recording { messages, span, topics, omitted }: &Recording) -> Markup {
    let [first, last] = span.map(|ns| i64::try_from(ns).unwrap_or(i64::MAX));
    let seconds = last.saturating_sub(first) as f64 / 1e9;
    html! {
        p { (count(*messages, "message")) " from " (moment(first)) " to " (moment(last)) }
        div.scroll tabindex="0" role="region" aria-label="List of topics" {
            table.tight {
                thead { tr {
                    th scope="col" { "Topic" } th.optional scope="col" { "Type" }
                    th.number scope="col" { "Messages" } th.number scope="col" { "Per second" }
                } }
                tbody { @for it in topics { tr {
                    th scope="row" { code { (shown(&it.name)) } }
                    td.optional { (shown(&it.type_name)) }
                    td.number { (gleaner_base::grouped(it.messages)) }
                    td.number {
                        @if seconds > 0.0 { (format!("{:.1}", it.messages as f64 / seconds)) }
                    }
                } } }
            }
        }
        @if *omitted > 0 {
            p.help { "The first " (TOPICS_MAX) "; " (omitted) " more are not shown." }
        }
    }
}
