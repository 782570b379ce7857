//! Separate drives, which a command takes one by one, and the folders of their results.

use std::fs;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, visible};

use crate::output::{print, print_error};

/// Folder below the results of a replay with those of separate drives.
const DRIVES: &str = "drives";

/// Most bytes of the name of a drive: a number may follow.
const NAME_BYTES: usize = 200;

/// Calls `one` for each drive, with its name, and returns the first exit code that is not 0. After
/// an error, the others are left out.
pub(crate) fn each(
    drives: &[Vec<PathBuf>],
    json: bool,
    mut one: impl FnMut(Vec<PathBuf>, &str) -> Result<Exit, Failure>,
) -> Result<Exit, Failure> {
    let mut first = Exit::Ok;
    for (n, (drive, name)) in drives.iter().zip(names(drives)).enumerate() {
        if !json {
            print(&format!("\ndrive {}\n", visible(&name)))?;
        }
        let exit = one(drive.clone(), &name)?;
        first = if first == Exit::Ok { exit } else { first };
        let has_results = matches!(exit, Exit::Ok | Exit::LambdaFaulted | Exit::DriveDamaged);
        let left = drives.len() - n - 1;
        if !has_results && left > 0 {
            print_error(&format!("note: {left} of {} drives were left out\n", drives.len()));
            return Ok(exit);
        }
    }
    Ok(first)
}

pub(crate) fn folder(out: &Path) -> PathBuf {
    out.join(DRIVES)
}

/// Returns the folders of the results in `out`: itself, and those of separate drives.
pub(crate) fn result_folders(out: &Path) -> Vec<PathBuf> {
    let drives = fs::read_dir(folder(out)).into_iter().flatten();
    // Not links, whose targets may be the results of others.
    let drives = drives.flatten().filter(|drive| drive.file_type().is_ok_and(|it| it.is_dir()));
    let mut folders: Vec<_> = drives.map(|drive| drive.path()).collect();
    folders.sort();
    folders.insert(0, out.to_owned());
    folders.retain(|folder| folder.join("summary.json").is_file());
    folders
}

/// Returns a name for each drive: that of its first file or directory, with a number if another
/// one has it.
fn names(drives: &[Vec<PathBuf>]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for drive in drives {
        let file = drive.first().and_then(|path| path.file_name()).unwrap_or_default();
        let file = file.to_string_lossy();
        let name = file.strip_suffix(".zstd").unwrap_or(&file);
        let name = [".mcap", ".db3"].iter().find_map(|end| name.strip_suffix(end)).unwrap_or(name);
        let name = &name[..name.floor_char_boundary(NAME_BYTES)];
        let name = if name.is_empty() || name.starts_with('.') { "drive" } else { name };
        let name: String = name.chars().map(|c| if c.is_control() { '_' } else { c }).collect();
        let mut free = (1..).map(|n| if n == 1 { name.clone() } else { format!("{name}-{n}") });
        names.extend(free.find(|name| !names.contains(name)));
    }
    names
}

#[cfg(test)]
mod tests {
    use gleaner_lambda::{OutputLock, OutputLockError};

    use super::*;

    #[test]
    fn drives_are_named_by_their_files() {
        let drives = ["a/noon.mcap", "b/noon.mcap.zstd", "bag", "2024.01_0.db3", "...mcap", "a\n"];
        let drives = drives.map(|path| vec![PathBuf::from(path), PathBuf::from("more.mcap")]);
        assert_eq!(names(&drives), ["noon", "noon-2", "bag", "2024.01_0", "drive", "a_"]);
    }

    #[test]
    fn results_are_locked_without_following_links() {
        let out = tempfile::tempdir().unwrap();
        let (folder, precious) = (folder(out.path()), out.path().join("precious"));
        drop(OutputLock::take(&folder).unwrap());
        let held = OutputLock::take(&folder).unwrap();
        assert!(matches!(OutputLock::take(&folder), Err(OutputLockError::Busy { .. })));
        drop(held);
        fs::write(&precious, "precious").unwrap();
        fs::remove_file(folder.join(".lock")).unwrap();
        std::os::unix::fs::symlink(&precious, folder.join(".lock")).unwrap();
        assert!(matches!(OutputLock::take(&folder), Err(OutputLockError::Lock { .. })));
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
    }
}
