//! Reads the resource usage of a process from the system.

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt;

/// Returns the resident memory of this process, in bytes, without shared memory: topics that the
/// ingress provides belong to all processes that map them. 0 if unknown.
pub fn resident() -> u64 {
    let status = own_status();
    value(&status, "VmRSS:").saturating_sub(value(&status, "RssShmem:"))
}

/// Returns the shared memory of which this process has used pages, in bytes; 0 if unknown.
pub fn resident_shared() -> u64 {
    value(&own_status(), "RssShmem:")
}

/// Returns the peak of the resident memory of this process with shared memory, in bytes; 0 if
/// unknown.
pub fn peak_resident() -> u64 {
    value(&own_status(), "VmHWM:")
}

/// Returns the CPU time of all threads of this process, in s.
pub fn cpu_seconds() -> f64 {
    let used = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    used.tv_sec as f64 + used.tv_nsec as f64 / 1e9
}

/// State of a process, from `/proc`.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct ProcessUsage {
    /// Set if the process is stopped by a signal.
    pub is_stopped: bool,
    pub threads: u64,
    /// Private memory: pages in RAM or swapped out, and page tables, in bytes. Pages of files and
    /// shared memory are not counted: a lambda can create none, and that of its topics exists once.
    pub held: u64,
}

impl ProcessUsage {
    /// Reads the state of process `pid`, or of this one. `None` if the system does not show it.
    pub fn of(pid: Option<u32>) -> Option<Self> {
        StatusFile::open(pid).ok()?.usage()
    }

    fn parse(status: &str) -> Option<Self> {
        let mut seen = Self { is_stopped: false, threads: 0, held: 0 };
        let mut has_memory = false;
        for (name, value) in status.lines().filter_map(|line| line.split_once(':')) {
            match name {
                "State" => seen.is_stopped = value.trim_start().starts_with('T'),
                "Threads" => seen.threads = value.trim().parse().ok()?,
                "RssAnon" => {
                    seen.held += kib(value)?;
                    has_memory = true;
                }
                "VmSwap" | "VmPTE" | "HugetlbPages" => seen.held += kib(value)?,
                _ => {}
            }
        }
        has_memory.then_some(seen)
    }
}

/// The open file `status` of a process, which can be read again and again. A check of the shim
/// takes 83 us with it; it took 148 us when it opened this file and that of the limits each time.
#[derive(Debug)]
pub struct StatusFile(File);

impl StatusFile {
    /// Opens the file of process `pid`, or of this one.
    ///
    /// # Errors
    ///
    /// Errors of opening it: the process has ended, or `/proc` does not show it.
    pub fn open(pid: Option<u32>) -> io::Result<Self> {
        File::open(proc_path(pid, "status")).map(Self)
    }

    /// Reads the state. `None` once the process has ended.
    pub fn usage(&self) -> Option<ProcessUsage> {
        // More than the file has, unless the user is in hundreds of groups.
        let mut text = vec![0; 4096];
        let mut length = 0;
        loop {
            let read = self.0.read_at(&mut text[length..], length as u64).ok()?;
            length += read;
            if length < text.len() {
                break;
            }
            text.resize(2 * length, 0);
        }
        ProcessUsage::parse(std::str::from_utf8(&text[..length]).ok()?)
    }
}

/// Returns the limit of private writable memory of process `pid`, in bytes, which the process
/// cannot raise. `None` without a limit.
pub fn data_limit(pid: u32) -> Option<u64> {
    let limits = fs::read_to_string(proc_path(Some(pid), "limits")).ok()?;
    let line = limits.lines().find_map(|line| line.strip_prefix("Max data size"))?;
    line.split_whitespace().nth(1)?.parse().ok()
}

/// Private pages of this process in RAM: most of [`ProcessUsage::held`], in a tenth of the time.
#[derive(Debug)]
pub struct PrivatePages(File);

impl PrivatePages {
    /// Opens the counters of this process.
    ///
    /// # Errors
    ///
    /// Errors of opening a file of `/proc`.
    pub fn open() -> io::Result<Self> {
        File::open("/proc/self/statm").map(Self)
    }

