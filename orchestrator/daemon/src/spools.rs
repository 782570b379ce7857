//! Records of deployments that were removed: they can be read for a while, and do not fill the
//! disk.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Number of removed deployments whose records are kept, the newest ones.
pub(crate) const KEPT: usize = 8;

/// Removes the records of deployments other than `kept`, but for the newest [`KEPT`], in the folder
/// `lambdas` of the spools. Returns the ids of which they were removed.
pub(crate) fn collect(lambdas: &Path, kept: &BTreeSet<String>) -> Vec<String> {
    // A folder that cannot be read is tried again at the next removal.
    let entries = fs::read_dir(lambdas).into_iter().flatten().flatten();
    let removed = entries.filter_map(|entry| {
        let id = entry.file_name().into_string().ok().filter(|id| !kept.contains(id))?;
        Some((newest(&entry.path()), id, entry.path()))
    });
    let mut removed: Vec<_> = removed.collect();
    removed.sort();
    removed.reverse();
    let old = removed.split_off(KEPT.min(removed.len())).into_iter();
    old.filter(|(_, _, path)| fs::remove_dir_all(path).is_ok()).map(|(_, id, _)| id).collect()
}

/// Returns the time at which a file of the folder was written last.
fn newest(folder: &PathBuf) -> Option<std::time::SystemTime> {
    let files = fs::read_dir(folder).into_iter().flatten().flatten();
    files.filter_map(|file| file.metadata().ok()?.modified().ok()).max()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_records_of_removed_deployments_stay() {
        let folder = tempfile::tempdir().unwrap();
        for number in 0..=KEPT + 1 {
            let path = folder.path().join(format!("id-{number}"));
            fs::create_dir(&path).unwrap();
            let file = fs::File::create(path.join("segment")).unwrap();
            let time = std::time::Duration::from_secs(1_000_000 + number as u64);
            file.set_modified(std::time::UNIX_EPOCH + time).unwrap();
        }
        let kept = BTreeSet::from(["id-0".to_owned()]);
        assert_eq!(collect(folder.path(), &kept), ["id-1"]);
        assert!(folder.path().join("id-0").is_dir() && folder.path().join("id-2").is_dir());
        assert!(collect(folder.path(), &kept).is_empty());
    }
}
