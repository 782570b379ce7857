//! The limit of open files: a soft one, which counts, and a hard one, up to which it may be raised.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Allows this process as many open files as its hard limit.
pub fn raise_open_files() {
    let maximum = getrlimit(Resource::Nofile).maximum;
    // Raising it to the maximum is never refused.
    let _ = setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum });
}

pub fn open_files_max() -> usize {
    let current = getrlimit(Resource::Nofile).current;
    current.and_then(|most| most.try_into().ok()).unwrap_or(usize::MAX)
}
