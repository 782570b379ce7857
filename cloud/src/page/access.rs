//! Access: users and vehicles are invited and removed.

use axum::extract::{Extension, Path, Query};
use axum::http::header;
use axum::response::{IntoResponse, Redirect};
use gleaner_fleet::people::{NewUser, Role, User, VehicleState};
use maud::{Markup, html};
use serde::Deserialize;

use super::guard::PostedForm;
use super::layout::{self, PageResult, confirmed, done, failure, form, parts, with_status};
use super::session::{Call, PageUser, Visit};
use super::text::{query, segment, shown, time, vehicle_path};
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};
use crate::store::VehicleFilter;

/// Number of users and of vehicles on a page.
const SIZE: usize = 50;

pub(super) const ROLES: [(Role, &str); 4] = [
    (Role::Viewer, "read"),
    (Role::Operator, "also start, stop and roll back, control waves and fetch clips"),
    (Role::Deployer, "also deploy and remove deployments"),
    (Role::Admin, "also manage vehicles and users"),
];

/// The change that was made, and the parts of the lists, as the address has them.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct AccessQuery {
    done: Option<String>,
    users: usize,
    vehicles: usize,
}

pub(super) async fn page(Call(cloud, user): Visit, Query(asked): Query<AccessQuery>) -> PageResult {
    let message = done(asked.done.as_deref());
    access_page(&cloud, &user, &asked, message).await
}

async fn access_page(
    cloud: &Cloud,
    user: &PageUser,
    asked: &AccessQuery,
    message: Markup,
) -> PageResult {
    let body = html! {
        h1 { "Access" }
        (message)
        div.pair {
            (new_user(user))
            (new_vehicle(user))
        }
        (users(user, &cloud.store.users("", u64::MAX).await?, asked))
        (vehicles(cloud, user, asked).await?)
    };
    Ok(layout::page("Access", "/access", Some(user), body))
}

fn new_user(user: &PageUser) -> Markup {
    html! {
        section.card aria-labelledby="new-user" {
            h2 id="new-user" { "Invite a user" }
            (form(user, "/access/users", html! {
                label for="user-name" { "Name" }
                input id="user-name" name="name" required maxlength="64" autocomplete="off"
                    spellcheck="false" aria-describedby="user-help";
                p.help id="user-help" {
                    "Letters, digits and ._-@+ are allowed. An existing user gets a new code, and \
                     this role."
                }
                label for="role" { "Role" }
                select id="role" name="role" {
                    @for (role, may) in ROLES {
                        option value=(role) { (role) ": " (may) }
                    }
                }
                button { "Invite" }
            }))
        }
    }
}

fn new_vehicle(user: &PageUser) -> Markup {
    html! {
        section.card aria-labelledby="new-vehicle" {
            h2 id="new-vehicle" { "Enrol a vehicle" }
            (form(user, "/access/vehicles", html! {
                label for="vehicle-name" { "Name" }
                input id="vehicle-name" name="name" required maxlength="64" autocomplete="off"
                    spellcheck="false" aria-describedby="vehicle-help";
                p.help id="vehicle-help" {
                    "A file is downloaded. It is a secret, and works once, for 24 hours. Copy it \
                     to the vehicle, and run " code { "gleaner enrol FILE" } " there."
                }
                button { "Enrol" }
            }))
        }
    }
}

fn users(user: &PageUser, all: &[User], asked: &AccessQuery) -> Markup {
    let index = asked.users.min(1_000_000);
    html! {
        section aria-labelledby="users" {
            h2 id="users" { "Users" }
            ul.rows { @for it in all.iter().skip(index * SIZE).take(SIZE) {
                li.card {
                    span { b { (shown(&it.name)) } " " span.dim { (it.role) }
                        @if it.name == user.user.name { " " span.dim { "(you)" } } }
                    (confirmed(user, &format!("/access/users/{}/remove", segment(&it.name)),
                        "Remove", &format!("{} will be logged out everywhere at once.", it.name),
                        html! {}))
                }
            } }
            (pages("users", index, all.len()))
        }
    }
}

