//! The data folder: private, and of one process at a time.

use std::ffi::OsStr;
use std::fs::{self, DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, FileExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, sync_folder};
use rustix::fs::{FlockOperation, flock};

use crate::store::StoreAddress;

/// Extension of a file that is being received.
pub(crate) const PART: &str = "part";

/// Longest name of a process in the file of the lock.
const FORMER_MAX: u64 = 64;

/// The lock of the folder, until it is dropped.
#[derive(Debug)]
pub(crate) struct FolderLock {
    file: File,
    /// Name of the process that had the lock before, among those that serve its database; it has
    /// ended.
    pub(crate) former: String,
}

impl FolderLock {
    /// Notes the name of this process for the next one.
    pub(crate) fn note(&self, name: &str) -> io::Result<()> {
        self.file.set_len(0)?;
        self.file.write_all_at(name.as_bytes(), 0)?;
        self.file.sync_all()
    }
}

#[derive(Debug, Clone)]
pub(crate) struct DataFolder(PathBuf);

impl DataFolder {
    /// Creates the folder, as far as it does not exist, and makes it private.
    /// Fails if it cannot, or if another program has files there.
    pub(crate) fn create(path: &Path) -> Result<Self, Failure> {
        let folder = Self(path.to_owned());
        // A restored folder has no lock, and with PostgreSQL no database.
        let is_ours =
            |name: &OsStr| ["objects", "clips", "records", "ca"].iter().any(|ours| name == *ours);
        let is_of_others = !folder.is_known()
            && fs::read_dir(path)
                .is_ok_and(|entries| entries.flatten().any(|it| !is_ours(&it.file_name())));
        if is_of_others {
            let message = format!("`{}` is not empty, and not a cloud data folder", path.display());
            return Err(Failure::new(Exit::Usage, message)
                .with_help("choose an empty folder, or one that does not exist, with --data"));
        }
        for path in
            [path, &folder.objects(), &folder.clips(), &folder.records(), &folder.authorities()]
        {
            DirBuilder::new()
                .recursive(true)
                .mode(0o700)
                .create(path)
                .and_then(|()| fs::set_permissions(path, Permissions::from_mode(0o700)))
                .map_err(|error| {
                    let action = format!("cannot create the folder `{}`", path.display());
                    Failure::caused_by(Exit::Usage, action, &error)
                        .with_help("choose a folder of this user with --data")
                })?;
        }
        Ok(folder)
    }

    /// Opens a folder that a server has created.
    /// Fails if it is of another program.
    pub(crate) fn existing(path: &Path) -> Result<Self, Failure> {
        let folder = Self(path.to_owned());
        if folder.is_known() {
            return Ok(folder);
        }
        let message = format!("`{}` is not a cloud data folder", path.display());
        Err(Failure::new(Exit::Usage, message)
            .with_help("name the folder of `gleaner-cloud serve` with --data"))
    }

    /// Locks the folder for this process.
    /// Fails if another server has it.
    pub(crate) fn lock(&self) -> Result<FolderLock, Failure> {
        let path = self.0.join("lock");
        let mut options = OpenOptions::new();
        let file =
            options.read(true).write(true).create(true).truncate(false).mode(0o600).open(&path);
        let failed = |error: io::Error| {
            let action = format!("cannot open `{}`", path.display());
            Failure::caused_by(Exit::Internal, action, &error)
        };
        let file = file.map_err(failed)?;
        if flock(&file, FlockOperation::NonBlockingLockExclusive).is_err() {
            let message = format!("another gleaner-cloud uses `{}`", self.0.display());
            return Err(Failure::new(Exit::Usage, message)
                .with_help("stop that one first, or choose another folder with --data"));
        }
        let mut text = Vec::new();
        (&file).take(FORMER_MAX).read_to_end(&mut text).map_err(failed)?;
        let former = String::from_utf8_lossy(&text).trim().to_owned();
        Ok(FolderLock { file, former })
    }

    pub(crate) fn has_authorities(&self) -> bool {
        self.authorities().join("server.pem").exists()
    }

    fn is_known(&self) -> bool {
        ["cloud.db", "lock", "postgres"].iter().any(|name| self.0.join(name).exists())
    }

