//! One vehicle: its lambdas, losses and latencies, its sandbox, and its connection.

use axum::extract::Path;
use axum::response::{IntoResponse, Redirect};
use gleaner_fleet::people::{Role, VehicleState, VehicleSummary};
use gleaner_protocol::vehicle_api::VehicleStatus;
use maud::{Markup, html};

use super::fleet::state;
use super::layout::{self, PageResult, confirmed, empty};
use super::session::{Call, PageUser, Visit};
use super::status;
use super::text::{ago, label, shown, vehicle_path};
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};
use crate::store::VehicleFilter;

const PROBLEMS_MAX: usize = 20;

pub(super) async fn page(Call(cloud, user): Visit, Path(name): Path<String>) -> PageResult {
    let vehicle = find(&cloud, &name).await?;
    // Absent before the first report, and of a version whose status has another form.
    let status = cloud.store.status(&name).await.ok();
    cloud.live_streams.watch(&vehicle.name);
    let status: Option<VehicleStatus> = status.and_then(|text| serde_json::from_str(&text).ok());
    let here = vehicle_path(&name);
    let body = html! {
        nav.crumbs aria-label="Path" { a href="/vehicles" { "Fleet" } }
        h1 { (shown(&vehicle.name)) }
        nav.tabs aria-label="Vehicle" {
            a href=(here) aria-current="page" { "Status" }
            a href=(format!("{here}/events")) { "Time line" }
        }
        (ahead(&user, &here, &vehicle))
        div id="vehicle" hx-get=(here) hx-trigger="every 5s" hx-select="#vehicle"
            hx-swap="outerHTML" {
            (summary(&vehicle))
            @match &status {
                Some(status) => {
                    @if let Some(age_s) = status.age_s {
                        p.dim { "As of " (age_s.round()) " s ago" }
                    }
                    (status::all(&here, status))
                }
                None => (empty("The vehicle has not reported its status yet.")),
            }
        }
    };
    Ok(layout::page(&vehicle.name, "/vehicles", Some(&user), body))
}

/// Lets a vehicle follow this cloud although it has followed a newer state.
pub(super) async fn agree(Call(cloud, user): Visit, Path(name): Path<String>) -> PageResult {
    cloud.enrolments.agree(&user.user.name, &name).await?;
    Ok(Redirect::to(&vehicle_path(&name)).into_response())
}

pub(super) async fn find(cloud: &Cloud, name: &str) -> CloudResult<VehicleSummary> {
    if name.is_empty() {
        return Err(CloudError::missing("a vehicle has a name", "choose one from the fleet"));
    }
    let filter = VehicleFilter { only: name.to_owned(), ..VehicleFilter::default() };
    let page = cloud.store.vehicle_page(&filter, 0, 1).await?;
    page.vehicles.into_iter().map(|(it, _)| it).next().ok_or_else(|| {
        let message = format!("there is no vehicle `{}`", gleaner_base::excerpt(name));
        CloudError::missing(message, "choose one from the fleet")
    })
}

/// Asks for the decision about a vehicle that has followed a newer state.
fn ahead(user: &PageUser, here: &str, vehicle: &VehicleSummary) -> Markup {
    html! {
        @if vehicle.is_ahead {
            div.banner.bad {
                p { "The vehicle has followed a newer state than this cloud has, as after a \
                    restored backup. It stops and removes nothing until an administrator agrees." }
                @if user.user.role >= Role::Admin {
                    (confirmed(user, &format!("{here}/agree"), "Follow this cloud",
                        "The vehicle will end what this cloud does not have.", html! {}))
                }
            }
        }
    }
}

fn summary(vehicle: &VehicleSummary) -> Markup {
    html! {
        @if vehicle.is_double {
            p.banner.bad { "Two machines have the identity of this vehicle, and one of them is not \
                let in. Run gleaner unenrol --new-identity on the copy, and enrol both again." }
        }
        @for problem in vehicle.problems.iter().take(PROBLEMS_MAX) {
            p.banner.bad[!problem.is_pending] {
                (super::text::block(&problem.explained()))
            }
        }
        @if vehicle.problems.len() > PROBLEMS_MAX {
            p.banner.bad { (vehicle.problems.len() - PROBLEMS_MAX) " more problems" }
        }
        section.card aria-label="Summary" {
            dl.facts {
                div { dt { "State" } dd { (state(vehicle)) } }
                @if let Some(seen) = vehicle.seen {
                    div { dt { "Last seen" } dd {
                        @if vehicle.state == VehicleState::Online { "connected now" }
                        @else { (ago(seen)) }
                    } }
                }
                div { dt { "Lambdas" } dd {
                    (vehicle.running) " of " (vehicle.deployments) " running" } }
                div { dt { "Desired state" } dd {
                    "number " (vehicle.wanted)
                    @if vehicle.handled < vehicle.wanted {
                        span.warn { ", applied up to " (vehicle.handled) }
                    } @else if vehicle.problems.is_empty() { ", in sync" }
                    @else { span.warn { ", applied in part" } }
                } }
                @if let Some(version) = &vehicle.version {
                    div { dt { "Version" } dd { (shown(version)) } }
                }
                @if !vehicle.labels.is_empty() {
                    div.all { dt { "Labels" } dd {
                        @for pair in &vehicle.labels { (label(pair)) }
                    } }
                }
            }
        }
    }
}
