//! The cache does not grow without end: what nobody has loaded for long goes first.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use gleaner_base::own_file;

/// Most bytes of native code that are kept; an ordinary lambda takes half a megabyte. It goes by
/// when code was loaded last, so it is that of components that were built anew, of earlier versions
/// and of other settings that goes.
pub const CACHE_BYTES: u64 = 1 << 30;

/// When code was loaded is noted once in this time, so that a start does not write to the disk.
const DAY: Duration = Duration::from_secs(24 * 3600);

/// Notes that the code in `entry` is in use. What cannot be noted goes earlier, and is made again.
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

/// Removes from `cache` what was not in use for longest, until at most `most` bytes are left, and
/// what a killed process did not complete. `keep` stays. What a process has loaded stays for that.
/// Another process may do the same meanwhile.
///
/// # Errors
///
/// Those of reading the folder; what cannot be removed stays.
pub(crate) fn prune(cache: &Path, keep: &Path, most: u64) -> io::Result<()> {
    let mut bytes = 0_u64;
    let mut entries: Vec<(SystemTime, PathBuf, u64)> = Vec::new();
    for entry in fs::read_dir(cache)? {
        let path = entry?.path();
        let Ok(meta) = fs::symlink_metadata(&path) else { continue };
        let Ok(modified) = meta.modified() else { continue };
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("part") => remove_abandoned(&path),
            Some("cwasm") => {
                bytes = bytes.saturating_add(meta.len());
                entries.extend((path != keep).then_some((modified, path, meta.len())));
            }
            _ => {}
        }
    }
    entries.sort();
    for (_, path, len) in entries {
        if bytes <= most {
            break;
        }
        if fs::remove_file(path).is_ok() {
            bytes -= len;
        }
    }
    Ok(())
}

/// Removes what no process locks, as those do that write it.
fn remove_abandoned(part: &Path) {
    let Ok(file) = own_file::edit(part) else { return };
    if file.try_lock().is_ok() {
        // Still locked, so that a process that began it meanwhile sees that it is gone.
        let _ = fs::remove_file(part);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of so many bytes that was last in use so long ago.
    fn file(path: &Path, bytes: u64, ago: Duration) {
        let file = File::create(path).unwrap();
        file.set_len(bytes).unwrap();
        file.set_modified(SystemTime::now() - ago).unwrap();
    }

    #[test]
    fn what_nobody_used_for_longest_goes_first() {
        let cache = std::env::temp_dir().join(format!("gleaner-prune-{}", std::process::id()));
        fs::create_dir_all(&cache).unwrap();
        for (day, name) in
            ["new.cwasm", "older.cwasm", "oldest.cwasm", "kept.cwasm"].into_iter().enumerate()
        {
            file(&cache.join(name), 1000, DAY * (day as u32 + 1));
        }
        file(&cache.join("x.17.part"), 10, DAY * 2);
        file(&cache.join("y.18.part"), 10, DAY * 2);
        let writer = own_file::edit(&cache.join("y.18.part")).unwrap();
        writer.lock().unwrap();
        file(&cache.join("foreign.txt"), 10_000, DAY * 9);
        let left = |most| {
            prune(&cache, &cache.join("kept.cwasm"), most).unwrap();
            let mut names: Vec<_> = fs::read_dir(&cache)
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
        note_use(&File::open(cache.join("older.cwasm")).unwrap());
        assert_eq!(left(2000), "foreign.txt kept.cwasm older.cwasm y.18.part");
        assert_eq!(left(0), "foreign.txt kept.cwasm y.18.part");
        // Its writer was killed.
        drop(writer);
        assert_eq!(left(0), "foreign.txt kept.cwasm");
        fs::remove_dir_all(&cache).unwrap();
    }
}
