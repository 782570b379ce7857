//! What a process takes, as the system tells it.

/// Resident memory of this process, in bytes; 0 where the system does not tell.
pub fn resident() -> u64 {
    told("VmRSS:")
}

/// The most that it was so far.
pub fn most_resident() -> u64 {
    told("VmHWM:")
}

/// CPU time of all threads of this process, in s.
pub fn cpu_seconds() -> f64 {
    let used = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    used.tv_sec as f64 + used.tv_nsec as f64 / 1e9
}

/// A line of `/proc/self/status`, in bytes.
fn told(name: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix(name));
    let kib = line.and_then(|line| line.trim().strip_suffix(" kB")).and_then(|kib| kib.parse::<u64>().ok());
    kib.unwrap_or(0) * 1024
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_has_memory_and_uses_time() {
        assert!(resident() > 0 && most_resident() >= resident() / 2);
        let before = cpu_seconds();
        while cpu_seconds() == before {
            std::hint::black_box(resident());
        }
        assert!(cpu_seconds() > before);
    }
}
