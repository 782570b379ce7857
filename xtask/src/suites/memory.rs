//! Puts the temporary folders of tests into memory, if the machine has enough.
//!
//! The programs sync files to the disk because vehicles lose power. Tests only kill processes, for
//! which memory is equivalent, and would spend most of their time waiting for a disk.

use std::fs::{self, DirBuilder, File};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::{env, io, process};

use rustix::fs::{FlockOperation, OFlags, StatVfsMountFlags, flock, statvfs};

const SHARED_MEMORY: &str = "/dev/shm";
const NAME: &str = "gleaner-tests-";
/// Required free space: one test fills 4 GiB, and others run beside it.
const SPACE_BYTES: u64 = 8 << 30;
/// Memory that must remain for programs if that space is used.
const PROGRAM_BYTES: u64 = 4 << 30;

pub(super) struct MemoryFolder {
    path: PathBuf,
    /// Lock on the folder. The system releases it if this process is killed.
    _locked: File,
}

impl MemoryFolder {
    /// Creates a folder; `None` if memory is scarce, or if the user has set `TMPDIR`.
    pub(super) fn new() -> Option<MemoryFolder> {
        if env::var_os("TMPDIR").is_some() {
            return None;
        }
        remove_abandoned();
        let found = statvfs(SHARED_MEMORY).ok()?;
        let is_large_enough = found.f_bavail * found.f_frsize >= SPACE_BYTES
            && available()? >= SPACE_BYTES + PROGRAM_BYTES;
        // Tests build and start programs there.
        let runs_programs = !found.f_flag.contains(StatVfsMountFlags::NOEXEC);
        if !is_large_enough || !runs_programs {
            return None;
        }
        let path = Path::new(SHARED_MEMORY).join(format!("{NAME}{}", process::id()));
        DirBuilder::new().mode(0o700).create(&path).ok()?;
        let locked = lock(&path).ok()?;
        // Before it was locked, another process may have removed it as abandoned.
        path.exists().then_some(MemoryFolder { path, _locked: locked })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for MemoryFolder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.path);
    }
}

/// Removes folders of killed processes of this user, to free their memory. A running process is
/// recognised by its lock, since its pid may be in use in another container.
fn remove_abandoned() {
    for entry in fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten() {
        let is_ours = entry.file_name().to_str().is_some_and(|name| name.starts_with(NAME));
        if is_ours && lock(&entry.path()).is_ok() {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

fn lock(folder: &Path) -> io::Result<File> {
    let flags = (OFlags::DIRECTORY | OFlags::NOFOLLOW).bits().cast_signed();
    let folder = File::options().read(true).custom_flags(flags).open(folder)?;
    flock(&folder, FlockOperation::NonBlockingLockExclusive)?;
    Ok(folder)
}

/// Available memory, in bytes.
fn available() -> Option<u64> {
    let text = fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.trim().strip_suffix(" kB")?.trim().parse().ok()?;
    Some(kib << 10)
}
