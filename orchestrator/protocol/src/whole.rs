use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

use crate::own_file;

/// Writes `content` to the file `path` by way of one beside it, so that whatever happens there is the former file or this one, whole.
///
/// # Errors
///
/// Those of the file system.
pub fn write_whole(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut part = path.as_os_str().to_owned();
    part.push(".part");
    let mut file = own_file::anew(Path::new(&part))?;
    file.write_all(content)?;
    file.sync_all()?;
    fs::rename(&part, path)?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scratch::Scratch;

    #[test]
    fn what_was_there_is_replaced_and_a_link_in_the_way_is_not_followed() {
        let folder = Scratch::new();
        let (path, part) = (folder.path("summary.json"), folder.path("summary.json.part"));
        let elsewhere = folder.write("elsewhere", "precious");
        folder.write("summary.json", "former");
        std::os::unix::fs::symlink(&elsewhere, &part).unwrap();
        write_whole(&path, b"new").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        assert_eq!(fs::read_to_string(&elsewhere).unwrap(), "precious");
        assert!(!part.exists());
    }
}
