//! Sandboxes a process: seccomp, Landlock, rlimits, cgroups, as far as an unprivileged process can;
//! and [`shim`], the program that starts every runtime, watches it, and writes its results.
//!
//! No restriction can be undone, and each holds for descendants of the process. In the order in
//! which a runtime gets them:
//!
//! 1. [`base_filter`] and [`sockets`], by `gleaner-shim`, before the runtime exists: no new
//!    privileges, no calls that no lambda's process ever needs, no new sockets.
//! 2. [`files`], before untrusted code is loaded: only named files can be opened; no TCP.
//! 3. [`sandbox_filter`], once files are open: no new processes, no signals to other processes.
//! 4. [`memory`], with it: a cap on further memory growth.
//!
//! A compiler of a lambda whose author is not trusted enters [`compiler`] instead. [`ingress`],
//! [`recorder`] and [`inference`] are the sandboxes of the processes that serve all lambdas.
//!
//! [`needed`] tries before all the calls without which a start fails.
//! [`self_test`] then tries what should be denied: a layer counts only if it was seen to deny it.
//! [`cgroup`] is the supervisor's side, for memory and processes that a lambda starts. A layer that
//! the system lacks is reported, and users can read which layers exist. Without one of
//! [`REQUIRED_LAYERS`](gleaner_protocol::REQUIRED_LAYERS), `gleaner-shim` starts no lambda; without
//! another one, a lambda runs. A layer that the system has but that something in the process
//! prevents is fatal.

pub mod base_filter;
pub mod cgroup;
mod cgroup_join;
pub mod compiler;
pub mod files;
mod filter;
pub mod inference;
pub mod ingress;
pub mod memory;
pub mod needed;
mod own_memory;
pub mod priority;
pub mod recorder;
pub mod sandbox_filter;
pub mod self_test;
pub mod shim;
pub mod sockets;

pub use files::Paths;

use gleaner_protocol::Layer;

/// Reasons why a layer is missing although the system has it.
#[derive(Debug, thiserror::Error)]
pub enum JailError {
    #[error("cannot build the seccomp filter")]
    Build(#[source] seccompiler::BackendError),
    #[error("cannot install the seccomp filter")]
    Install(#[source] seccompiler::Error),
    #[error("cannot apply the seccomp filter to an existing thread")]
    ExistingThread(#[source] seccompiler::Error),
    #[error("no seccomp filter exists for the architecture {0}")]
    Architecture(&'static str),
    #[error("cannot restrict the files")]
    Files(#[from] landlock::RulesetError),
    #[error("cannot limit {what}")]
    Limit { what: &'static str, source: std::io::Error },
}

/// Returns the layer `name` with this note, or the reason why it could not be set up.
fn layer(name: &str, note: impl Into<String>, set_up: Result<(), impl ToString>) -> Layer {
    match set_up {
        Ok(()) => Layer::yes(name, note),
        Err(error) => Layer::no(name, error.to_string()),
    }
}

impl JailError {
    /// Formats the error and its causes, in one line.
    pub fn chain(&self) -> String {
        let mut text = self.to_string();
        let mut source = std::error::Error::source(self);
        while let Some(cause) = source {
            let why = cause.to_string();
            // An error of the filter's library ends with its own cause.
            if !text.ends_with(&why) {
                text.push_str(": ");
                text.push_str(&why);
            }
            source = cause.source();
        }
        text
    }
}
