//! Files and folders of ours, where others may write as well: whoever made a lambda may have put
//! links, pipes or devices into the folder of its results.
//!
//! What is opened here is what it seems to be. Nothing waits, and nothing is written to where a
//! link leads.

use std::fs::{self, File, Metadata, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;

use crate::{Exit, Failure};

/// Why something that has the name of a file or folder of ours is none. It is the cause in an
/// [`io::Error`].
#[derive(Copy, Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UnsafePath {
    /// A symbolic link.
    #[error("it is a link")]
    Link,
    /// A folder, a pipe, a socket or a device.
    #[error("it is no file")]
    NoFile,
    /// Something else than a folder.
    #[error("it is no folder")]
    NoFolder,
    /// A hard link: what is written appears elsewhere, too.
    #[error("the file has other names")]
    OtherNames,
}

impl UnsafePath {
    /// The way out.
    pub const HELP: &str = "remove it, or choose another folder: --out DIR";

    /// What stands in the way, if that is why something failed.
    pub fn of(error: &io::Error) -> Option<Self> {
        error.get_ref()?.downcast_ref().copied()
    }
}

/// Opens the file `path` to add to it; it is made if there is none.
///
/// # Errors
///
/// [`UnsafePath`] if it is no file of ours; those of the file system.
pub fn append(path: &Path) -> io::Result<File> {
    own(path, File::options().append(true).create(true))
}

/// Opens the file `path` to read and write it as it is; it is made if there is none.
///
/// # Errors
///
/// As for [`append`].
pub fn write(path: &Path) -> io::Result<File> {
    own(path, File::options().read(true).write(true).create(true).truncate(false))
}

/// Opens the file `path`, which is there, to read and write it.
///
/// # Errors
///
/// As for [`append`]; [`io::ErrorKind::NotFound`] if it is not there.
pub fn edit(path: &Path) -> io::Result<File> {
    own(path, File::options().read(true).write(true))
}

/// Begins a new file `path`. What had the name loses it, and nothing else: a link goes, and not
/// where it leads.
///
/// # Errors
///
/// [`UnsafePath`] if it is a folder; those of the file system.
pub fn create(path: &Path) -> io::Result<File> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            return Err(in_the_way(path, error));
        }
        _ => {}
    }
    own(path, File::options().write(true).create_new(true))
}

/// Opens the file `path` of results to read it.
///
/// # Errors
///
/// [`UnsafePath`] if it is a link or no file; those of the file system.
pub fn read(path: &Path) -> io::Result<File> {
    open(path, File::options().read(true), OFlags::NOFOLLOW).map(|(file, _)| file)
}

/// Opens the file `path`, which a user has named, to read it. It may be a link.
///
/// # Errors
///
/// [`UnsafePath`] if it is no file; those of the file system.
pub fn read_named(path: &Path) -> io::Result<File> {
    open(path, File::options().read(true), OFlags::empty()).map(|(file, _)| file)
}

/// Makes sure that `path` is a folder, and no link to one; it is made if there is none, with those
/// that it is in. These may be links.
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

/// Refuses `folder`, of results, if it lies in the folder `lambda` by way of a link: whoever made
/// the lambda may have put it there.
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

/// A file that nobody but us sees under another name.
fn own(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    let (file, found) = open(path, options, OFlags::NOFOLLOW)?;
    if found.nlink() > 1 {
        return Err(io::Error::other(UnsafePath::OtherNames));
    }
    Ok(file)
}

fn open(path: &Path, options: &mut OpenOptions, flags: OFlags) -> io::Result<(File, Metadata)> {
    // A pipe would be waited for, and a terminal would become ours.
    let flags = flags | OFlags::NONBLOCK | OFlags::NOCTTY;
    let opened = options.custom_flags(flags.bits().cast_signed()).open(path);
    let file = opened.map_err(|error| in_the_way(path, error))?;
    let found = file.metadata()?;
    if found.is_file() { Ok((file, found)) } else { Err(io::Error::other(UnsafePath::NoFile)) }
}

/// Why `path` could not be opened or removed, in words if that is due to what it is.
fn in_the_way(path: &Path, error: io::Error) -> io::Error {
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
    use crate::test_folder::TestFolder;

    /// What opens a file that is there, or makes it.
    const OPEN: [fn(&Path) -> io::Result<File>; 4] = [append, write, edit, read];

    fn pipe(folder: &TestFolder) -> PathBuf {
        let path = folder.path("pipe");
        mknodat(CWD, &path, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
        path
    }

    fn why<T>(opened: io::Result<T>) -> Option<UnsafePath> {
        UnsafePath::of(&opened.err().unwrap())
    }

    #[test]
    fn a_file_is_made_and_added_to_and_begun_anew() {
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
    fn a_link_is_not_followed_whether_it_leads_anywhere_or_not() {
        let folder = TestFolder::new();
        let precious = folder.write("precious", "precious");
        for target in [precious.clone(), folder.path("nothing")] {
            let link = folder.path("link");
            symlink(&target, &link).unwrap();
            for open in OPEN {
                assert_eq!(why(open(&link)), Some(UnsafePath::Link));
            }
            create(&link).unwrap().write_all(b"new").unwrap();
            fs::remove_file(&link).unwrap();
        }
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
        assert!(!folder.path("nothing").exists());
    }

    #[test]
    fn a_file_with_another_name_is_not_written_to() {
        let folder = TestFolder::new();
        let precious = folder.write("precious", "precious");
        let path = folder.path("log.jsonl");
        fs::hard_link(&precious, &path).unwrap();
        for open in [append, write, edit] {
            assert_eq!(why(open(&path)), Some(UnsafePath::OtherNames));
        }
        create(&path).unwrap().write_all(b"new").unwrap();
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
    }

    #[test]
    fn what_is_no_file_is_said_and_not_waited_for() {
        let folder = TestFolder::new();
        let (pipe, socket, inner) = (pipe(&folder), folder.path("socket"), folder.path("folder"));
        let _listener = UnixListener::bind(&socket).unwrap();
        fs::create_dir(&inner).unwrap();
        for path in [pipe.as_path(), &socket, &inner, Path::new("/dev/null")] {
            for open in OPEN {
                assert_eq!(why(open(path)), Some(UnsafePath::NoFile), "{}", path.display());
            }
            assert_eq!(why(read_named(path)), Some(UnsafePath::NoFile), "{}", path.display());
        }
        assert_eq!(why(create(&inner)), Some(UnsafePath::NoFile));
        create(&pipe).unwrap();
        assert!(pipe.is_file());
    }

    #[test]
    fn what_a_user_has_named_may_be_a_link() {
        let folder = TestFolder::new();
        let link = folder.path("link");
        symlink(folder.write("drive.journal", "x"), &link).unwrap();
        read_named(&link).unwrap();
    }

    #[test]
    fn results_are_no_way_out_of_the_lambdas_folder() {
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
    fn a_folder_is_made_with_those_above_it_and_is_no_link() {
        let folder_of_all = TestFolder::new();
        let clips = folder_of_all.path("out/clips");
        folder(&clips).unwrap();
        folder(&clips).unwrap();
        let link = folder_of_all.path("out/link");
        symlink(&clips, &link).unwrap();
        assert_eq!(why(folder(&link)), Some(UnsafePath::Link));
        assert_eq!(why(folder(&folder_of_all.write("file", ""))), Some(UnsafePath::NoFolder));
    }
}
