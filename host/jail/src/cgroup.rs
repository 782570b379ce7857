//! A control group of its own for each runtime, where a supervisor was given a part of the tree (`Delegate=yes` of systemd).
//!
//! It bounds what no limit of a single process can: memory and number of all processes of a lambda together, with everything
//! that the kernel keeps for them. Version 2 only. The rule of the kernel is that processes live in leaves: the supervisor itself
//! must not live in the folder that it hands to us.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_protocol::Layer;

/// The name of this layer.
pub const NAME: &str = "control group";

/// What a group may take.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Bytes of memory, page cache included.
    pub memory: u64,
    /// Processes and threads.
    pub tasks: u64,
}

/// A group, until it is removed.
#[derive(Debug)]
pub struct Group {
    folder: PathBuf,
}

impl Group {
    /// Makes the group `name` in `tree`, a folder of a cgroup 2 file system that was delegated to this user.
    ///
    /// # Errors
    ///
    /// A sentence: what is missing, and who can give it.
    pub fn make(tree: &Path, name: &str, bounds: Bounds) -> Result<Self, String> {
        let cannot = |what: &str, error: io::Error| format!("cannot {what} in `{}`: {error}", tree.display());
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
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(cannot("make a group", error)),
            _ => {}
        }
        let group = Self { folder };
        let bounds = [
            ("memory.max", bounds.memory.to_string()),
            // Else memory beyond the bound would go to disk instead of being refused.
            ("memory.swap.max", "0".to_owned()),
            // All of a lambda's processes, or none: half of it is of no use.
            ("memory.oom.group", "1".to_owned()),
            ("pids.max", bounds.tasks.to_string()),
        ];
        for (file, value) in bounds {
            match fs::write(group.folder.join(file), value) {
                // A kernel without swap has no file for it.
                Err(error) if file == "memory.swap.max" && error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(cannot(&format!("write {name}/{file}"), error)),
                Ok(()) => {}
            }
        }
        Ok(group)
    }

    /// Moves a process into it; what that starts is in it from the start.
    ///
    /// # Errors
    ///
    /// Those of the file system.
    pub fn take(&self, pid: u32) -> io::Result<()> {
        fs::write(self.folder.join("cgroup.procs"), pid.to_string())
    }

    /// How often the kernel killed a process of it, for want of memory.
    pub fn killed_for_memory(&self) -> u64 {
        let events = fs::read_to_string(self.folder.join("memory.events")).unwrap_or_default();
        let count = events.lines().find_map(|line| line.strip_prefix("oom_kill "));
        count.and_then(|count| count.trim().parse().ok()).unwrap_or(0)
    }

    /// What holds, for people.
    pub fn layer(&self, bounds: Bounds) -> Layer {
        let Bounds { memory, tasks } = bounds;
        Layer::yes(NAME, format!("`{}`: {} MiB, {tasks} tasks", self.folder.display(), memory >> 20))
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // All of its processes have ended. Where one has not, the folder stays, and the next of its name takes it over.
        let _ = fs::remove_dir(&self.folder);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS: Bounds = Bounds { memory: 64 << 20, tasks: 32 };

    /// A folder that looks as one that was delegated. The kernel's behaviour behind it is not there.
    struct Tree(PathBuf);

    impl Tree {
        fn with(controllers: &str, name: &str) -> Self {
            let tree = std::env::temp_dir().join(format!("gleaner-cgroup-{}-{name}", std::process::id()));
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
        group.take(4711).unwrap();
        assert_eq!(tree.text("brake-dark/cgroup.procs"), "4711");
        fs::write(tree.0.join("brake-dark/memory.events"), "low 0\noom 3\noom_kill 2\n").unwrap();
        assert_eq!(group.killed_for_memory(), 2);
    }

    #[test]
    fn what_was_not_delegated_is_named() {
        let tree = Tree::with("cpu pids\n", "missing");
        let why = Group::make(&tree.0, "x", BOUNDS).unwrap_err();
        assert!(why.contains("has no controller for memory; delegate it: Delegate=memory pids"), "{why}");
        let why = Group::make(&tree.0.join("nowhere"), "x", BOUNDS).unwrap_err();
        assert!(why.contains("cannot read cgroup.controllers"), "{why}");
    }
}
