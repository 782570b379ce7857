//! Records of deployments that were removed: they can be read for a while, and do not fill the
//! disk.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

/// Number of removed deployments whose records are kept: those that were removed last.
pub(crate) const KEPT: usize = 8;

/// Removes the records of deployments other than `kept` in the folder `lambdas` of the spools.
/// Returns their ids.
pub(crate) fn collect(lambdas: &Path, kept: &BTreeSet<String>) -> Vec<String> {
    // A folder that cannot be read is tried again at the next removal.
    let entries = fs::read_dir(lambdas).into_iter().flatten().flatten();
    let old = entries.filter_map(|entry| {
        let id = entry.file_name().into_string().ok().filter(|id| !kept.contains(id))?;
        fs::remove_dir_all(entry.path()).is_ok().then_some(id)
    });
    let mut old: Vec<_> = old.collect();
    old.sort();
    old
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_records_that_are_kept_stay() {
        let folder = tempfile::tempdir().unwrap();
        for id in ["a", "b", "c"] {
            fs::create_dir(folder.path().join(id)).unwrap();
            fs::write(folder.path().join(id).join("segment"), "").unwrap();
        }
        let kept = BTreeSet::from(["b".to_owned()]);
        assert_eq!(collect(folder.path(), &kept), ["a", "c"]);
        assert!(folder.path().join("b/segment").is_file());
        assert!(collect(folder.path(), &kept).is_empty());
    }
}
