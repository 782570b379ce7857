//! What reads foreign bytes, fed with bytes that a fuzzer makes up; and the calls of a lambda.
//! `docs/fuzzing.md` says how.
//!
//! Each module is a target: its `check` reads bytes in every way that we offer, panics if what
//! comes out contradicts what is promised, and returns whether the input was sound, so that there
//! was something to check. Most promises are such that two readings must agree. `budget` bounds the
//! memory of a reading, `seeds` are the sound inputs that a fuzzer begins with. In `targets/` is a
//! program for each.
//!
//! What never happens here: a promise that only holds for what our own writers write.

pub mod bag;
pub mod budget;
pub mod calls;
pub mod drive;
pub mod image;
mod input;
pub mod journal;
pub mod link;
pub mod manifest;
pub mod message;
pub mod seeds;

/// A target: its name, what it does with an input, and the inputs and words to begin with.
pub struct Target {
    /// Its name; its program is `fuzz-<name>`.
    pub name: &'static str,
    /// Panics if a promise is broken. Returns whether the input was sound, as seeds are. None where
    /// this was built without it.
    pub check: Option<fn(&[u8]) -> bool>,
    /// Length up to which inputs make sense, in bytes: a longer one is cut off there.
    pub longest: usize,
    /// Sound inputs, none longer.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// What a fuzzer is unlikely to find by itself.
    pub words: &'static [&'static str],
}

/// All targets.
pub const TARGETS: [Target; 8] = [
    Target {
        name: "message",
        check: Some(message::check),
        longest: 4 << 10,
        seeds: seeds::message::all,
        words: seeds::message::WORDS,
    },
    Target {
        name: "drive",
        check: Some(drive::check),
        longest: 8 << 10,
        seeds: seeds::drive::all,
        words: seeds::drive::WORDS,
    },
    Target {
        name: "bag",
        check: Some(bag::check),
        longest: 8 << 10,
        seeds: seeds::bag::all,
        words: seeds::bag::WORDS,
    },
    Target {
        name: "image",
        check: Some(image::check),
        longest: 4 << 10,
        seeds: seeds::image::all,
        words: seeds::image::WORDS,
    },
    Target {
        name: "journal",
        check: Some(journal::check),
        longest: 4 << 10,
        seeds: seeds::journal::all,
        words: seeds::journal::WORDS,
    },
    Target {
        name: "link",
        check: Some(link::check),
        longest: 4 << 10,
        seeds: seeds::link::all,
        words: seeds::journal::WORDS,
    },
    Target {
        name: "manifest",
        check: Some(manifest::check),
        longest: 4 << 10,
        seeds: seeds::manifest::all,
        words: seeds::manifest::WORDS,
    },
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
