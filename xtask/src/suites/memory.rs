//! Where tests make their folders: in memory, if the machine has plenty of it.
//!
//! What is tested syncs files to the disk for cars that lose power. A test cannot cut the power: it
//! kills processes, which is the same in memory, and would wait for the disk most of its time.

use std::fs::{self, DirBuilder, File};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::{env, io, process};

use rustix::fs::{FlockOperation, OFlags, StatVfsMountFlags, flock, statvfs};

const SHARED_MEMORY: &str = "/dev/shm";
/// How the name of such a folder begins.
const NAME: &str = "gleaner-tests-";
/// A test fills 4 GiB, and others run beside it.
const ROOM_BYTES: u64 = 8 << 30;
/// What is left for programs if that room is used.
const LEFT_BYTES: u64 = 4 << 30;

/// A folder in memory, removed with this.
pub(super) struct Folder {
    path: PathBuf,
    /// Locked as long as the folder is used. The system unlocks it if this process is killed.
    _locked: File,
}

impl Folder {
    /// A new folder; `None` where memory is scarce, or the user has named a folder for temporary
    /// files.
    pub(super) fn new() -> Option<Folder> {
        if env::var_os("TMPDIR").is_some() {
            return None;
        }
        remove_left();
        let found = statvfs(SHARED_MEMORY).ok()?;
        let is_roomy = found.f_bavail * found.f_frsize >= ROOM_BYTES
            && available()? >= ROOM_BYTES + LEFT_BYTES;
        // Tests start programs that they have built there.
        let runs_programs = !found.f_flag.contains(StatVfsMountFlags::NOEXEC);
        if !is_roomy || !runs_programs {
            return None;
        }
        let path = Path::new(SHARED_MEMORY).join(format!("{NAME}{}", process::id()));
        DirBuilder::new().mode(0o700).create(&path).ok()?;
        let locked = lock(&path).ok()?;
        // Before it was locked, another process may have taken it for one that was left.
        path.exists().then_some(Folder { path, _locked: locked })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.path);
    }
}

/// Removes folders of this user whose process was killed: nothing else would give their memory
/// back. A process is known by its lock, as its number may be that of another one in another
/// container.
fn remove_left() {
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

/// Bytes of memory that programs may still take.
fn available() -> Option<u64> {
    let text = fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.trim().strip_suffix(" kB")?.trim().parse().ok()?;
    Some(kib << 10)
}
