//! The audit trail: who changed what.

use axum::extract::Query;
use maud::html;
use serde::Deserialize;

use super::layout::{self, PageResult, empty};
use super::session::{Call, Visit};
use super::text::{query, short, shown, time};

/// Number of entries on a page.
const SIZE: u64 = 50;

#[derive(Debug, Deserialize)]
pub(super) struct AuditPart {
    before: Option<u64>,
}

pub(super) async fn page(Call(cloud, user): Visit, Query(part): Query<AuditPart>) -> PageResult {
    let entries = cloud.store.audit(part.before.unwrap_or(u64::MAX), SIZE).await?;
    let body = html! {
        h1 { "Audit trail" }
        p.help { "Each change, the newest first. Each entry has a hash over the one before it." }
        @if entries.is_empty() { (empty("There are no entries here.")) }
        @else {
            div.scroll role="region" aria-label="List of entries" tabindex="0" {
                table {
                    caption { "Entries " (entries[0].seq) " to " (entries[entries.len() - 1].seq) }
                    thead { tr {
                        th.number.optional scope="col" { "Entry" }
                        th scope="col" { "Time" } th scope="col" { "User" }
                        th scope="col" { "Change" }
                        th scope="col" { "Target" } th.optional scope="col" { "Hash" } } }
                    tbody { @for entry in &entries {
                        tr {
                            td.number.optional { (entry.seq) }
                            td { (time(entry.time_ms / 1000)) }
                            td { (shown(&entry.actor)) }
                            td { (shown(&entry.action)) }
                            td { (shown(&entry.subject)) }
                            td.optional { code { (short(&entry.hash)) } }
                        }
                    } }
                }
            }
        }
        nav.pages aria-label="Parts of the list" {
            @if part.before.is_some() { a href="/audit" { "Newest" } }
            @if let Some(last) = entries.last() && last.seq > 1 {
                @let before = last.seq.to_string();
                a href=(format!("/audit{}", query(&[("before", &before)]))) { "Older" }
            }
        }
    };
    Ok(layout::page("Audit trail", "/audit", Some(&user), body))
}
