use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use crate::safe_file;

/// Writes `content` to the file `path` atomically, by way of a temporary file `PATH.part`: after a
/// crash, `path` is the former file or the new one, never a part of it. After an error the
/// temporary file is removed: on a full disk, its room is needed.
///
/// # Errors
///
/// Those of the file system.
pub fn write_atomically(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let part = Path::new(&part);
    let mut file = safe_file::create(part)?;
    let written = file
        .write_all(content)
        .and_then(|()| file.sync_all())
        .and_then(|()| fs::rename(part, path));
    if let Err(error) = written {
        let _ = fs::remove_file(part);
        return Err(error);
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_folder::TestFolder;

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
