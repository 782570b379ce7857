//! The repository's structure, its pages and its language follow the rules.

mod budgets;
mod contracts;
mod docs;
mod packages;
mod rooms;
mod standing_alone;
mod wit;
mod words;

/// Fails with each problem on its own line.
#[track_caller]
fn none(problems: Vec<String>) {
    assert!(problems.is_empty(), "\n{}", problems.join("\n"));
}
