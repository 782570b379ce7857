//! The fleet: all vehicles, with filters.

use axum::extract::Query;
use axum::response::{IntoResponse, Redirect, Response};
use gleaner_fleet::people::{VehicleState, VehicleSummary};
use maud::{Markup, html};
use serde::Deserialize;

use super::charts;
use super::layout::{self, PageResult, empty, parts};
use super::session::{Call, Visit};
use super::text::{ago, count, label, query, shown, vehicle_path};
use crate::store::{VehicleFilter, VehiclePage};

/// Number of vehicles on a page.
const SIZE: usize = 50;
/// Maximum number of labels that are shown of a vehicle in the list.
const LABELS_MAX: usize = 6;

/// All states: name in the address, name on the page, class of the style.
pub(super) const STATES: [(VehicleState, &str, &str, &str); 4] = [
    (VehicleState::Online, "online", "online", "running"),
    (VehicleState::Offline, "offline", "offline", "other"),
    (VehicleState::Invited, "invited", "invited", "waiting"),
    (VehicleState::Revoked, "revoked", "revoked", "failed"),
];

/// The filters and the part of the list, as the address has them.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct FleetQuery {
    name: String,
    label: String,
    state: String,
    problem: String,
    page: usize,
}

impl FleetQuery {
    fn filter(&self) -> VehicleFilter {
        let label = self.label.trim();
        let (name, value) = label.split_once('=').unwrap_or((label, ""));
        let state = STATES.iter().find(|(_, key, _, _)| *key == self.state);
        VehicleFilter {
            only: String::new(),
            name: self.name.trim().to_owned(),
            label: (!label.is_empty()).then(|| (name.to_owned(), value.to_owned())),
            state: state.map(|(state, ..)| *state),
            has_problem: !self.problem.is_empty(),
        }
    }

    /// Returns the address of a part of the same list.
    fn address(&self, page: usize) -> String {
        let page = if page == 0 { String::new() } else { page.to_string() };
        let values = [
            ("name", &*self.name),
            ("label", &self.label),
            ("state", &self.state),
            ("problem", &self.problem),
            ("page", &page),
        ];
        format!("/vehicles{}", query(&values))
    }
}

pub(super) async fn start() -> Response {
    Redirect::to("/vehicles").into_response()
}

pub(super) async fn page(
    Call(cloud, user): Visit,
    Query(mut asked): Query<FleetQuery>,
) -> PageResult {
    asked.page = asked.page.min(1_000_000);
    let found = cloud.store.vehicle_page(&asked.filter(), asked.page, SIZE).await?;
    let body = html! {
        h1 { "Fleet" }
        (filters(&asked))
        div id="fleet" hx-get=(asked.address(asked.page)) hx-trigger="every 10s"
            hx-select="#fleet" hx-swap="outerHTML" {
            (health(&found))
            (list(&asked, &found))
        }
    };
    Ok(layout::page("Fleet", "/vehicles", Some(&user), body))
}

fn filters(asked: &FleetQuery) -> Markup {
    html! {
        form.filters method="get" action="/vehicles" role="search" aria-label="Vehicles" {
            div {
                label for="name" { "Name" }
                input id="name" name="name" value=(shown(&asked.name)) placeholder="part of name";
            }
            div {
                label for="label" { "Label" }
                input id="label" name="label" value=(shown(&asked.label)) placeholder="site=berlin";
            }
            div {
                label for="state" { "State" }
                select id="state" name="state" {
                    option value="" { "any" }
                    @for (_, key, name, _) in STATES {
                        option value=(key) selected[key == asked.state] { (name) }
                    }
                }
            }
            div.check {
                input type="checkbox" id="problem" name="problem" value="yes"
                    checked[!asked.problem.is_empty()];
                label for="problem" { "with problems only" }
            }
            div { button { "Show" } " " a href="/vehicles" { "Show all" } }
        }
    }
}

fn health(found: &VehiclePage) -> Markup {
    let states: Vec<_> = STATES
        .iter()
        .zip(found.states)
        .map(|((_, _, name, class), number)| (*class, *name, number as u64))
        .collect();
    html! {
        section.card aria-label="Health of the fleet" {
            (charts::parts("Vehicles", &states))
            @if found.with_problems > 0 {
                p.last { a href="/vehicles?problem=yes" {
                    (count(found.with_problems as u64, "vehicle")) " with problems" } }
            }
        }
    }
}

fn list(asked: &FleetQuery, found: &VehiclePage) -> Markup {
    let (first, last) = (asked.page * SIZE + 1, asked.page * SIZE + found.vehicles.len());
    html! {
        @if found.states.iter().sum::<usize>() == 0 {
            (empty("There are no vehicles yet. An administrator enrols them under Access."))
        } @else if found.vehicles.is_empty() {
            (empty("No vehicle fits these filters."))
        } @else {
            div.scroll role="region" aria-label="List of vehicles" tabindex="0" {
                table {
                    caption { "Vehicles " (first) " to " (last) " of " (found.found) }
                    thead { tr {
                        th scope="col" { "Name" } th scope="col" { "State" }
                        th scope="col" { "Health" } th.number scope="col" { "Running" }
                        th.optional scope="col" { "Labels" } th.optional scope="col" { "Version" }
                    } }
                    tbody { @for (vehicle, failures) in &found.vehicles {
                        (row(vehicle, *failures))
                    } }
                }
            }
        }
        (parts("vehicles", asked.page, (SIZE, found.found), |page| asked.address(page)))
    }
}

fn row(vehicle: &VehicleSummary, failures: u64) -> Markup {
    html! {
        tr {
            th scope="row" {
                a id=(format!("v-{}", vehicle.name)) href=(vehicle_path(&vehicle.name)) {
                    (shown(&vehicle.name)) }
            }
            td { (state(vehicle)) }
            td { (health_of(vehicle, failures)) }
            td.number { (vehicle.running) " of " (vehicle.deployments) }
            td.optional {
                @for pair in vehicle.labels.iter().take(LABELS_MAX) { (label(pair)) }
                @if vehicle.labels.len() > LABELS_MAX { "…" }
            }
            td.optional { (vehicle.version.as_deref().map(shown).unwrap_or_default()) }
        }
    }
}

/// Renders the state of a vehicle, with its last sign of life if it is not connected.
pub(super) fn state(vehicle: &VehicleSummary) -> Markup {
    let (_, _, name, class) =
        STATES.iter().find(|(state, ..)| *state == vehicle.state).copied().unwrap_or(STATES[1]);
    html! {
        span.state.(class) { (name) }
        @if let (VehicleState::Offline, Some(seen)) = (vehicle.state, vehicle.seen) {
            " " span.dim { (ago(seen)) }
        }
    }
}

fn health_of(vehicle: &VehicleSummary, failures: u64) -> Markup {
    html! {
        @match vehicle.state {
            VehicleState::Invited | VehicleState::Revoked => span.dim { "–" },
            _ if !vehicle.problems.is_empty() => span.bad {
                (count(vehicle.problems.len() as u64, "problem")) },
            _ if failures > 0 => span.bad { (count(failures, "failed deployment")) },
            _ if vehicle.handled < vehicle.wanted => span.warn { "changes not applied yet" },
            _ => span.good { "OK" },
        }
    }
}
