//! The machine of a run, as far as it affects what is measured.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde::{Deserialize, Serialize};

/// Facts that are read from the system. What cannot be read is absent, never estimated.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    /// Name and value of each fact.
    pub facts: BTreeMap<String, String>,
}

/// The environment variable that names another folder in place of `/sys`.
const SYSFS: &str = "GLEANER_BENCH_SYSFS";

/// A file with a single value, and the fact that it states.
const FILES: [(&str, &str); 9] = [
    ("board", "/proc/device-tree/model"),
    ("kernel", "/proc/sys/kernel/osrelease"),
    ("frequency governor", "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"),
    ("driver of idle states", "/sys/devices/system/cpu/cpuidle/current_driver"),
    ("cores that are isolated", "/sys/devices/system/cpu/isolated"),
    ("net.core.rmem_max", "/proc/sys/net/core/rmem_max"),
    ("net.core.rmem_default", "/proc/sys/net/core/rmem_default"),
    ("net.core.wmem_max", "/proc/sys/net/core/wmem_max"),
    ("JetPack (L4T)", "/etc/nv_tegra_release"),
];

impl Machine {
    /// Reads the facts of this machine.
    pub fn of_this() -> Self {
        let mut machine = Self::default();
        for (name, path) in FILES {
            machine.add(name, first_line(Path::new(path)));
        }
        let isolated = machine.facts.entry("cores that are isolated".to_owned()).or_default();
        if isolated.is_empty() {
            *isolated = "none".to_owned();
        }
        let simulated = std::env::var_os(SYSFS).map(|path| path.to_string_lossy().into_owned());
        machine.add("sensors, simulated", simulated);
        machine.add_version("power mode", Command::new("nvpmodel").arg("-q"));
        machine.add("processor", value_of("/proc/cpuinfo", "model name"));
        machine.add("memory", value_of("/proc/meminfo", "MemTotal"));
        machine.add("architecture", Some(std::env::consts::ARCH.to_owned()));
        let cores = std::thread::available_parallelism().ok();
        machine.add("cores that it may use", cores.map(|cores| cores.to_string()));
        machine.add("gleaner", Some(env!("CARGO_PKG_VERSION").to_owned()));
        machine
    }

    /// Adds a fact, if it is known.
    pub fn add(&mut self, name: &str, value: Option<String>) {
        if let Some(value) = value.filter(|value| !value.is_empty()) {
            self.facts.insert(name.to_owned(), value);
        }
    }

    /// Adds the first line that a program prints, as its version.
    pub fn add_version(&mut self, name: &str, command: &mut Command) {
        let output = command.output().ok().filter(|output| output.status.success());
        let line = output.and_then(|output| {
            let text = String::from_utf8_lossy(&output.stdout).into_owned();
            text.lines().next().map(|line| line.trim().to_owned())
        });
        self.add(name, line);
    }

    /// Adds the load of the machine: the averages over 1, 5 and 15 minutes.
    pub fn add_load(&mut self, name: &str) {
        let load = first_line(Path::new("/proc/loadavg"));
        let averages =
            load.map(|load| load.split_whitespace().take(3).collect::<Vec<_>>().join(", "));
        self.add(name, averages);
    }
}

/// The folder of `/sys`. Another one, with the files of another machine, is for tests only.
pub(crate) fn sysfs() -> PathBuf {
    std::env::var_os(SYSFS).map_or_else(|| "/sys".into(), PathBuf::from)
}

/// The files and folders in `folder`, in the order of their names.
pub(crate) fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    files.sort();
    files
}

/// The content of a file, without white space around it.
pub(crate) fn text(file: &Path) -> Option<String> {
    Some(fs::read_to_string(file).ok()?.trim().to_owned())
}

pub(crate) fn number(file: &Path) -> Option<u64> {
    text(file)?.parse().ok()
}

/// Returns the first line of a file; a string of a device tree ends with a zero byte.
fn first_line(path: &Path) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    text.lines().next().map(|line| line.trim_matches(['\0', ' ', '\t']).to_owned())
}

/// Returns the value after `key:` in a file of such lines.
fn value_of(path: &str, key: &str) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    text.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        (name.trim() == key).then(|| value.trim().to_owned())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_has_the_facts_that_can_be_read() {
        let mut machine = Machine::of_this();
        machine.add_load("load, before");
        machine.add_version("shell", Command::new("sh").args(["-c", "echo ' 1.2 '; echo more"]));
        machine.add_version("absent", &mut Command::new("no-such-program"));
        assert!(machine.facts.contains_key("kernel") && machine.facts.contains_key("memory"));
        assert_eq!(machine.facts["shell"], "1.2");
        assert_eq!(machine.facts["load, before"].split(", ").count(), 3);
        assert!(!machine.facts.contains_key("absent"));
    }
}
