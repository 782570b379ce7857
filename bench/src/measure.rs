//! The two versions of a lambda, the cores that measure them, and the memory of a process.

use std::fmt;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};

use gleaner_test_support::random::XorShift64;
use gleaner_tests::root;
use rustix::time::{ClockId, clock_gettime};

/// Lines that are kept of the message of a failure.
const MESSAGE_LINES: usize = 20;

/// The two versions of a lambda.
#[derive(Clone, Copy, PartialEq, Eq)]
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

/// Microseconds for each of the `times` repetitions of `work`, and its result. Measured in CPU time
/// of this thread: other work on the core matters only by its effect on the caches.
pub fn timed<T>(times: u64, work: impl FnOnce() -> T) -> (f64, T) {
    let now_us = || {
        let now = clock_gettime(ClockId::ThreadCPUTime);
        now.tv_sec as f64 * 1e6 + now.tv_nsec as f64 / 1e3
    };
    let started_us = now_us();
    let result = work();
    ((now_us() - started_us) / times as f64, result)
}

/// The numbers below `count` in an order by `random`: Fisher and Yates.
pub fn shuffled(count: usize, random: &mut XorShift64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..count).collect();
    (1..count).rev().for_each(|last| order.swap(last, random.below(last + 1)));
    order
}

/// Does `work`; the message of a panic is an error. The library of the tests, which starts programs
/// and waits for them, panics where one fails, with its standard error.
pub fn caught<T>(work: impl FnOnce() -> T) -> Result<T, String> {
    let usual = panic::take_hook();
    panic::set_hook(Box::new(|_| {}));
    let done = panic::catch_unwind(AssertUnwindSafe(work));
    panic::set_hook(usual);
    done.map_err(|payload| {
        let text = payload.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| payload.downcast_ref::<&str>().copied());
        let lines = text.unwrap_or("it ended without a message").trim().lines();
        lines.take(MESSAGE_LINES).collect::<Vec<_>>().join("\n")
    })
}

/// Binds this process and its children to the first core that it may use.
pub fn bind_to_one_core() -> std::io::Result<()> {
    bind_to(cores()?.into_iter().take(1))
}

/// The cores that this thread may use.
pub fn cores() -> std::io::Result<Vec<usize>> {
    let allowed = rustix::thread::sched_getaffinity(None)?;
    Ok((0..rustix::thread::CpuSet::MAX_CPU).filter(|core| allowed.is_set(*core)).collect())
}

/// Binds this thread, and the threads and processes that it will start, to some cores.
pub fn bind_to(cores: impl IntoIterator<Item = usize>) -> std::io::Result<()> {
    let mut allowed = rustix::thread::CpuSet::new();
    cores.into_iter().for_each(|core| allowed.set(core));
    Ok(rustix::thread::sched_setaffinity(None, &allowed)?)
}

/// Peak of the resident memory of a process in MiB; NaN if unknown.
pub fn peak_mib(pid: u32) -> f64 {
    memory_mib(pid, "status", "VmHWM:")
}

/// Memory of a process in MiB, its share of shared pages included (PSS); NaN if unknown.
pub fn pss_mib(pid: u32) -> f64 {
    memory_mib(pid, "smaps_rollup", "Pss:")
}

fn memory_mib(pid: u32, file: &str, key: &str) -> f64 {
    let path = Path::new("/proc").join(pid.to_string()).join(file);
    let text = std::fs::read_to_string(path).unwrap_or_default();
    let value = text.lines().find_map(|line| line.strip_prefix(key));
    let kib = value.and_then(|value| value.trim().trim_end_matches(" kB").parse::<f64>().ok());
    kib.map_or(f64::NAN, |kib| kib / 1024.0)
}