async fn vehicles(cloud: &Cloud, user: &PageUser, asked: &AccessQuery) -> CloudResult<Markup> {
    let index = asked.vehicles.min(1_000_000);
    let filter = VehicleFilter::default();
    let found = cloud.store.vehicle_page(&filter, index, SIZE).await?;
    Ok(html! {
        section aria-labelledby="vehicles" {
            h2 id="vehicles" { "Vehicles" }
            @if found.found == 0 { (layout::empty("No vehicles yet.")) }
            ul.rows { @for (it, _) in &found.vehicles {
                li.card {
                    span { a href=(vehicle_path(&it.name)) { (shown(&it.name)) }
                        " " (super::fleet::state(it)) }
                    @if it.state != VehicleState::Revoked {
                        (confirmed(user, &format!("/access/vehicles/{}/revoke", segment(&it.name)),
                            "Revoke", &format!("All certificates of {} become invalid. Its \
                            lambdas keep running.", it.name), html! {}))
                    }
                }
            } }
            (pages("vehicles", index, found.found))
        }
    })
}

fn pages(list: &str, index: usize, total: usize) -> Markup {
    let address = |page: usize| format!("/access{}#{list}", query(&[(list, &page.to_string())]));
    parts(list, index, (SIZE, total), address)
}

pub(super) async fn invite(Call(cloud, user): Visit, Extension(fields): PostedForm) -> PageResult {
    let invited = async {
        let new = NewUser { name: fields.get("name").trim().to_owned(), role: fields.role()? };
        cloud.store.invite(&user.user.name, new).await
    };
    let invitation = match invited.await {
        Ok(invitation) => invitation,
        Err(error) => return refused(&cloud, &user, error).await,
    };
    let body = html! {
        nav.crumbs aria-label="Path" { a href="/access" { "Access" } }
        h1 { "Invitation of " (invitation.user.name) }
        section.card.narrow aria-label="Code" {
            p { "Pass on this code, in private. It is not shown again." }
            p.code { code id="invitation" { (invitation.code) } }
            p { "It works once, until "
                (time(invitation.expires))
                ": on the page under " code { "/login" } ", or with "
                code { "gleaner login URL --code CODE" } "." }
        }
    };
    Ok(layout::page("Invitation", "/access", Some(&user), body))
}

async fn refused(cloud: &Cloud, user: &PageUser, error: CloudError) -> PageResult {
    let status = error.status();
    let page = access_page(cloud, user, &AccessQuery::default(), failure(error)).await?;
    Ok(with_status(status, page))
}

pub(super) async fn remove_user(Call(cloud, user): Visit, Path(name): Path<String>) -> PageResult {
    cloud.accounts.remove_user(&user.user.name, &name).await?;
    Ok(Redirect::to("/access?done=user").into_response())
}

pub(super) async fn enrol(Call(cloud, user): Visit, Extension(fields): PostedForm) -> PageResult {
    let name = fields.get("name").trim();
    let enrolment = match cloud.enrolments.invite(&user.user.name, name).await {
        Ok(enrolment) => enrolment,
        Err(error) => return refused(&cloud, &user, error).await,
    };
    // Names of vehicles are letters, digits and `._-`.
    let file = format!("attachment; filename=\"{}.json\"", enrolment.vehicle);
    let text = serde_json::to_string_pretty(&enrolment).unwrap_or_default();
    let headers = [
        (header::CONTENT_TYPE, "application/json".to_owned()),
        (header::CONTENT_DISPOSITION, file),
    ];
    Ok((headers, text).into_response())
}

pub(super) async fn revoke(Call(cloud, user): Visit, Path(name): Path<String>) -> PageResult {
    cloud.enrolments.revoke(&user.user.name, &name).await?;
    Ok(Redirect::to("/access?done=vehicle").into_response())
}
