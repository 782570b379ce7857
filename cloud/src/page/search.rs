//! The search for records of a vehicle or of one of its lambdas: a form, and what it finds.

use maud::{Markup, html};
use serde::Deserialize;

use super::layout::empty;
use super::records::RecordSource;
use super::text::query;
use crate::cloud::Cloud;
use crate::error::CloudResult;
use crate::records::{RecordLevel, RecordSearch};
use crate::request::PageLimit;

/// Maximum number of records on a page.
const SIZE: PageLimit = PageLimit::of(100);

#[derive(Debug, Default, Deserialize)]
pub(super) struct SearchPart {
    #[serde(default)]
    text: String,
    /// Least level; empty for any.
    #[serde(default)]
    level: String,
    #[serde(default)]
    after: String,
}

impl SearchPart {
    pub(super) fn is_search(&self) -> bool {
        !self.text.is_empty() || !self.level.is_empty()
    }

    pub(super) fn form(&self, here: &str) -> Markup {
        let levels = ["", "trace", "debug", "info", "warn", "error"];
        html! {
            form.filters method="get" action=(here) role="search" aria-label="Records" {
                div {
                    label for="text" { "Text" }
                    input id="text" name="text" value=(self.text) maxlength="256";
                }
                div {
                    label for="level" { "Level" }
                    select id="level" name="level" {
                        @for level in levels {
                            option value=(level) selected[level == self.level] {
                                (if level.is_empty() { "any" } else { level })
                            }
                        }
                    }
                }
                div {
                    button { "Search" }
                    @if self.is_search() { " " a href=(here) { "Show all" } }
                }
            }
        }
    }

    /// Renders what is found, the newest first.
    pub(super) async fn found(
        &self,
        cloud: &Cloud,
        source: &RecordSource,
        here: &str,
    ) -> CloudResult<Markup> {
        let search = RecordSearch {
            text: Some(self.text.clone()),
            vehicle: Some(source.vehicle.clone()),
            lambda: source.lambda.clone(),
            level: RecordLevel::parse(&self.level),
            after: Some(self.after.clone()).filter(|after| !after.is_empty()),
            limit: SIZE,
            ..RecordSearch::default()
        };
        let found = cloud.records.search(&search).await?;
        let texts = found.items.iter().filter_map(|it| serde_json::to_string(&it.line).ok());
        let values = |next| [("text", &*self.text), ("level", &*self.level), ("after", next)];
        let next = found.next.as_deref().map(|next| format!("{here}{}", query(&values(next))));
        Ok(html! {
            div.lines role="region" aria-label="Records" tabindex="0" {
                (source.lines(texts))
            }
            @if found.items.is_empty() && next.is_some() {
                (empty("No match so far: continue with older records."))
            } @else if found.items.is_empty() {
                (empty("No record fits."))
            }
            @if let Some(next) = next {
                nav.pages aria-label="Parts of the list" { a href=(next) { "Older" } }
            }
        })
    }
}
