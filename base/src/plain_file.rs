//! Opens files that a user or another program provided: a lambda's folder and build, its
//! environment, results.
//!
//! Only regular files of a bounded length are opened. A pipe does not block, a device is not
//! opened, and a file that is too long, such as a sparse one, is refused before its first byte is
//! read. From a lambda's folder only files in it are opened, wherever links lead. The checks apply
//! to the opened file, so that replacing it meanwhile makes no difference.

use std::fs::{self, File, Metadata};
use std::io::{self, Read};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;

use crate::ByteSize;

/// The reason why a file is refused; the inner error of an [`io::Error`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotPlain {
    #[error("it is a link")]
    Link,
    #[error("it is not a regular file")]
    NoFile,
    #[error("it is a link to `{}`, outside of `{}`", target.display(), folder.display())]
    Outside {
        target: PathBuf,
        /// The folder, with links resolved.
        folder: PathBuf,
    },
    #[error("it has {bytes} bytes; at most {most} are read")]
    TooLong {
        /// Its length, or the number of bytes read so far.
        bytes: u64,
        most: ByteSize,
    },
}

impl NotPlain {
    /// Returns the reason if `error` has one.
    pub fn of(error: &io::Error) -> Option<&Self> {
        error.get_ref()?.downcast_ref()
    }

    pub fn help(&self) -> String {
        match self {
            Self::Link | Self::NoFile => "put a file in its place, or remove it",
            Self::Outside { .. } => "put the file itself in its place, or remove the link",
            Self::TooLong { .. } => "make it shorter, or remove it",
        }
        .to_owned()
    }
}

/// A regular file that is open for reading up to a maximum length.
#[derive(Debug)]
pub struct PlainFile {
    file: File,
    found: Metadata,
    most: ByteSize,
    left: u64,
}

impl PlainFile {
    /// Opens the file `path`, which a user or a Gleaner program has named. It may be a link.
    ///
    /// # Errors
    ///
    /// [`NotPlain`] if it is not a regular file or is longer than `most`; those of the file system.
    pub fn named(path: &Path, most: ByteSize) -> io::Result<Self> {
        Self::opened(PathHandle::of(path, OFlags::empty())?, most)
    }

    /// Opens the result file `path`.
    ///
    /// # Errors
    ///
    /// As for [`named`](Self::named), and [`NotPlain::Link`].
    pub fn result(path: &Path, most: ByteSize) -> io::Result<Self> {
        Self::opened(PathHandle::of(path, OFlags::NOFOLLOW)?, most)
    }

    /// Opens the file `path` of the folder `folder`. Links may lead to files in that folder only.
    ///
    /// # Errors
    ///
    /// As for [`named`](Self::named), and [`NotPlain::Outside`].
    pub fn inside(folder: &Path, path: &Path, most: ByteSize) -> io::Result<Self> {
        let handle = PathHandle::of(&folder.join(path), OFlags::empty())?;
        handle.must_lie_in(folder)?;
        Self::opened(handle, most)
    }

    fn opened(handle: PathHandle, most: ByteSize) -> io::Result<Self> {
        let found = handle.0.metadata()?;
        if !found.is_file() {
            return Err(io::Error::other(if found.is_symlink() {
                NotPlain::Link
            } else {
                NotPlain::NoFile
            }));
        }
        if found.len() > most.bytes() {
            return Err(io::Error::other(NotPlain::TooLong { bytes: found.len(), most }));
        }
        let file = handle.open()?;
        Ok(Self { file, found, most, left: most.bytes() })
    }

    /// Returns the open file, to pass it to another program, which checks its length again.
    pub fn into_file(self) -> File {
        self.file
    }

    /// Returns the length in bytes at the time of opening.
    pub fn length(&self) -> u64 {
        self.found.len()
    }

    /// Returns the permission bits: read, write and execute of user, group and others.
    pub fn mode(&self) -> u32 {
        self.found.permissions().mode() & 0o777
    }

    /// Returns the id of the user to whom it belongs.
    pub fn owner(&self) -> u32 {
        self.found.uid()
    }

