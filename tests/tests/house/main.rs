//! The repository's structure, its pages and its language follow the rules.

mod docs;
mod packages;
mod rooms;
mod wit;
mod words;