    /// Returns the size of these pages, in bytes. `None` if the file cannot be read any more: a
    /// lambda in this process may have closed it.
    pub fn bytes(&self) -> Option<u64> {
        let mut text = [0; 128];
        let length = self.0.read_at(&mut text, 0).ok()?;
        let text = std::str::from_utf8(&text[..length]).ok()?;
        let mut pages =
            text.split_ascii_whitespace().skip(1).map_while(|count| count.parse::<u64>().ok());
        let (resident, shared) = (pages.next()?, pages.next()?);
        Some(resident.saturating_sub(shared) * rustix::param::page_size() as u64)
    }
}

fn proc_path(pid: Option<u32>, file: &str) -> String {
    pid.map_or_else(|| format!("/proc/self/{file}"), |pid| format!("/proc/{pid}/{file}"))
}

/// Returns the file `/proc/self/status`; empty if it cannot be read.
fn own_status() -> String {
    fs::read_to_string(proc_path(None, "status")).unwrap_or_default()
}

/// Returns a value of the file `status` of a process, in bytes; 0 if it is missing.
fn value(status: &str, name: &str) -> u64 {
    status.lines().find_map(|line| line.strip_prefix(name)).and_then(kib).unwrap_or(0)
}

/// Parses a number of KiB; returns bytes.
fn kib(value: &str) -> Option<u64> {
    value.trim().strip_suffix(" kB")?.parse::<u64>().ok()?.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_has_memory_and_uses_time() {
        assert!(resident() > 0 && peak_resident() >= resident() / 2);
        let before = cpu_seconds();
        while cpu_seconds() == before {
            std::hint::black_box(resident());
        }
        assert!(cpu_seconds() > before);
    }

    #[test]
    fn memory_that_is_written_to_is_held() {
        const BYTES: u64 = 32 << 20;
        let pages = PrivatePages::open().unwrap();
        let before = (pages.bytes().unwrap(), ProcessUsage::of(None).unwrap());
        assert!(!before.1.is_stopped && before.1.threads > 0, "{before:?}");
        let taken = std::hint::black_box(vec![1_u8; BYTES as usize]);
        let after = (pages.bytes().unwrap(), ProcessUsage::of(Some(std::process::id())).unwrap());
        // Other tests run at the same time, and the kernel counts in batches.
        let about = |more: u64| more.abs_diff(BYTES) < BYTES / 4;
        assert!(
            about(after.0 - before.0) && about(after.1.held - before.1.held),
            "{before:?} {after:?}"
        );
        assert_eq!(data_limit(std::process::id()), None);
        drop(taken);
    }

    #[test]
    fn shared_memory_is_not_counted_as_memory_of_a_process() {
        let status = "VmHWM:\t 90 kB\nVmRSS:\t 80 kB\nRssAnon:\t 10 kB\nRssShmem:\t 50 kB\n";
        assert_eq!(value(status, "VmRSS:") - value(status, "RssShmem:"), 30 * 1024);
        assert_eq!(ProcessUsage::parse(status).unwrap().held, 10 * 1024);
        assert!(resident() + resident_shared() <= peak_resident());
    }

    #[test]
    fn a_process_is_read_from_its_lines() {
        let status = "Name:\tx\nState:\tT (stopped)\nRssAnon:\t 10 kB\nRssFile:\t 99 kB\n\
                      RssShmem:\t 9 kB\nVmPTE:\t 2 kB\nVmSwap:\t 1 kB\nHugetlbPages:\t 4 kB\n\
                      Threads:\t3\n";
        assert_eq!(
            ProcessUsage::parse(status),
            Some(ProcessUsage { is_stopped: true, threads: 3, held: 17 * 1024 })
        );
        // A process that has ended has no memory.
        assert_eq!(ProcessUsage::parse("Name:\tx\nState:\tZ (zombie)\nThreads:\t1\n"), None);
    }
}