    /// Reads the whole file.
    ///
    /// # Errors
    ///
    /// [`NotPlain::TooLong`] if it grew meanwhile; those of the file system.
    pub fn read_whole(mut self) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    /// Copies the whole file to `to`, in the kernel where possible.
    ///
    /// # Errors
    ///
    /// As for [`read_whole`](Self::read_whole).
    pub fn copy_to(mut self, to: &mut File) -> io::Result<()> {
        let copied = io::copy(&mut self.within_bound(), to)?;
        self.count(copied)
    }

    /// Limits reading to one byte more than allowed, which is enough to notice an overlong file.
    fn within_bound(&mut self) -> io::Take<&mut File> {
        let most = self.left.saturating_add(1);
        (&mut self.file).take(most)
    }

    fn count(&mut self, read: u64) -> io::Result<()> {
        let bytes = self.most.bytes() - self.left + read;
        self.left = self
            .left
            .checked_sub(read)
            .ok_or_else(|| io::Error::other(NotPlain::TooLong { bytes, most: self.most }))?;
        Ok(())
    }
}

impl Read for PlainFile {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let read = self.within_bound().read(into)?;
        self.count(read as u64)?;
        Ok(read)
    }
}

/// A path handle (`O_PATH`): the file is found but not opened, which does not affect a pipe or
/// device.
struct PathHandle(File);

impl PathHandle {
    fn of(path: &Path, flags: OFlags) -> io::Result<Self> {
        let flags = (flags | OFlags::PATH).bits().cast_signed();
        File::options().read(true).custom_flags(flags).open(path).map(Self)
    }

    /// Returns its path below `/proc/self/fd`.
    fn name(&self) -> PathBuf {
        format!("/proc/self/fd/{}", self.0.as_raw_fd()).into()
    }

    fn must_lie_in(&self, folder: &Path) -> io::Result<()> {
        let (target, folder) = (fs::read_link(self.name())?, folder.canonicalize()?);
        if target.starts_with(&folder) {
            return Ok(());
        }
        Err(io::Error::other(NotPlain::Outside { target, folder }))
    }

