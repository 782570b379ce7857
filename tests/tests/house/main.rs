//! The repository's structure, its pages and its language follow the rules.

mod budgets;
mod docs;
mod packages;
mod rooms;
mod standing_alone;
mod wit;
mod words;
