//! Deployments of the fleet, their progress, and their changes. None of them needs a key: what runs
//! was signed elsewhere.

use axum::extract::{Path, Query};
use axum::response::{IntoResponse, Redirect};
use gleaner_fleet::people::{FleetDeployment, Role};
use gleaner_fleet::waves::{WaveProgress, WaveState};
use maud::{Markup, html};

use super::account::CompletedChange;
use super::charts;
use super::layout::{self, PageResult, confirmed, done, empty, form};
use super::session::{Call, PageUser, Visit};
use super::text::{count, deployment_path, label, segment, short, shown, vehicle_path};

/// Maximum number of vehicles that are listed with a deployment.
const VEHICLES_MAX: i64 = 100;

pub(super) async fn list(
    Call(cloud, user): Visit,
    Query(query): Query<CompletedChange>,
) -> PageResult {
    let all = cloud.store.deployments("", u64::MAX).await?;
    let body = html! {
        h1 { "Deployments" }
        (done(query.done.as_deref()))
        div id="deployments" hx-get="/deployments" hx-trigger="every 10s" hx-select="#deployments"
            hx-swap="outerHTML" {
            @if all.is_empty() {
                (empty("There are none yet. A deployer signs one and sends it with \
                        `gleaner deploy --fleet`: keys never come to this page."))
            }
            @for deployment in &all {
                article.card {
                    @let id = &deployment.id;
                    h2 { a id=(format!("d-{id}")) href=(deployment_path(id)) { (shown(id)) } " "
                        (desired(deployment)) }
                    p.dim { "release " (deployment.release) ", to " (selector(deployment)) }
                    (progress(deployment))
                }
            }
        }
    };
    Ok(layout::page("Deployments", "/deployments", Some(&user), body))
}

pub(super) async fn page(
    Call(cloud, user): Visit,
    Path(id): Path<String>,
    Query(query): Query<CompletedChange>,
) -> PageResult {
    let deployment = cloud.store.deployment(&id).await?;
    let reports = cloud.store.reports(&id, &deployment.envelope, VEHICLES_MAX).await?;
    let here = deployment_path(&id);
    let body = html! {
        nav.crumbs aria-label="Path" { a href="/deployments" { "Deployments" } }
        h1 { (shown(&deployment.id)) }
        (done(query.done.as_deref()))
        div id="progress" hx-get=(here) hx-trigger="every 5s" hx-select="#progress"
            hx-swap="outerHTML" {
            section.card aria-label="Progress" {
                p { (desired(&deployment)) }
                (progress(&deployment))
            }
            (vehicles(&reports))
        }
        (content(&deployment))
        (changes(&user, &here, &deployment))
    };
    Ok(layout::page(&deployment.id, "/deployments", Some(&user), body))
}

fn desired(deployment: &FleetDeployment) -> Markup {
    match deployment.is_wanted {
        true => html! { span.state.running { "active" } },
        false => html! { span.state.other { "stopped" } },
    }
}

/// Renders how many of its vehicles run it.
fn progress(deployment: &FleetDeployment) -> Markup {
    let FleetDeployment { vehicles, running, failed, on_fallback, .. } = *deployment;
    let others = vehicles.saturating_sub(running).saturating_sub(failed);
    let rest = if deployment.is_wanted { "pending" } else { "not running" };
    html! {
        @if vehicles == 0 { (empty("No vehicle has all labels of its selector.")) }
        @else {
            (charts::parts("Vehicles", &[
                ("running", "running", running),
                ("failed", "failed or refused", failed.saturating_sub(on_fallback)),
                ("waiting", "run the fallback", on_fallback),
                ("other", rest, others),
            ]))
        }
        @if let Some(waves) = &deployment.waves { (waves_of(waves)) }
    }
}

fn waves_of(waves: &WaveProgress) -> Markup {
    let WaveProgress { wave, waves: all, vehicles, running, failed, reason, .. } = waves;
    let (class, state) = match waves.state {
        WaveState::Running => ("waiting", "in progress"),
        WaveState::Paused => ("failed", "paused"),
        WaveState::Aborted => ("other", "aborted"),
    };
    // A reason names who or what it was, or is a sentence.
    let is_by = ["by ", "as "].iter().any(|start| reason.starts_with(start));
    html! {
        p {
            span.state.(class) { "Wave " (wave) " of " (all) " " (state) }
            @if !reason.is_empty() { (if is_by { " " } else { ": " }) (shown(reason)) }
            span.dim {
                ". Offered to " (count(*vehicles, "vehicle")) " so far: " (running) " running, "
                (failed) " failed. The others keep their release."
            }
        }
    }
}

