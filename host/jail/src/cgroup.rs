//! A control group of its own for each runtime, where a supervisor was given a part of the tree
//! (`Delegate=yes` of systemd).
//!
//! It bounds what no limit of a single process can: memory and number of all processes of a lambda
//! together, with everything that the kernel keeps for them. Version 2 only. The rule of the kernel
//! is that processes live in leaves: the supervisor itself must not live in the folder that it
//! hands to us.

use std::fs::{self, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_protocol::Layer;

use crate::enter;

/// The name of this layer.
pub const NAME: &str = "control group";

/// The environment variable with the folder of a runtime's group, for [`fit`].
pub const CGROUP_ENV: &str = "GLEANER_CGROUP";

const MEMORY_MAX: &str = "memory.max";
const TASKS_MAX: &str = "pids.max";

/// What a group may take.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Bytes of memory, page cache included, if they are bounded from the start.
    pub memory: Option<u64>,
    /// Processes and threads.
    pub tasks: u64,
}

/// A group, until it is removed.
#[derive(Debug)]
pub struct Group {
    folder: PathBuf,
    /// What the kernel had killed in one of the same name, before this was made.
    killed_before: u64,
}

impl Group {
    /// Makes the group `name` in `tree`, a folder of a cgroup 2 file system that was delegated to
    /// this user.
    ///
    /// # Errors
    ///
    /// A sentence: what is missing, and who can give it.
    pub fn make(tree: &Path, name: &str, bounds: Bounds) -> Result<Self, String> {
        let cannot = |what: &str, error: io::Error| {
            format!("cannot {what} in `{}`: {error}", tree.display())
        };
        let controllers = fs::read_to_string(tree.join("cgroup.controllers"));
        let controllers = controllers.map_err(|error| cannot("read cgroup.controllers", error))?;
        let missing: Vec<_> = ["memory", "pids"]
            .into_iter()
            .filter(|wanted| !controllers.split_whitespace().any(|it| it == *wanted))
            .collect();
        if !missing.is_empty() {
            return Err(format!(
                "`{}` has no controller for {}; delegate it: Delegate=memory pids",
                tree.display(),
                missing.join(" and ")
            ));
        }
        fs::write(tree.join("cgroup.subtree_control"), "+memory +pids")
            .map_err(|error| cannot("hand on the controllers", error))?;
        let folder = tree.join(name);
        match fs::create_dir(&folder) {
            // Left by one that was killed; a group that still has processes refuses us below.
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                return Err(cannot("make a group", error));
            }
            _ => {}
        }
        let killed_before = killed_for_memory(&folder);
        let group = Self { folder, killed_before };
        let bounds = [
            (MEMORY_MAX, bounds.memory.map_or_else(|| "max".to_owned(), |bytes| bytes.to_string())),
            // Else memory beyond the bound would go to disk instead of being refused.
            ("memory.swap.max", "0".to_owned()),
            // All of a lambda's processes, or none: half of it is of no use.
            ("memory.oom.group", "1".to_owned()),
            (TASKS_MAX, bounds.tasks.to_string()),
        ];
        for (file, value) in bounds {
            match fs::write(group.folder.join(file), value) {
                // A kernel without swap has no file for it.
                Err(error)
                    if file == "memory.swap.max" && error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(cannot(&format!("write {name}/{file}"), error)),
                Ok(()) => {}
            }
        }
        Ok(group)
    }

    /// Has what `command` starts be in it from its first instruction on; if it cannot be, it does
    /// not start. It is told of its group, for [`fit`].
    ///
    /// # Errors
    ///
    /// Those of opening the group's list of processes.
    pub fn holds(&self, command: &mut Command) -> io::Result<()> {
        let processes = OpenOptions::new().write(true).open(self.folder.join("cgroup.procs"))?;
        enter::before_program(command.env(CGROUP_ENV, &self.folder), processes);
        Ok(())
    }

    /// How often the kernel killed a process of it, for want of memory.
    pub fn killed_for_memory(&self) -> u64 {
        killed_for_memory(&self.folder).saturating_sub(self.killed_before)
    }

    /// What holds, for people.
    pub fn layer(&self) -> Layer {
        layer(&self.folder)
    }
}

