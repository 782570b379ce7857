//! The two versions of a lambda, and the cores that measure them.

use std::fmt;
use std::path::PathBuf;

use gleaner_tests::root;

/// The two versions of a lambda.
#[derive(Clone, Copy)]
pub enum Twin {
    Rust,
    Python,
}

impl fmt::Display for Twin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Rust => "wasm",
            Self::Python => "Python",
        })
    }
}

impl Twin {
    /// The folder of this version.
    pub fn folder(self) -> &'static str {
        match self {
            Self::Rust => "rust",
            Self::Python => "python",
        }
    }

    /// The folder of an example in this version.
    pub fn example(self, name: &str) -> PathBuf {
        root().join("examples").join(name).join(self.folder())
    }
}

/// Binds this process and its children to the first core that it may use.
pub fn bind_to_one_core() -> std::io::Result<()> {
    bind_to(cores()?.first().copied().unwrap_or(0))
}

/// The cores that this thread may use.
pub fn cores() -> std::io::Result<Vec<usize>> {
    let allowed = rustix::thread::sched_getaffinity(None)?;
    Ok((0..rustix::thread::CpuSet::MAX_CPU).filter(|core| allowed.is_set(*core)).collect())
}

/// Binds this thread, and the threads and processes that it will start, to one core.
pub fn bind_to(core: usize) -> std::io::Result<()> {
    let mut one = rustix::thread::CpuSet::new();
    one.set(core);
    Ok(rustix::thread::sched_setaffinity(None, &one)?)
}
