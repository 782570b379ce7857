//! Opens result files and folders safely: regular files only, no symbolic links, pipes, devices or
//! hard links.
//!
//! The author of a lambda may have put such things into the folder of its results. Nothing here
//! blocks or writes to the target of a link.

use std::fs::{self, File, Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;

use crate::{Exit, Failure};

/// The reason why a path is not used as a result file or folder; the inner error of an
/// [`io::Error`].
#[derive(Copy, Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UnsafePath {
    #[error("it is a link")]
    Link,
    #[error("it is not a regular file")]
    NoFile,
    #[error("it is not a folder")]
    NoFolder,
    /// A file with several hard links: writing to it would change the others, too.
    #[error("the file has other hard links")]
    HardLink,
}

impl UnsafePath {
    pub const HELP: &str = "remove it, or choose another folder: --out DIR";

    /// Returns the reason if `error` has one.
    pub fn of(error: &io::Error) -> Option<Self> {
        error.get_ref()?.downcast_ref().copied()
    }
}

/// Opens the file `path` for appending; creates it if it does not exist.
///
/// # Errors
///
/// [`UnsafePath`] if it is not a regular file with one name; those of the file system.
pub fn append(path: &Path) -> io::Result<File> {
    open_single(path, File::options().append(true).create(true))
}

/// Opens the file `path` for reading and writing, without truncation; creates it if it does not
/// exist.
///
/// # Errors
///
/// As for [`append`].
pub fn write(path: &Path) -> io::Result<File> {
    open_single(path, File::options().read(true).write(true).create(true).truncate(false))
}

/// Opens the existing file `path` for reading and writing.
///
/// # Errors
///
/// As for [`append`]; [`io::ErrorKind::NotFound`] if it does not exist.
pub fn edit(path: &Path) -> io::Result<File> {
    open_single(path, File::options().read(true).write(true))
}

/// Creates a new file `path` in place of any that exists: of a link the link is removed, not its
/// target.
///
/// # Errors
///
/// [`UnsafePath`] if it is a folder; those of the file system.
pub fn create(path: &Path) -> io::Result<File> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            return Err(explained(path, error));
        }
        _ => {}
    }
    open_single(path, File::options().write(true).create_new(true))
}

/// Opens the result file `path` for reading.
///
/// # Errors
///
/// [`UnsafePath`] if it is not a regular file; those of the file system.
pub fn read(path: &Path) -> io::Result<File> {
    open(path, File::options().read(true), OFlags::NOFOLLOW).map(|(file, _)| file)
}

/// Opens the file `path`, which a user has named, for reading. It may be a link.
///
/// # Errors
///
/// [`UnsafePath`] if it does not lead to a regular file; those of the file system.
pub fn read_named(path: &Path) -> io::Result<File> {
    open(path, File::options().read(true), OFlags::empty()).map(|(file, _)| file)
}

/// Creates the folder `path` if it does not exist, with its parents. Parents may be links; `path`
/// may not.
///
/// # Errors
///
/// [`UnsafePath`] if it is something else; those of the file system.
pub fn folder(path: &Path) -> io::Result<()> {
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent)?;
    }
    match fs::create_dir(path) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => return Err(error),
        _ => {}
    }
    let found = fs::symlink_metadata(path)?.file_type();
    match (found.is_dir(), found.is_symlink()) {
        (true, _) => Ok(()),
        (_, true) => Err(io::Error::other(UnsafePath::Link)),
        _ => Err(io::Error::other(UnsafePath::NoFolder)),
    }
}

/// Refuses the result folder `folder` if its path leads through a link inside the folder `lambda`:
/// the author of the lambda may have put it there.
///
/// # Errors
///
/// A failure that names the link.
pub fn refuse_linked(folder: &Path, lambda: &Path) -> Result<(), Failure> {
    let within =
        folder.ancestors().take_while(|path| folder.starts_with(lambda) && *path != lambda);
    let Some(link) = within.filter(|path| path.is_symlink()).last() else { return Ok(()) };
    let message = format!("`{}` is a link in the lambda's own folder", link.display());
    Err(Failure::new(Exit::Usage, message).with_help("remove it, or name the folder: --out DIR"))
}

/// Opens a file that has no other hard links.
fn open_single(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    let (file, found) = open(path, options, OFlags::NOFOLLOW)?;
    if found.nlink() > 1 {
        return Err(io::Error::other(UnsafePath::HardLink));
    }
    Ok(file)
}

fn open(path: &Path, options: &mut OpenOptions, flags: OFlags) -> io::Result<(File, Metadata)> {
    // Opening a pipe would block, and a terminal would become the controlling one.
    let flags = flags | OFlags::NONBLOCK | OFlags::NOCTTY;
    let opened = options.custom_flags(flags.bits().cast_signed()).open(path);
    let file = opened.map_err(|error| explained(path, error))?;
    let found = file.metadata()?;
    if found.is_file() { Ok((file, found)) } else { Err(io::Error::other(UnsafePath::NoFile)) }
}