/// Bounds the memory of the group of this process by `bytes`, unless its bound is smaller: for a
/// runtime that knows what its lambda may take, before the lambda is in it. Gives the layer; `None`
/// without a group.
pub fn fit(bytes: u64) -> Option<Layer> {
    let folder = PathBuf::from(std::env::var_os(CGROUP_ENV)?);
    Some(fit_in(&folder, bytes).unwrap_or_else(|error| {
        let why = format!(
            "cannot bound the memory of `{}` by {} MiB: {error}",
            folder.display(),
            bytes >> 20
        );
        Layer::partly(NAME, why)
    }))
}

fn fit_in(folder: &Path, bytes: u64) -> io::Result<Layer> {
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
    Layer::yes(NAME, format!("`{}`: {memory}, {} tasks", folder.display(), tasks.trim()))
}

fn killed_for_memory(folder: &Path) -> u64 {
    let events = fs::read_to_string(folder.join("memory.events")).unwrap_or_default();
    let count = events.lines().find_map(|line| line.strip_prefix("oom_kill "));
    count.and_then(|count| count.trim().parse().ok()).unwrap_or(0)
}

impl Drop for Group {
    fn drop(&mut self) {
        // All of its processes have ended. Where one has not, the folder stays, and the next of its
        // name takes it over.
        let _ = fs::remove_dir(&self.folder);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: Bounds = Bounds { memory: Some(64 << 20), tasks: 32 };

    /// A folder that looks as one that was delegated. The kernel's behaviour behind it is not
    /// there.
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
    fn a_group_is_bounded_before_a_process_is_in_it() {
        let tree = Tree::with("cpu memory pids\n", "bounded");
        let group = Group::make(&tree.0, "brake-dark", BOUNDS).unwrap();
        assert_eq!(tree.text("cgroup.subtree_control"), "+memory +pids");
        assert_eq!(tree.text("brake-dark/memory.max"), "67108864");
        assert_eq!(tree.text("brake-dark/memory.oom.group"), "1");
        assert_eq!(tree.text("brake-dark/pids.max"), "32");
        let mut program = Command::new("/bin/true");
        let missing = group.holds(&mut program).unwrap_err();
        assert_eq!(missing.kind(), io::ErrorKind::NotFound);
        fs::write(tree.0.join("brake-dark/cgroup.procs"), "").unwrap();
        group.holds(&mut program).unwrap();
        assert!(program.status().unwrap().success());
        // As a process names itself.
        assert_eq!(tree.text("brake-dark/cgroup.procs"), "0");
    }

    #[test]
    fn what_was_killed_in_an_earlier_group_does_not_count() {
        let tree = Tree::with("memory pids\n", "again");
        let events = |count: u32| {
            let text = format!("low 0\noom 3\noom_kill {count}\n");
            fs::write(tree.0.join("x/memory.events"), text).unwrap();
        };
        fs::create_dir(tree.0.join("x")).unwrap();
        events(2);
        let group = Group::make(&tree.0, "x", BOUNDS).unwrap();
        assert_eq!(group.killed_for_memory(), 0);
        events(3);
        assert_eq!(group.killed_for_memory(), 1);
    }

    #[test]
    fn a_bound_follows_what_is_needed_and_never_grows() {
        let tree = Tree::with("memory pids\n", "fits");
        let group = Group::make(&tree.0, "x", Bounds { memory: None, tasks: 9 }).unwrap();
        assert_eq!(tree.text("x/memory.max"), "max");
        let note = |bytes| fit_in(&group.folder, bytes).unwrap().note;
        assert!(note(96 << 20).ends_with("x`: 96 MiB, 9 tasks"), "{}", note(96 << 20));
        assert_eq!(tree.text("x/memory.max"), (96 << 20).to_string());
        assert!(note(97 << 20).ends_with("x`: 96 MiB, 9 tasks"), "{}", note(97 << 20));
        assert!(fit_in(&tree.0.join("gone"), 1).is_err());
    }

    #[test]
    fn what_was_not_delegated_is_named() {
        let tree = Tree::with("cpu pids\n", "missing");
        let why = Group::make(&tree.0, "x", BOUNDS).unwrap_err();
        assert!(
            why.contains("has no controller for memory; delegate it: Delegate=memory pids"),
            "{why}"
        );
        let why = Group::make(&tree.0.join("nowhere"), "x", BOUNDS).unwrap_err();
        assert!(why.contains("cannot read cgroup.controllers"), "{why}");
    }
}
