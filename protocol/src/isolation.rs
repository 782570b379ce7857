//! The layers of isolation around a lambda, and the results of their tests.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The environment variable in which `gleaner-shim` passes the layers that it has set up to its
/// runtime: a JSON list of [`Layer`].
pub const LAYERS_ENV: &str = "GLEANER_LAYERS";

/// The environment variable in which `gleaner-shim` passes its process id to its runtime.
pub const SHIM_ENV: &str = "GLEANER_SHIM";

/// The name of the layer of a system that refuses a call without which no lambda starts.
pub const NEEDED_CALLS: &str = "needed calls";

/// The layers without which `gleaner-shim` starts no lambda. A lambda without the first two could
/// open sockets and act on other processes; one with the third, a priority that cannot be given up,
/// could take a core for itself. Without the last one, its start would fail.
pub const REQUIRED_LAYERS: [&str; 4] =
    ["system calls", "sockets", "real-time priority", NEEDED_CALLS];

/// A layer of isolation around a lambda's process, as tested on this machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Layer {
    /// The protected resource, in a word or two: `files`, `processes`.
    pub name: String,
    /// The result of the test.
    pub holds: Holds,
    /// The mechanism, or the reason why it does not hold.
    pub note: String,
}

/// The result of testing a layer of isolation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Holds {
    /// The layer was tested, and holds.
    Yes,
    /// A part of the layer is missing on this system.
    Partly,
    /// The layer is missing.
    No,
}

impl Layer {
    /// Returns whether no lambda may run, as this layer is missing.
    pub fn prevents_lambdas(&self) -> bool {
        self.holds == Holds::No && REQUIRED_LAYERS.contains(&&*self.name)
    }

    /// Returns the way out if this layer is missing: of the kernel, and of a container.
    pub fn help(&self) -> &'static str {
        match &*self.name {
            "system calls" | "sockets" => {
                "it needs CONFIG_SECCOMP_FILTER=y, and a container that permits `seccomp`, as with \
                 `docker run --security-opt seccomp=PROFILE`"
            }
            "real-time priority" => "permit the call, or start Gleaner without `chrt` and `ionice`",
            NEEDED_CALLS => "permit them: `docker run --security-opt seccomp=PROFILE`",
            "files" if self.holds == Holds::Partly => {
                "a newer kernel restricts more; see docs/security.md"
            }
            "files" => {
                "it needs CONFIG_SECURITY_LANDLOCK=y, `landlock` in the kernel's parameter lsm=, \
                 and a container that permits `landlock_create_ruleset`"
            }
            "control group" => "delegate one (systemd: `Delegate=cpu memory pids`): --cgroup DIR",
            _ => "Python lambdas are isolated by fewer layers; see docs/security.md",
        }
    }

    /// Creates a layer that holds.
    pub fn yes(name: &str, note: impl Into<String>) -> Self {
        Self { name: name.to_owned(), holds: Holds::Yes, note: note.into() }
    }

    /// Creates a layer of which a part is missing.
    pub fn partly(name: &str, note: impl Into<String>) -> Self {
        Self { name: name.to_owned(), holds: Holds::Partly, note: note.into() }
    }

    /// Creates a layer that is missing.
    pub fn no(name: &str, note: impl Into<String>) -> Self {
        Self { name: name.to_owned(), holds: Holds::No, note: note.into() }
    }
}

impl fmt::Display for Holds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Holds::Yes => "holds",
            Holds::Partly => "partly",
            Holds::No => "missing",
        })
    }
}
