//! Tests the racing steps, in every order with up to three preemptions.
//!
//! Run with `RUSTFLAGS="--cfg loom" LOOM_MAX_PREEMPTIONS=3 cargo test --release --test loom`.
//!
//! Loom runs the first thread as far as possible, and explores the steps of the second from there.
//! It can miss that a load comes after another thread's load and store, so the writer is always the
//! first thread.
#![cfg(loom)]

mod rings;
mod shared;