fn selector(deployment: &FleetDeployment) -> Markup {
    html! {
        @if deployment.selector.is_empty() { "all vehicles" }
        @for pair in &deployment.selector { (label(pair)) }
    }
}

fn vehicles(reports: &[(String, String, String)]) -> Markup {
    html! {
        @if !reports.is_empty() {
            section aria-labelledby="vehicles" {
                h2 id="vehicles" { "Deployed to" }
                ul.columns { @for (vehicle, state, reason) in reports {
                    li {
                        @let (class, text) = match &**state {
                            "running" => ("running", "running"),
                            "failed" => ("failed", "failed or refused"),
                            "fallback" => ("waiting", "runs its fallback"),
                            "pending" => ("waiting", "not fetched yet"),
                            _ => ("other", "not running"),
                        };
                        a id=(format!("v-{vehicle}")) href=(vehicle_path(vehicle)) {
                            (shown(vehicle)) } " "
                        span.state.(class) { (text) }
                        @if !reason.is_empty() { " " span.dim { (shown(reason)) } }
                    }
                } }
                @if reports.len() as i64 >= VEHICLES_MAX {
                    p.dim { "The first " (VEHICLES_MAX) ", those with a failure before others." }
                }
            }
        }
    }
}

fn content(deployment: &FleetDeployment) -> Markup {
    let revision = |digest: &str| {
        html! {
            a href=(format!("/lambdas/{}", segment(digest))) { code { (short(digest)) } }
        }
    };
    let grants = &deployment.grants;
    html! {
        section.card aria-labelledby="content-title" {
            h2 id="content-title" { "Signed deployment" }
            dl {
                dt { "Release" } dd { (deployment.release) }
                dt { "Revision" } dd { (revision(&deployment.revision)) }
                dt { "Fallback" } dd {
                    @match &deployment.fallback {
                        Some(digest) => (revision(digest)),
                        None => span.dim { "none" },
                    }
                }
                dt { "Selector" } dd { (selector(deployment)) }
                dt { "Topics" } dd { (names(&grants.topics)) }
                dt { "Models" } dd { (names(&grants.models)) }
                dt { "Clips" } dd { @if grants.record { "may be recorded" } @else { "none" } }
            }
        }
    }
}

fn names(all: &[String]) -> Markup {
    html! {
        @if all.is_empty() { span.dim { "none" } }
        @for (index, name) in all.iter().take(100).enumerate() {
            @if index > 0 { ", " }
            code { (shown(name)) }
        }
        @if all.len() > 100 { " and " (count(all.len() as u64 - 100, "other")) }
    }
}

fn changes(user: &PageUser, here: &str, deployment: &FleetDeployment) -> Markup {
    let role = user.user.role;
    html! {
        @if role >= Role::Operator {
            section.card.changes aria-labelledby="changes" {
                h2 id="changes" { "Change" }
                @if deployment.is_wanted {
                    (confirmed(user, &format!("{here}/stop"), "Stop",
                        "Each vehicle stops it until it is started again.", html! {}))
                } @else {
                    (form(user, &format!("{here}/start"), html! { button { "Start" } }))
                }
                @match deployment.waves.as_ref().map(|waves| waves.state) {
                    Some(WaveState::Running) => {
                        (form(user, &format!("{here}/pause"), html! { button { "Pause waves" } }))
                    }
                    Some(WaveState::Paused) => {
                        (form(user, &format!("{here}/resume"), html! { button { "Resume waves" } }))
                    }
                    _ => {}
                }
                @if deployment.waves.as_ref().is_some_and(|it| it.state != WaveState::Aborted) {
                    (confirmed(user, &format!("{here}/abort"), "Abort waves",
                        "Vehicles that have the release keep it, and no others get it.", html! {}))
                }
                @if deployment.fallback.is_some() {
                    (confirmed(user, &format!("{here}/rollback"), "Roll back",
                        "Each vehicle runs the fallback until the next release.", html! {}))
                }
                @if role >= Role::Deployer {
                    (confirmed(user, &format!("{here}/remove"), "Remove",
                        "Each vehicle stops and removes it. To run it again, deploy it again.",
                        html! {}))
                }
            }
        }
    }
}

pub(super) async fn change(
    Call(cloud, user): Visit,
    Path((id, change)): Path<(String, String)>,
) -> PageResult {
    cloud.deployments.change(&user.user.name, &id, &change).await?;
    // One of the changes that there are.
    let to = format!("{}?done={change}", deployment_path(&id));
    Ok(Redirect::to(&to).into_response())
}

pub(super) async fn remove(Call(cloud, user): Visit, Path(id): Path<String>) -> PageResult {
    cloud.deployments.remove(&user.user.name, &id).await?;
    Ok(Redirect::to("/deployments?done=deployment").into_response())
}
