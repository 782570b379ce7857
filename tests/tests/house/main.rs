//! The house is in order, and its pages are true.

mod docs;
mod rooms;
mod wit;