    fn open(&self) -> io::Result<File> {
        let flags = OFlags::NONBLOCK | OFlags::NOCTTY;
        File::options().read(true).custom_flags(flags.bits().cast_signed()).open(self.name())
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use rustix::fs::{CWD, FileType, Mode, mknodat};

    use super::*;
    use gleaner_test_support::TestFolder;

    const MOST: ByteSize = ByteSize::new(10);

    #[track_caller]
    fn refusal(opened: io::Result<PlainFile>) -> NotPlain {
        NotPlain::of(&opened.unwrap_err()).unwrap().clone()
    }

    fn text(opened: io::Result<PlainFile>) -> String {
        String::from_utf8(opened.unwrap().read_whole().unwrap()).unwrap()
    }

    #[test]
    fn a_link_may_lead_to_a_file_in_the_folder_and_to_no_other() {
        let scratch = TestFolder::new();
        let (folder, secret) = (scratch.path("lambda"), scratch.write("secret", "secret"));
        scratch.write("lambda/part/a.py", "a");
        let links = [
            ("short.py", "part/a.py".into()),
            ("long.py", folder.join("part/a.py")),
            ("same", ".".into()),
        ];
        for (link, target) in links {
            symlink(target, folder.join(link)).unwrap();
        }
        for path in ["part/a.py", "short.py", "long.py", "same/short.py", "../lambda/part/a.py"] {
            assert_eq!(text(PlainFile::inside(&folder, Path::new(path), MOST)), "a", "{path}");
        }
        symlink("../secret", folder.join("out.py")).unwrap();
        symlink("out.py", folder.join("twice.py")).unwrap();
        symlink("..", folder.join("up")).unwrap();
        for path in ["out.py", "twice.py", "up/secret", "../secret"] {
            let outside = NotPlain::Outside { target: secret.clone(), folder: folder.clone() };
            assert_eq!(
                refusal(PlainFile::inside(&folder, Path::new(path), MOST)),
                outside,
                "{path}"
            );
        }
        // A folder whose name merely begins with the same letters is outside.
        scratch.write("lambda.more/x", "x");
        assert!(PlainFile::inside(&folder, Path::new("../lambda.more/x"), MOST).is_err());
    }

    #[test]
    fn the_folder_itself_may_be_a_link() {
        let scratch = TestFolder::new();
        scratch.write("lambda/a.py", "a");
        symlink("lambda", scratch.path("link")).unwrap();
        assert_eq!(text(PlainFile::inside(&scratch.path("link"), Path::new("a.py"), MOST)), "a");
    }

    #[test]
    fn pipes_sockets_folders_and_devices_are_refused_without_blocking() {
        let scratch = TestFolder::new();
        let (pipe, socket, folder) =
            (scratch.path("pipe"), scratch.path("socket"), scratch.path("folder"));
        mknodat(CWD, &pipe, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
        let _listener = UnixListener::bind(&socket).unwrap();
        fs::create_dir(&folder).unwrap();
        for path in [&pipe, &socket, &folder, Path::new("/dev/zero")] {
            assert_eq!(
                refusal(PlainFile::named(path, MOST)),
                NotPlain::NoFile,
                "{}",
                path.display()
            );
            assert_eq!(
                refusal(PlainFile::result(path, MOST)),
                NotPlain::NoFile,
                "{}",
                path.display()
            );
        }
        assert_eq!(
            refusal(PlainFile::inside(scratch.root(), Path::new("pipe"), MOST)),
            NotPlain::NoFile
        );
        symlink("/dev/zero", scratch.path("device")).unwrap();
        assert_eq!(refusal(PlainFile::named(&scratch.path("device"), MOST)), NotPlain::NoFile);
        let outside = refusal(PlainFile::inside(scratch.root(), Path::new("device"), MOST));
        assert!(
            matches!(outside, NotPlain::Outside { target, .. } if target == Path::new("/dev/zero"))
        );
    }

    #[test]
    fn a_result_may_not_be_a_link_but_a_named_file_may() {
        let scratch = TestFolder::new();
        let link = scratch.path("link");
        symlink(scratch.write("log.jsonl", "x"), &link).unwrap();
        assert_eq!(refusal(PlainFile::result(&link, MOST)), NotPlain::Link);
        assert_eq!(text(PlainFile::named(&link, MOST)), "x");
    }

    #[test]
    fn an_overlong_file_is_refused_before_it_is_read() {
        let scratch = TestFolder::new();
        let sparse = scratch.write("sparse", "");
        File::options().write(true).open(&sparse).unwrap().set_len(1 << 40).unwrap();
        let error = PlainFile::named(&sparse, ByteSize::mib(16)).unwrap_err();
        assert_eq!(error.to_string(), "it has 1099511627776 bytes; at most 16 MiB are read");
        assert!(NotPlain::of(&error).is_some());
    }

    #[test]
    fn a_growing_file_is_read_up_to_the_maximum() {
        let scratch = TestFolder::new();
        let path = scratch.write("file", "0123456789");
        let open = || PlainFile::named(&path, MOST).unwrap();
        let (whole, mut copied, mut pieces) = (open(), open(), open());
        assert_eq!(copied.length(), 10);
        assert_eq!(text(Ok(open())), "0123456789");
        fs::write(&path, "0123456789a").unwrap();
        let too_long = NotPlain::TooLong { bytes: 11, most: MOST };
        let refused = |error: io::Error| NotPlain::of(&error).unwrap().clone();
        assert_eq!(refused(whole.read_whole().unwrap_err()), too_long);
        assert_eq!(copied.read(&mut [0; 5]).unwrap(), 5);
        let mut to = File::create(scratch.path("copy")).unwrap();
        assert_eq!(refused(copied.copy_to(&mut to).unwrap_err()), too_long);
        let read = std::iter::from_fn(|| pieces.read(&mut [0]).ok()).count();
        assert_eq!(read, 10);
    }
}
