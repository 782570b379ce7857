use std::fmt;

use serde::{Deserialize, Serialize};

/// The environment variable in which `gleaner-shim` tells its runtime the layers that it has set
/// up: a JSON list of [`Layer`].
pub const LAYERS_ENV: &str = "GLEANER_LAYERS";

/// A layer of isolation around a lambda's process, as it was found to hold on this machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layer {
    /// What it keeps a lambda from, in a word or two: `files`, `processes`.
    pub name: String,
    /// Whether it holds.
    pub holds: Holds,
    /// By what, or why not, for people.
    pub note: String,
}

/// Whether a layer of isolation holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Holds {
    /// It was tried, and held.
    Yes,
    /// Some of it is missing on this system.
    Partly,
    /// It is not there.
    No,
}

impl Layer {
    /// A layer that holds.
    pub fn yes(name: &str, note: impl Into<String>) -> Self {
        Self { name: name.to_owned(), holds: Holds::Yes, note: note.into() }
    }

    /// A layer of which something is missing.
    pub fn partly(name: &str, note: impl Into<String>) -> Self {
        Self { name: name.to_owned(), holds: Holds::Partly, note: note.into() }
    }

    /// A layer that is not there.
    pub fn no(name: &str, note: impl Into<String>) -> Self {
        Self { name: name.to_owned(), holds: Holds::No, note: note.into() }
    }
}

impl fmt::Display for Holds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Holds::Yes => "holds",
            Holds::Partly => "partly",
            Holds::No => "not here",
        })
    }
}
