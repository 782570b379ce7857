//! Bounds the size of the store: removes the least recently used entries.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use gleaner_base::safe_file;

use super::DerivedKind;

/// Maximum size of a store, in bytes; native code of an ordinary lambda takes half a megabyte, an
/// engine as much as its model. Entries of old builds, versions and settings are no longer used,
/// and so removed first.
pub const STORE_BYTES: u64 = 2 << 30;

/// Interval in which the use of an entry is noted at most once, so that few starts write to the
/// disk.
const DAY: Duration = Duration::from_secs(24 * 3600);

/// Notes the use of `entry` in its modification time. If that fails, it is only removed earlier.
pub(crate) fn note_use(entry: &File) {
    let _ = (|| {
        let used = entry.metadata()?.modified()?;
        let now = SystemTime::now();
        if now.duration_since(used).is_ok_and(|ago| ago < DAY) {
            Ok(())
        } else {
            entry.set_modified(now)
        }
    })();
}

/// Removes the least recently used entries of `store`, except `keep`, until at most `max` bytes are
/// left, and the partial files of killed processes. Processes keep what they have loaded.
/// Several processes may prune at the same time.
///
/// # Errors
///
/// Errors of reading the folder; files that cannot be removed stay.
pub(crate) fn prune(store: &Path, keep: &Path, max: u64) -> io::Result<()> {
    let mut bytes = 0_u64;
    let mut entries: Vec<(SystemTime, PathBuf, u64)> = Vec::new();
    for entry in fs::read_dir(store)? {
        let path = entry?.path();
        let Ok(meta) = fs::symlink_metadata(&path) else { continue };
        let Ok(modified) = meta.modified() else { continue };
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("part") => remove_abandoned(&path),
            Some(kind) if DerivedKind::ALL.iter().any(|it| it.extension() == kind) => {
                bytes = bytes.saturating_add(meta.len());
                entries.extend((path != keep).then_some((modified, path, meta.len())));
            }
            _ => {}
        }
    }
    entries.sort();
    for (_, path, len) in entries {
        if bytes <= max {
            break;
        }
        if fs::remove_file(path).is_ok() {
            bytes -= len;
        }
    }
    Ok(())
}

/// Removes a partial file that no process has locked; its writer would hold a lock.
fn remove_abandoned(part: &Path) {
    let Ok(file) = safe_file::edit(part) else { return };
    if file.try_lock().is_ok() {
        // Removed under the lock, so that a process that has just created it sees that it is gone.
        let _ = fs::remove_file(part);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates a file of `bytes` bytes that was last used `ago`.
    fn file(path: &Path, bytes: u64, ago: Duration) {
        let file = File::create(path).unwrap();
        file.set_len(bytes).unwrap();
        file.set_modified(SystemTime::now() - ago).unwrap();
    }

    #[test]
    fn the_least_recently_used_entries_are_removed_first() {
        let store = std::env::temp_dir().join(format!("gleaner-prune-{}", std::process::id()));
        fs::create_dir_all(&store).unwrap();
        for (day, name) in
            ["new.cwasm", "older.cwasm", "oldest.cwasm", "kept.cwasm"].into_iter().enumerate()
        {
            file(&store.join(name), 1000, DAY * (day as u32 + 1));
        }
        file(&store.join("x.17.part"), 10, DAY * 2);
        file(&store.join("y.18.part"), 10, DAY * 2);
        let writer = safe_file::edit(&store.join("y.18.part")).unwrap();
        writer.lock().unwrap();
        file(&store.join("foreign.txt"), 10_000, DAY * 9);
        let left = |max| {
            prune(&store, &store.join("kept.cwasm"), max).unwrap();
            let mut names: Vec<_> = fs::read_dir(&store)
                .unwrap()
                .map(|entry| entry.unwrap().file_name().into_string().unwrap())
                .collect();
            names.sort();
            names.join(" ")
        };
        assert_eq!(
            left(4000),
            "foreign.txt kept.cwasm new.cwasm older.cwasm oldest.cwasm y.18.part"
        );
        assert_eq!(left(3999), "foreign.txt kept.cwasm new.cwasm older.cwasm y.18.part");
        note_use(&File::open(store.join("older.cwasm")).unwrap());
        assert_eq!(left(2000), "foreign.txt kept.cwasm older.cwasm y.18.part");
        assert_eq!(left(0), "foreign.txt kept.cwasm y.18.part");
        // As if its writer had been killed.
        drop(writer);
        assert_eq!(left(0), "foreign.txt kept.cwasm");
        fs::remove_dir_all(&store).unwrap();
    }
}
