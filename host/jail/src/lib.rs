//! What keeps a process from what it has no business with, as far as a process without privileges
//! can have that.
//!
//! Nothing here can be taken back, and all of it holds for what the process starts. In the order in
//! which a runtime comes by it:
//!
//! 1. [`never`](mod@never), by `gleaner-shim`, before the runtime exists: no new privileges, no
//!    calls that no lambda's process ever needs.
//! 2. [`files`], before the first foreign code is loaded: only the files that were named can be
//!    opened; no TCP.
//! 3. [`alone`], once sockets and files are open: no further ones, no new processes, no signals to
//!    others.
//! 4. [`memory`], with it: so much more than there is now.
//!
//! A compiler of a lambda whose author is not trusted enters [`compiler`] instead.
//!
//! [`tried`] then tries what should be impossible: a layer counts as one that holds only if it was
//! seen to. [`cgroup`] is the supervisor's side, for memory and processes that a lambda starts.
//! What is missing on a system is said and not fatal: a lambda runs with the layers that are there,
//! and everybody can read which these are. What the system has and something in the process keeps
//! away is fatal.

pub mod alone;
pub mod cgroup;
pub mod compiler;
mod enter;
pub mod files;
mod filter;
pub mod memory;
pub mod never;
pub mod tried;

pub use files::Paths;

/// Why a layer is not there, though the system has it.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum JailError {
    #[error("cannot build the filter of system calls")]
    Build(#[source] seccompiler::BackendError),
    #[error("cannot install the filter of system calls")]
    Install(#[source] seccompiler::Error),
    #[error("a thread that began before the lambda cannot be shut in")]
    Loose(#[source] seccompiler::Error),
    #[error("there is no filter of system calls for {0}")]
    Machine(&'static str),
    #[error("cannot confine the files")]
    Files(#[from] landlock::RulesetError),
    #[error("cannot limit {what}")]
    Limit { what: &'static str, source: std::io::Error },
}

impl JailError {
    /// All of the chain, in one line.
    pub fn told(&self) -> String {
        let mut text = self.to_string();
        let mut source = std::error::Error::source(self);
        while let Some(cause) = source {
            text.push_str(": ");
            text.push_str(&cause.to_string());
            source = cause.source();
        }
        text
    }
}
