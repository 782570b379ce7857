//! Lambdas of the fleet, by the revisions that deployments name.

use std::collections::BTreeMap;

use axum::extract::{Path, Query};
use gleaner_fleet::people::FleetDeployment;
use gleaner_trust::{Revision, unverified_revision};
use maud::{Markup, html};
use serde::Deserialize;

use super::layout::{self, PageResult, empty, parts};
use super::session::{Call, Visit};
use super::text::{bytes, count, deployment_path, query, segment, short, shown, time};
use crate::cloud::Cloud;
use crate::error::{CloudError, CloudResult};

/// Number of revisions on a page, and of files of one.
const SIZE: usize = 25;
const FILES_MAX: usize = 500;

#[derive(Debug, Deserialize)]
pub(super) struct LambdaPart {
    #[serde(default)]
    page: usize,
}

/// Deployments by the digest of a revision: those that run it, and those that fall back to it.
type RevisionUses = BTreeMap<String, (Vec<String>, Vec<String>)>;

async fn uses(cloud: &Cloud) -> CloudResult<RevisionUses> {
    let mut uses = RevisionUses::new();
    for FleetDeployment { id, revision, fallback, .. } in
        cloud.store.deployments("", u64::MAX).await?
    {
        if let Some(fallback) = fallback {
            uses.entry(fallback).or_default().1.push(id.clone());
        }
        uses.entry(revision).or_default().0.push(id);
    }
    Ok(uses)
}

async fn parsed(cloud: &Cloud, digest: &str) -> CloudResult<Option<Revision>> {
    let envelope = cloud.store.revision(digest).await?;
    Ok(envelope.and_then(|text| unverified_revision(text.as_bytes()).ok()).map(|(it, _)| it))
}

pub(super) async fn page(Call(cloud, user): Visit, Query(part): Query<LambdaPart>) -> PageResult {
    let uses = uses(&cloud).await?;
    let index = part.page.min(1_000_000);
    let mut rows = Vec::new();
    for (digest, used) in uses.iter().skip(index * SIZE).take(SIZE) {
        rows.push((digest, used, parsed(&cloud, digest).await?));
    }
    let address = |page: usize| format!("/lambdas{}", query(&[("page", &page.to_string())]));
    let body = html! {
        h1 { "Lambdas" }
        p.help { "The revisions that deployments name, as they were signed. Vehicles check the \
                  signatures; the cloud does not." }
        @if rows.is_empty() { (empty("No deployment names a revision here.")) }
        @else {
            div.scroll role="region" aria-label="List of revisions" tabindex="0" {
                table {
                    caption { (count(uses.len() as u64, "revision")) }
                    thead { tr { th scope="col" { "Lambda" } th scope="col" { "Revision" }
                        th scope="col" { "Deployments" } th.optional scope="col" { "Signed" } } }
                    tbody { @for (digest, used, revision) in &rows {
                        (row(digest, used, revision.as_ref()))
                    } }
                }
            }
        }
        (parts("revisions", index, (SIZE, uses.len()), address))
    };
    Ok(layout::page("Lambdas", "/lambdas", Some(&user), body))
}

fn row(digest: &str, used: &(Vec<String>, Vec<String>), revision: Option<&Revision>) -> Markup {
    html! {
        tr {
            th scope="row" {
                @match revision {
                    Some(it) => {
                        (shown(it.name.as_ref())) " " span.dim { (shown(it.version.as_ref())) }
                    },
                    None => span.bad { "cannot be read" },
                }
            }
            td { a href=(format!("/lambdas/{}", segment(digest))) { code { (short(digest)) } }
                @if let Some(it) = revision { " " span.dim { "release " (it.release) } } }
            td { (links(used)) }
            td.optional { @if let Some(it) = revision { (time(it.created)) } }
        }
    }
}

fn links((current, fallbacks): &(Vec<String>, Vec<String>)) -> Markup {
    html! {
        @for id in current.iter().take(20) { a href=(deployment_path(id)) { (shown(id)) } " " }
        @for id in fallbacks.iter().take(20) {
            a href=(deployment_path(id)) { (shown(id)) } " " span.dim { "(fallback) " }
        }
        @let more = current.len().saturating_sub(20) + fallbacks.len().saturating_sub(20);
        @if more > 0 { span.dim { "and " (more) " more" } }
    }
}

pub(super) async fn revision(Call(cloud, user): Visit, Path(digest): Path<String>) -> PageResult {
    let missing = || CloudError::missing("there is no such revision", "choose one from the list");
    let revision = parsed(&cloud, &digest).await?.ok_or_else(missing)?;
    let used = uses(&cloud).await?.remove(&digest).unwrap_or_default();
    let name = shown(revision.name.as_ref());
    let total: u64 = revision.files.iter().map(|it| it.bytes).fold(0, u64::saturating_add);
    let body = html! {
        nav.crumbs aria-label="Path" { a href="/lambdas" { "Lambdas" } }
        h1 { (name) " " span.dim { (shown(revision.version.as_ref())) } }
        section.card aria-label="Summary" {
            dl {
                dt { "Revision" } dd { code { (shown(&digest)) } }
                dt { "Release" } dd { (revision.release) }
                dt { "Signed" } dd { (time(revision.created)) }
                dt { "Deployments" } dd { (links(&used)) }
            }
        }
        div.scroll role="region" aria-label="List of files" tabindex="0" {
            table {
                caption { (count(revision.files.len() as u64, "file")) ", " (bytes(total as f64)) }
                thead { tr { th scope="col" { "File" } th.number scope="col" { "Size" }
                    th.optional scope="col" { "SHA-256" } } }
                tbody { @for file in revision.files.iter().take(FILES_MAX) {
                    tr {
                        th scope="row" { code { (shown(file.path.as_ref())) } }
                        td.number { (bytes(file.bytes as f64)) }
                        td.optional { code { (short(file.sha256.as_str())) } }
                    }
                } }
            }
        }
        @if revision.files.len() > FILES_MAX {
            p.dim { (revision.files.len() - FILES_MAX) " more files" }
        }
    };
    Ok(layout::page(&name, "/lambdas", Some(&user), body))
}
