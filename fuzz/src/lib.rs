//! Fuzz targets for every parser of untrusted input, and for the calls of a lambda. See
//! `docs/fuzzing.md`.
//!
//! Each module is a target. Its `check` parses an input in every way that the library offers,
//! panics if a result contradicts a documented guarantee, and returns whether the input was valid,
//! so that there was something to check. Most guarantees are checked by parsing twice and
//! comparing. `budget` bounds the memory of a parser, `seeds` are valid inputs that a fuzzer starts
//! from, and `targets/` holds a program for each target.
//!
//! A check never relies on properties that only files written by Gleaner have.

pub mod bag;
pub mod budget;
pub mod calls;
pub mod drive;
pub mod fleet;
pub mod image;
pub mod ingress;
mod input;
pub mod journal;
pub mod link;
pub mod manifest;
pub mod message;
pub mod model;
pub mod seeds;
pub mod spool;
pub mod trust;

/// A fuzz target: its name, its check, its seeds and its dictionary.
pub struct Target {
    /// Its name; its program is `fuzz-<name>`.
    pub name: &'static str,
    /// Panics if a guarantee is broken. Returns whether the input was valid, as every seed is.
    /// `None` if the crate was built without the feature of this target.
    pub check: Option<fn(&[u8]) -> bool>,
    /// Maximum useful length of an input in bytes; longer inputs are truncated.
    pub longest: usize,
    /// Valid inputs, none longer than `longest`.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Dictionary entries: tokens that a fuzzer is unlikely to find by itself.
    pub words: &'static [&'static str],
}

/// The target with the parts of this name, for inputs of so many KiB.
macro_rules! target {
    ($name:ident, $kib:literal) => {
        Target {
            name: stringify!($name),
            check: Some($name::check),
            longest: $kib << 10,
            seeds: seeds::$name::all,
            words: seeds::$name::WORDS,
        }
    };
}

pub const TARGETS: [Target; 13] = [
    target!(message, 4),
    target!(drive, 8),
    target!(bag, 8),
    target!(image, 4),
    target!(fleet, 2),
    target!(journal, 4),
    target!(link, 4),
    target!(ingress, 4),
    target!(manifest, 4),
    target!(trust, 4),
    target!(model, 4),
    target!(spool, 4),
    Target {
        name: "calls",
        #[cfg(feature = "calls")]
        check: Some(calls::check),
        #[cfg(not(feature = "calls"))]
        check: None,
        longest: 2 << 10,
        seeds: seeds::calls::all,
        words: seeds::calls::WORDS,
    },
];
