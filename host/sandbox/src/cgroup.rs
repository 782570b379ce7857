//! Creates a control group for each runtime, where the supervisor was delegated a part of the tree
//! (`Delegate=yes` of systemd).
//!
//! It bounds what no limit of a single process can: memory and number of all processes of a lambda
//! together, including the kernel's memory for them, and their CPU time. Version 2 only. The kernel
//! allows processes in leaves only: the supervisor itself must not live in the delegated folder.

use std::fs::{self, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_protocol::Layer;

use crate::cgroup_join;

pub const NAME: &str = "control group";

/// The environment variable with the folder of a runtime's group, for [`limit_memory`].
pub const CGROUP_ENV: &str = "GLEANER_CGROUP";

const MEMORY_MAX: &str = "memory.max";
const TASKS_MAX: &str = "pids.max";
const CPU_MAX: &str = "cpu.max";

/// CPU time of a group in each interval, both in us: one core. A lambda has one thread, and more of
/// them would take the time of other lambdas.
const ONE_CORE: &str = "100000 100000";

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct CgroupLimits {
    /// Bytes of memory, page cache included, if bounded from the start.
    pub memory: Option<u64>,
    /// Processes and threads.
    pub tasks: u64,
}

/// A control group, removed when dropped.
#[derive(Debug)]
pub struct Group {
    folder: PathBuf,
    /// OOM kills in an earlier group of the same name.
    killed_before: u64,
}

impl Group {
    /// Creates the group `name` in `tree`, a folder of a cgroup v2 file system that was delegated
    /// to this user.
    ///
    /// # Errors
    ///
    /// A sentence that names what is missing, and who can provide it.
    pub fn create(tree: &Path, name: &str, bounds: CgroupLimits) -> Result<Self, String> {
        let cannot = |what: &str, error: io::Error| {
            format!("cannot {what} in `{}`: {error}", tree.display())
        };
        let controllers = fs::read_to_string(tree.join("cgroup.controllers"));
        let controllers = controllers.map_err(|error| cannot("read cgroup.controllers", error))?;
        let has = |wanted: &str| controllers.split_whitespace().any(|it| it == wanted);
        let missing: Vec<_> = ["memory", "pids"].into_iter().filter(|it| !has(it)).collect();
        if !missing.is_empty() {
            return Err(format!(
                "`{}` has no controller for {}; delegate it: Delegate=cpu memory pids",
                tree.display(),
                missing.join(" and ")
            ));
        }
        // Older units delegate none for CPU time.
        let has_cpu = has("cpu");
        let enabled = if has_cpu { "+cpu +memory +pids" } else { "+memory +pids" };
        fs::write(tree.join("cgroup.subtree_control"), enabled)
            .map_err(|error| cannot("enable the controllers", error))?;
        let folder = tree.join(name);
        match fs::create_dir(&folder) {
            // A killed runtime left it behind. If it still has processes, writing the limits fails
            // below.
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                return Err(cannot("create a group", error));
            }
            _ => {}
        }
        let killed_before = killed_for_memory(&folder);
        let group = Self { folder, killed_before };
        let bounds = [
            (MEMORY_MAX, bounds.memory.map_or_else(|| "max".to_owned(), |bytes| bytes.to_string())),
            // Without it, memory beyond the bound would be swapped out instead of being refused.
            ("memory.swap.max", "0".to_owned()),
            // Kill all of a lambda's processes or none: a part of them is useless.
            ("memory.oom.group", "1".to_owned()),
            (TASKS_MAX, bounds.tasks.to_string()),
        ];
        let cpu = has_cpu.then(|| (CPU_MAX, ONE_CORE.to_owned()));
        for (file, value) in bounds.into_iter().chain(cpu) {
            match fs::write(group.folder.join(file), value) {
                // A kernel without swap does not have this file.
                Err(error)
                    if file == "memory.swap.max" && error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(cannot(&format!("write {name}/{file}"), error)),
                Ok(()) => {}
            }
        }
        Ok(group)
    }

    /// Makes the child of `command` join the group before its first instruction; if that fails, the
    /// child does not start. The child finds its group in [`CGROUP_ENV`], for [`limit_memory`].
    /// Fails if the group's list of processes cannot be opened.
    pub fn attach(&self, command: &mut Command) -> io::Result<()> {
        let processes = OpenOptions::new().write(true).open(self.folder.join("cgroup.procs"))?;
        cgroup_join::before_exec(command.env(CGROUP_ENV, &self.folder), processes);
        Ok(())
    }

    /// Returns the number of processes of the group that the kernel killed because the group was
    /// out of memory.
    pub fn killed_for_memory(&self) -> u64 {
        killed_for_memory(&self.folder).saturating_sub(self.killed_before)
    }

    /// Returns the state of the layer, as text for users.
    pub fn layer(&self) -> Layer {
        layer(&self.folder)
    }
}

/// Bounds the memory of this process's group by `bytes`, unless its bound is smaller. A runtime
/// calls this once it has read its lambda's limits, before the lambda is loaded. Returns the layer;
/// `None` without a group.
pub fn limit_memory(bytes: u64) -> Option<Layer> {
    let folder = PathBuf::from(std::env::var_os(CGROUP_ENV)?);
    Some(limit_memory_in(&folder, bytes).unwrap_or_else(|error| {
        let why = format!(
            "cannot bound the memory of `{}` by {} MiB: {error}",
            folder.display(),
            bytes >> 20
        );
        Layer::partly(NAME, why)
    }))
}

