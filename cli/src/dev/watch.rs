//! Waits until a source of a lambda is saved.
//!
//! It polls the lengths and dates of the sources several times a second. That takes few calls, and
//! unlike kernel notifications it works on shared and mounted folders, and with editors that
//! replace files.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, SystemTime};

use gleaner_lambda::{Manifest, Sources};

/// Poll interval, shorter than a user notices.
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// Lengths and dates of the sources of a lambda at one time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SourceSnapshot(BTreeMap<PathBuf, Option<(u64, SystemTime)>>);

impl SourceSnapshot {
    /// Returns the current state of `dir`. If the manifest cannot be read, it is the only known
    /// source.
    pub(super) fn of(dir: &Path) -> Self {
        let sources =
            Manifest::load(dir).ok().and_then(|manifest| Sources::of(dir, &manifest).ok());
        let sources = sources.iter().flat_map(Sources::iter).chain([Path::new("lambda.toml")]);
        let state = |path: &Path| {
            let metadata = fs::metadata(dir.join(path)).ok()?;
            Some((metadata.len(), metadata.modified().ok()?))
        };
        Self(sources.map(|path| (path.to_owned(), state(path))).collect())
    }

    /// Waits until the sources in `dir` differ from these and are no longer being written. Returns
    /// their new state, and the paths that differ.
    pub(super) fn wait_for_change(&self, dir: &Path) -> (Self, Vec<PathBuf>) {
        loop {
            thread::sleep(POLL_INTERVAL);
            let now = Self::of(dir);
            if now == *self {
                continue;
            }
            thread::sleep(POLL_INTERVAL);
            if Self::of(dir) == now {
                let changed = self.changed(&now);
                return (now, changed);
            }
        }
    }

    fn changed(&self, now: &Self) -> Vec<PathBuf> {
        let paths = self.0.keys().chain(now.0.keys().filter(|path| !self.0.contains_key(*path)));
        paths.filter(|path| self.0.get(*path) != now.0.get(*path)).cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MANIFEST: &str = "[lambda]\nname = \"x\"\nversion = \"0.1.0\"\nkind = \"python\"\nentry = \"main.py\"\n\
                            [schedule]\nperiod = \"1s\"\n[[input]]\nname = \"imu\"\ntopic = \"/imu\"\n\
                            type = \"sensor_msgs/msg/Imu\"\n";

    #[test]
    fn saved_sources_are_changes_and_other_files_are_not() {
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path();
        let write = |name: &str, text: &str| {
            fs::create_dir_all(dir.join(name).parent().unwrap()).unwrap();
            fs::write(dir.join(name), text).unwrap();
        };
        write("lambda.toml", MANIFEST);
        write("main.py", "a");
        let before = SourceSnapshot::of(dir);
        for other in ["out/decisions.jsonl", "build/main.py", "notes.txt", "tests/test_x.py"] {
            write(other, "x");
        }
        assert_eq!(before, SourceSnapshot::of(dir));
        write("main.py", "ab");
        write("more/part.py", "c");
        let (after, changed) = before.wait_for_change(dir);
        assert_eq!(changed, [PathBuf::from("main.py"), PathBuf::from("more/part.py")]);
        // Breaking and mending the manifest are both changes.
        write("lambda.toml", "[lambda");
        let (broken, changed) = after.wait_for_change(dir);
        assert!(changed.contains(&PathBuf::from("lambda.toml")), "{changed:?}");
        write("lambda.toml", MANIFEST);
        assert_ne!(broken, SourceSnapshot::of(dir));
    }
}
