//! One vehicle: its lambdas, losses and latencies, its sandbox, and its connection.

use std::sync::Arc;

use axum::extract::{Extension, Path, State};
use gleaner_fleet::people::{VehicleState, VehicleSummary};
use gleaner_protocol::vehicle_api::VehicleStatus;
use maud::{Markup, html};

use super::fleet::state;
use super::layout::{self, PageResult, empty};
use super::session::PageUser;
use super::status;
use super::text::{ago, label, shown, vehicle_path};
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};
use crate::store::VehicleFilter;

/// Maximum number of problems that are shown.
const PROBLEMS_MAX: usize = 20;

pub(super) async fn page(
    State(cloud): State<Arc<Cloud>>,
    Extension(user): Extension<PageUser>,
    Path(name): Path<String>,
) -> PageResult {
    let vehicle = find(&cloud, &name).await?;
    // Absent before the first report, and of a version whose status has another form.
    let status = cloud.store.status(&name).await.ok();
    let status: Option<VehicleStatus> = status.and_then(|text| serde_json::from_str(&text).ok());
    let here = vehicle_path(&name);
    let body = html! {
        nav.crumbs aria-label="Path" { a href="/vehicles" { "Fleet" } }
        h1 { (shown(&vehicle.name)) }
        nav.tabs aria-label="Vehicle" {
            a href=(here) aria-current="page" { "Status" }
            a href=(format!("{here}/events")) { "Time line" }
        }
        div id="vehicle" hx-get=(here) hx-trigger="every 5s" hx-select="#vehicle"
            hx-swap="outerHTML" {
            (summary(&vehicle))
            @match &status {
                Some(status) => (status::all(&here, status)),
                None => (empty("The vehicle has not reported its status yet.")),
            }
        }
    };
    Ok(layout::page(&vehicle.name, "/vehicles", Some(&user), body))
}

/// Returns a vehicle of the list.
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

fn summary(vehicle: &VehicleSummary) -> Markup {
    html! {
        @for problem in vehicle.problems.iter().take(PROBLEMS_MAX) {
            p.banner.bad { (shown(problem)) }
        }
        @if vehicle.problems.len() > PROBLEMS_MAX {
            p.banner.bad { (vehicle.problems.len() - PROBLEMS_MAX) " more problems" }
        }
        section.card aria-label="Summary" {
            dl.facts {
                div { dt { "State" } dd { (state(vehicle)) } }
                @if let Some(seen) = vehicle.seen {
                    div { dt { "Last sign of life" } dd {
                        @if vehicle.state == VehicleState::Online { "connected now" }
                        @else { (ago(seen)) }
                    } }
                }
                div { dt { "Lambdas" } dd {
                    (vehicle.running) " of " (vehicle.deployments) " running" } }
                div { dt { "Wanted state" } dd {
                    "number " (vehicle.wanted)
                    @if vehicle.handled < vehicle.wanted {
                        span.warn { ", handled up to " (vehicle.handled) }
                    } @else { ", handled" }
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
