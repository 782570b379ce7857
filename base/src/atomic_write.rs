use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use crate::safe_file;

/// The file operations of an atomic write, so that tests can let each of them fail.
pub trait WriteSteps {
    type File;

    /// Creates a file in place of any of this name.
    ///
    /// # Errors
    ///
    /// Those of the file system, as for all steps.
    fn create(&self, path: &Path) -> io::Result<Self::File>;

    /// Writes all `bytes`. After an error, a part of them may be in the file.
    ///
    /// # Errors
    ///
    /// Those of the file system.
    fn write(&self, file: &mut Self::File, bytes: &[u8]) -> io::Result<()>;

    /// Makes the content durable.
    ///
    /// # Errors
    ///
    /// Those of the file system. The content is unknown then.
    fn sync(&self, file: &Self::File) -> io::Result<()>;

    /// Renames a file, in place of any at `to`.
    ///
    /// # Errors
    ///
    /// Those of the file system.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;

    /// Removes a file.
    ///
    /// # Errors
    ///
    /// Those of the file system.
    fn remove(&self, path: &Path) -> io::Result<()>;

    /// Makes the names in a folder durable.
    ///
    /// # Errors
    ///
    /// Those of the file system.
    fn sync_folder(&self, folder: &Path) -> io::Result<()>;
}

#[derive(Clone, Copy, Debug)]
pub struct DiskSteps;

impl WriteSteps for DiskSteps {
    type File = File;

    fn create(&self, path: &Path) -> io::Result<File> {
        safe_file::create(path)
    }

    fn write(&self, file: &mut File, bytes: &[u8]) -> io::Result<()> {
        file.write_all(bytes)
    }

    fn sync(&self, file: &File) -> io::Result<()> {
        file.sync_all()
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn sync_folder(&self, folder: &Path) -> io::Result<()> {
        sync_folder(folder)
    }
}

/// Makes the names in `folder` durable.
///
/// # Errors
///
/// Those of the file system.
pub fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Writes `content` to the file `path` atomically, by way of a temporary file `PATH.part`: after a
/// crash, `path` is the former file or the new one, never a part of it. After an error the
/// temporary file is removed: on a full disk, its room is needed.
///
/// # Errors
///
/// Those of the file system.
pub fn write_atomically(path: &Path, content: &[u8]) -> io::Result<()> {
    write_atomically_by(&DiskSteps, path, content)
}

/// As [`write_atomically`], by these steps.
///
/// # Errors
///
/// Those of the steps.
pub fn write_atomically_by<S: WriteSteps>(
    steps: &S,
    path: &Path,
    content: &[u8],
) -> io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = Path::new(&part);
    let mut file = steps.create(part)?;
    let written = steps
        .write(&mut file, content)
        .and_then(|()| steps.sync(&file))
        .and_then(|()| steps.rename(part, path));
    if let Err(error) = written {
        let _ = steps.remove(part);
        return Err(error);
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    steps.sync_folder(folder.unwrap_or(Path::new(".")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn a_file_is_replaced_and_a_link_at_the_temporary_path_is_not_followed() {
        let folder = TestFolder::new();
        let (path, part) = (folder.path("summary.json"), folder.path("summary.json.part"));
        let elsewhere = folder.write("elsewhere", "precious");
        folder.write("summary.json", "former");
        std::os::unix::fs::symlink(&elsewhere, &part).unwrap();
        write_atomically(&path, b"new").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        assert_eq!(fs::read_to_string(&elsewhere).unwrap(), "precious");
        assert!(!part.exists());
    }

    #[test]
    fn no_temporary_file_is_left_after_an_error() {
        let folder = TestFolder::new();
        let path = folder.path("report.html");
        fs::create_dir(&path).unwrap();
        write_atomically(&path, b"new").unwrap_err();
        assert!(path.is_dir() && !folder.path("report.html.part").exists());
    }
}