fn limit_memory_in(folder: &Path, bytes: u64) -> io::Result<Layer> {
    let file = folder.join(MEMORY_MAX);
    let bound =
        fs::read_to_string(&file)?.trim().parse().map_or(bytes, |bound: u64| bound.min(bytes));
    fs::write(&file, bound.to_string())?;
    Ok(layer(folder))
}

fn layer(folder: &Path) -> Layer {
    let bound = |file| fs::read_to_string(folder.join(file)).unwrap_or_default();
    let (memory, tasks) = (bound(MEMORY_MAX), bound(TASKS_MAX));
    let memory = match memory.trim().parse::<u64>() {
        Ok(bytes) => format!("{} MiB", bytes >> 20),
        Err(_) => "as much memory as the lambda needs".to_owned(),
    };
    let cpu = if bound(CPU_MAX).trim() == ONE_CORE { "one core" } else { "all cores" };
    Layer::yes(NAME, format!("`{}`: {memory}, {} tasks, {cpu}", folder.display(), tasks.trim()))
}

fn killed_for_memory(folder: &Path) -> u64 {
    let events = fs::read_to_string(folder.join("memory.events")).unwrap_or_default();
    let count = events.lines().find_map(|line| line.strip_prefix("oom_kill "));
    count.and_then(|count| count.trim().parse().ok()).unwrap_or(0)
}

impl Drop for Group {
    fn drop(&mut self) {
        // All of its processes have ended. If one has not, the folder stays, and the next group of
        // this name reuses it.
        let _ = fs::remove_dir(&self.folder);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: CgroupLimits = CgroupLimits { memory: Some(64 << 20), tasks: 32 };

    /// A folder that looks like a delegated one, without the kernel's behaviour.
    struct Tree(PathBuf);

    impl Tree {
        fn with(controllers: &str, name: &str) -> Self {
            let tree =
                std::env::temp_dir().join(format!("gleaner-cgroup-{}-{name}", std::process::id()));
            fs::create_dir_all(&tree).unwrap();
            fs::write(tree.join("cgroup.controllers"), controllers).unwrap();
            Self(tree)
        }

        fn text(&self, file: &str) -> String {
            fs::read_to_string(self.0.join(file)).unwrap()
        }
    }

    impl Drop for Tree {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn a_group_is_bounded_before_a_process_joins_it() {
        let tree = Tree::with("cpu memory pids\n", "bounded");
        let group = Group::create(&tree.0, "brake-dark", BOUNDS).unwrap();
        assert_eq!(tree.text("cgroup.subtree_control"), "+cpu +memory +pids");
        assert_eq!(tree.text("brake-dark/cpu.max"), "100000 100000");
        assert!(group.layer().note.ends_with("64 MiB, 32 tasks, one core"), "{:?}", group.layer());
        assert_eq!(tree.text("brake-dark/memory.max"), "67108864");
        assert_eq!(tree.text("brake-dark/memory.oom.group"), "1");
        assert_eq!(tree.text("brake-dark/pids.max"), "32");
        let mut program = Command::new("/bin/true");
        let missing = group.attach(&mut program).unwrap_err();
        assert_eq!(missing.kind(), io::ErrorKind::NotFound);
        fs::write(tree.0.join("brake-dark/cgroup.procs"), "").unwrap();
        group.attach(&mut program).unwrap();
        assert!(program.status().unwrap().success());
        // A process joins by writing 0.
        assert_eq!(tree.text("brake-dark/cgroup.procs"), "0");
    }

    #[test]
    fn processes_killed_in_an_earlier_group_are_not_counted() {
        let tree = Tree::with("memory pids\n", "again");
        let events = |count: u32| {
            let text = format!("low 0\noom 3\noom_kill {count}\n");
            fs::write(tree.0.join("x/memory.events"), text).unwrap();
        };
        fs::create_dir(tree.0.join("x")).unwrap();
        events(2);
        let group = Group::create(&tree.0, "x", BOUNDS).unwrap();
        assert_eq!(group.killed_for_memory(), 0);
        events(3);
        assert_eq!(group.killed_for_memory(), 1);
    }

    #[test]
    fn a_bound_can_be_lowered_and_never_grows() {
        let tree = Tree::with("memory pids\n", "fits");
        let group = Group::create(&tree.0, "x", CgroupLimits { memory: None, tasks: 9 }).unwrap();
        assert_eq!(tree.text("x/memory.max"), "max");
        let note = |bytes| limit_memory_in(&group.folder, bytes).unwrap().note;
        assert!(note(96 << 20).ends_with("x`: 96 MiB, 9 tasks, all cores"), "{}", note(96 << 20));
        assert_eq!(tree.text("x/memory.max"), (96 << 20).to_string());
        assert!(note(97 << 20).ends_with("x`: 96 MiB, 9 tasks, all cores"), "{}", note(97 << 20));
        assert!(limit_memory_in(&tree.0.join("gone"), 1).is_err());
    }

    #[test]
    fn an_error_names_the_controllers_that_were_not_delegated() {
        let tree = Tree::with("cpu pids\n", "missing");
        let why = Group::create(&tree.0, "x", BOUNDS).unwrap_err();
        assert!(
            why.contains("has no controller for memory; delegate it: Delegate=cpu memory pids"),
            "{why}"
        );
        let why = Group::create(&tree.0.join("nowhere"), "x", BOUNDS).unwrap_err();
        assert!(why.contains("cannot read cgroup.controllers"), "{why}");
    }
}