    /// Returns the address of the database: `url`, or a file in the folder.
    /// Fails if `url` is not an address, or the folder belongs to the other kind: its objects and
    /// certificates are of no use with another database.
    pub(crate) fn store(&self, url: Option<&str>) -> Result<StoreAddress, Failure> {
        let (file, mark) = (self.0.join("cloud.db"), self.mark());
        let refused = |reason: &str, help: &str| {
            let message = format!("the database of `{}` {reason}", self.0.display());
            Failure::new(Exit::Usage, message).with_help(help)
        };
        match url {
            None if mark.exists() => {
                Err(refused("is on a PostgreSQL server", "add --store, as the folder was served"))
            }
            None => Ok(StoreAddress::file(&file)),
            Some(_) if file.exists() => {
                Err(refused("is a file in it", "leave --store out, or choose a new folder"))
            }
            Some(url) => StoreAddress::server(url),
        }
    }

    /// Notes the kind of the database, once that was opened: the folder keeps it.
    /// A failure names the file that cannot be written.
    pub(crate) fn keep(&self, store: &StoreAddress) -> Result<(), Failure> {
        let mark = self.mark();
        if matches!(store, StoreAddress::Sqlite(_)) || mark.exists() {
            return Ok(());
        }
        write_private(&mark, b"").map_err(|error| {
            let action = format!("cannot write `{}`", mark.display());
            Failure::caused_by(Exit::Internal, action, &error)
        })
    }

    /// Returns the path of the file that exists if the database is on a server.
    fn mark(&self) -> PathBuf {
        self.0.join("postgres")
    }

    pub(crate) fn objects(&self) -> PathBuf {
        self.0.join("objects")
    }

    pub(crate) fn clips(&self) -> PathBuf {
        self.0.join("clips")
    }

    pub(crate) fn records(&self) -> PathBuf {
        self.0.join("records")
    }

    pub(crate) fn authorities(&self) -> PathBuf {
        self.0.join("ca")
    }
}

/// Removes files in a folder that an earlier process had not received in full.
/// A failure names the folder.
pub(crate) fn remove_parts(folder: &Path) -> Result<(), Failure> {
    let removed = fs::read_dir(folder).and_then(|entries| {
        for entry in entries {
            let path = entry?.path();
            if path.extension().is_some_and(|it| it == PART) {
                fs::remove_file(path)?;
            }
        }
        Ok(())
    });
    removed.map_err(|error| {
        let action = format!("cannot open the folder `{}`", folder.display());
        Failure::caused_by(Exit::Internal, action, &error)
    })
}

/// Writes a file that only this user can read; durable, and whole or not at all.
pub(crate) fn write_private(path: &Path, content: &[u8]) -> io::Result<()> {
    let part = path.with_extension("part");
    let mut options = OpenOptions::new();
    let mut file = options.write(true).create(true).truncate(true).mode(0o600).open(&part)?;
    file.write_all(content)?;
    file.sync_all()?;
    fs::rename(&part, path)?;
    path.parent().map_or(Ok(()), sync_folder)
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

    use super::*;

    #[test]
    fn a_folder_keeps_the_kind_of_the_first_database_that_was_opened() {
        let data = TempDir::new().unwrap();
        let folder = DataFolder::create(data.path()).unwrap();
        for url in ["mysql://x", "", "postgres", "/tmp/x", "sqlite://x", " postgres://x"] {
            let refused = folder.store(Some(url)).unwrap_err().to_string();
            assert!(refused.contains("not the address of a PostgreSQL server"), "{refused}");
        }
        // A typing error, with which no database was opened.
        let server = folder.store(Some("postgres://typo/x")).unwrap();
        let file = folder.store(None).unwrap();
        assert!(matches!(file, StoreAddress::Sqlite(_)));
        folder.keep(&file).unwrap();
        assert!(folder.store(Some("postgres://x/y")).is_ok());
        folder.keep(&server).unwrap();
        let refused = folder.store(None).unwrap_err().to_string();
        assert!(refused.contains("is on a PostgreSQL server"), "{refused}");
    }
}