/// Replaces `error` by an [`UnsafePath`] if `path` is the cause.
fn explained(path: &Path, error: io::Error) -> io::Error {
    match fs::symlink_metadata(path).map(|found| found.file_type()) {
        Ok(found) if found.is_symlink() => io::Error::other(UnsafePath::Link),
        Ok(found) if !found.is_file() => io::Error::other(UnsafePath::NoFile),
        _ => error,
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;
    use std::path::PathBuf;

    use rustix::fs::{CWD, FileType, Mode, mknodat};

    use super::*;
    use gleaner_test_support::TestFolder;

    /// All functions that open an existing file.
    const OPEN: [fn(&Path) -> io::Result<File>; 4] = [append, write, edit, read];

    fn pipe(folder: &TestFolder) -> PathBuf {
        let path = folder.path("pipe");
        mknodat(CWD, &path, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
        path
    }

    fn refusal<T>(opened: io::Result<T>) -> Option<UnsafePath> {
        UnsafePath::of(&opened.err().unwrap())
    }

    #[test]
    fn a_file_is_created_appended_to_and_replaced() {
        let folder = TestFolder::new();
        let path = folder.path("log.jsonl");
        assert_eq!(edit(&path).unwrap_err().kind(), io::ErrorKind::NotFound);
        assert_eq!(read(&path).unwrap_err().kind(), io::ErrorKind::NotFound);
        append(&path).unwrap().write_all(b"one ").unwrap();
        append(&path).unwrap().write_all(b"two").unwrap();
        write(&path).unwrap().write_all(b"ONE").unwrap();
        let mut text = String::new();
        read(&path).unwrap().read_to_string(&mut text).unwrap();
        assert_eq!(text, "ONE two");
        create(&path).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "");
    }

    #[test]
    fn a_link_is_not_followed_whether_its_target_exists_or_not() {
        let folder = TestFolder::new();
        let precious = folder.write("precious", "precious");
        for target in [precious.clone(), folder.path("nothing")] {
            let link = folder.path("link");
            symlink(&target, &link).unwrap();
            for open in OPEN {
                assert_eq!(refusal(open(&link)), Some(UnsafePath::Link));
            }
            create(&link).unwrap().write_all(b"new").unwrap();
            fs::remove_file(&link).unwrap();
        }
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
        assert!(!folder.path("nothing").exists());
    }

    #[test]
    fn a_file_with_another_hard_link_is_not_written_to() {
        let folder = TestFolder::new();
        let precious = folder.write("precious", "precious");
        let path = folder.path("log.jsonl");
        fs::hard_link(&precious, &path).unwrap();
        for open in [append, write, edit] {
            assert_eq!(refusal(open(&path)), Some(UnsafePath::HardLink));
        }
        create(&path).unwrap().write_all(b"new").unwrap();
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
    }

    #[test]
    fn pipes_sockets_folders_and_devices_are_refused_without_blocking() {
        let folder = TestFolder::new();
        let (pipe, socket, inner) = (pipe(&folder), folder.path("socket"), folder.path("folder"));
        let _listener = UnixListener::bind(&socket).unwrap();
        fs::create_dir(&inner).unwrap();
        for path in [pipe.as_path(), &socket, &inner, Path::new("/dev/null")] {
            for open in OPEN {
                assert_eq!(refusal(open(path)), Some(UnsafePath::NoFile), "{}", path.display());
            }
            assert_eq!(refusal(read_named(path)), Some(UnsafePath::NoFile), "{}", path.display());
        }
        assert_eq!(refusal(create(&inner)), Some(UnsafePath::NoFile));
        create(&pipe).unwrap();
        assert!(pipe.is_file());
    }

    #[test]
    fn a_named_file_may_be_a_link() {
        let folder = TestFolder::new();
        let link = folder.path("link");
        symlink(folder.write("drive.journal", "x"), &link).unwrap();
        read_named(&link).unwrap();
    }

    #[test]
    fn a_result_folder_may_not_lead_through_a_link_in_the_lambdas_folder() {
        let (lambda, elsewhere) = (TestFolder::new(), TestFolder::new());
        let live = lambda.path("live");
        refuse_linked(&live, lambda.root()).unwrap();
        refuse_linked(elsewhere.root(), lambda.root()).unwrap();
        symlink(elsewhere.root(), &live).unwrap();
        for out in [live.clone(), live.join("more")] {
            let failure = refuse_linked(&out, lambda.root()).unwrap_err().to_string();
            assert!(failure.contains("live` is a link in the lambda's own folder"), "{failure}");
            assert!(failure.contains("--out DIR"), "{failure}");
        }
    }

    #[test]
    fn a_folder_is_created_with_its_parents_and_may_not_be_a_link() {
        let folder_of_all = TestFolder::new();
        let clips = folder_of_all.path("out/clips");
        folder(&clips).unwrap();
        folder(&clips).unwrap();
        let link = folder_of_all.path("out/link");
        symlink(&clips, &link).unwrap();
        assert_eq!(refusal(folder(&link)), Some(UnsafePath::Link));
        assert_eq!(refusal(folder(&folder_of_all.write("file", ""))), Some(UnsafePath::NoFolder));
    }
}
