//! A cache entry: native code behind a digest that binds it to everything it was made from.
//!
//! Code that was changed, truncated or copied from another entry is never run. An attacker who can
//! write into the cache can also write the digest, so owners and modes are checked first.

use std::fs::{self, File, Metadata};
use std::io::{self, Read};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};

use gleaner_base::hex;
use gleaner_base::safe_file::{self, UnsafePath};
use sha2::{Digest, Sha256};

use super::prune::note_use;
use super::{CODE_BYTES, CompileError, Nans};

/// First bytes of an entry. They are part of its key, so that entries of another layout have other
/// names.
const MAGIC: [u8; 16] = *b"gleaner native 2";
const DIGEST_BYTES: usize = 32;
const HEAD_BYTES: usize = MAGIC.len() + DIGEST_BYTES;

/// The location of a component's native code in the cache.
pub struct CacheEntry {
    path: PathBuf,
    key: [u8; DIGEST_BYTES],
}

/// Content of a [`CacheEntry`].
#[derive(Debug, PartialEq, Eq)]
pub enum CacheLookup {
    /// The code as it was compiled.
    Code(Vec<u8>),
    /// No file.
    Nothing,
    /// Damaged code, with the reason. It has to be replaced.
    Damaged(String),
}

impl CacheEntry {
    /// Returns the entry of `component`, compiled with `nans`, in the folder `cache`:
    /// `<cache>/<key>.cwasm`.
    pub fn of(cache: &Path, component: &[u8], nans: Nans) -> Self {
        let mut key = Sha256::new();
        let (arch, cpu) = (std::env::consts::ARCH.as_bytes(), cpu_features());
        for part in [&MAGIC, nans.settings().as_bytes(), arch, cpu.as_bytes(), component] {
            key.update((part.len() as u64).to_le_bytes());
            key.update(part);
        }
        let key: [u8; DIGEST_BYTES] = key.finalize().into();
        Self { path: cache.join(hex(&key) + ".cwasm"), key }
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reads the code into memory and checks its digest there, so that later changes to the file do
    /// not affect the loaded code. Notes the use for pruning.
    ///
    /// # Errors
    ///
    /// [`CompileError::Untrusted`] if another user could have written it: file and folders above it
    /// must belong to this user or to root, and only they may write to them. Also if it is not a
    /// regular file. [`CompileError::ReadCode`] if it cannot be opened.
    pub fn read(&self) -> Result<CacheLookup, CompileError> {
        check_folder(self.path.parent().unwrap_or(&self.path))?;
        let untrusted = |why: String| CompileError::Untrusted { path: self.path.clone(), why };
        let cannot = |error: io::Error| match UnsafePath::of(&error) {
            Some(other) => untrusted(other.to_string()),
            None => CompileError::ReadCode { path: self.path.clone(), source: error },
        };
        let file = match safe_file::read(&self.path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return Ok(CacheLookup::Nothing);
            }
            opened => opened.map_err(cannot)?,
        };
        let meta = file.metadata().map_err(cannot)?;
        if let Some(why) = foreign(&meta) {
            return Err(untrusted(why.to_owned()));
        }
        // A read error counts as damage.
        let found = self
            .compared(&file, meta.len())
            .unwrap_or_else(|error| CacheLookup::Damaged(error.to_string()));
        if matches!(found, CacheLookup::Code(_)) {
            note_use(&file);
        }
        Ok(found)
    }

    fn compared(&self, mut file: &File, len: u64) -> io::Result<CacheLookup> {
        let damaged = |why: &str| Ok(CacheLookup::Damaged(why.to_owned()));
        let Some(code_len) = usize::try_from(len).ok().and_then(|len| len.checked_sub(HEAD_BYTES))
        else {
            return damaged("it is too short");
        };
        if code_len > CODE_BYTES {
            return damaged("it is too long");
        }
        let mut head = [0; HEAD_BYTES];
        file.read_exact(&mut head)?;
        let mut code = Vec::with_capacity(code_len);
        file.take(CODE_BYTES as u64).read_to_end(&mut code)?;
        if head == self.head(&code) {
            Ok(CacheLookup::Code(code))
        } else {
            damaged("its digest does not match its content")
        }
    }

    /// Returns the header before `code` in the file.
    pub(super) fn head(&self, code: &[u8]) -> [u8; HEAD_BYTES] {
        let digest = Sha256::new().chain_update(self.key).chain_update(code).finalize();
        let mut head = [0; HEAD_BYTES];
        head[..MAGIC.len()].copy_from_slice(&MAGIC);
        head[MAGIC.len()..].copy_from_slice(&digest);
        head
    }
}

/// Returns the CPU features of this machine, as the kernel names them, since a cache in a home
/// folder may be shared by several machines. Wasmtime checks them again when it loads code.
fn cpu_features() -> String {
    let cpus = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let features =
        cpus.lines().find(|line| line.starts_with("flags") || line.starts_with("Features"));
    features.unwrap_or_default().to_owned()
}

/// Checks that only this user can put files into `folder`, or replace it.
fn check_folder(folder: &Path) -> Result<(), CompileError> {
    let read = |source| CompileError::ReadCode { path: folder.to_owned(), source };
    let untrusted = |path: &Path, why: &str| {
        Err(CompileError::Untrusted { path: path.to_owned(), why: why.to_owned() })
    };
    let whole = fs::canonicalize(folder).map_err(read)?;
    for (above, path) in whole.ancestors().enumerate() {
        let meta = fs::symlink_metadata(path).map_err(read)?;
        let root_owns = meta.uid() == 0;
        let wrong = match foreign(&meta) {
            // Parent folders may belong to root. In a world-writable one such as /tmp, the sticky
            // bit protects this user's files.
            Some(OTHER_OWNER) if above > 0 && root_owns && meta.mode() & 0o022 == 0 => None,
            Some(_) if above > 0 && root_owns && meta.mode() & 0o1000 != 0 => None,
            wrong => wrong,
        };
        if let Some(why) = wrong {
            return untrusted(path, why);
        }
    }
    Ok(())
}

const OTHER_OWNER: &str = "it belongs to another user";

fn foreign(meta: &Metadata) -> Option<&'static str> {
    if meta.uid() != rustix::process::geteuid().as_raw() {
        Some(OTHER_OWNER)
    } else if meta.mode() & 0o022 != 0 {
        Some("others may write to it")
    } else {
        None
    }
}

/// Creates the cache folder, accessible to this user only.
///
/// # Errors
///
/// [`CompileError::Write`].
pub fn make_cache(cache: &Path) -> Result<(), CompileError> {
    let write = |source| CompileError::Write { path: cache.to_owned(), source };
    if let Some(parent) = cache.parent() {
        fs::create_dir_all(parent).map_err(write)?;
    }
    match fs::DirBuilder::new().mode(0o700).create(cache) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(write(error)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};

    use rustix::fs::{CWD, FileType, Mode, mknodat};

    use super::*;

    const CODE: &[u8] = b"native code";

    /// Creates a cache with an entry. Returns the cache, the entry, and the bytes of the entry.
    fn cache(name: &str) -> (PathBuf, CacheEntry, Vec<u8>) {
        let cache =
            std::env::temp_dir().join(format!("gleaner-entry-{name}-{}", std::process::id()));
        make_cache(&cache).unwrap();
        let entry = CacheEntry::of(&cache, b"component", Nans::Native);
        let bytes = [&entry.head(CODE), CODE].concat();
        put(&entry, &bytes);
        (cache, entry, bytes)
    }

    fn put(entry: &CacheEntry, bytes: &[u8]) {
        fs::write(&entry.path, bytes).unwrap();
        fs::set_permissions(&entry.path, PermissionsExt::from_mode(0o600)).unwrap();
    }

    #[test]
    fn another_component_has_another_entry() {
        let path = |component: &[u8], nans| CacheEntry::of(Path::new("/c"), component, nans).path;
        assert_eq!(path(b"a", Nans::Native), path(b"a", Nans::Native));
        assert_ne!(path(b"a", Nans::Native), path(b"b", Nans::Native));
        assert_ne!(path(b"a", Nans::Native), path(b"a", Nans::Canonical));
        assert_eq!(path(b"a", Nans::Native).file_name().unwrap().len(), 64 + ".cwasm".len());
    }

    #[test]
    fn changed_code_is_not_read_back() {
        let (cache, entry, bytes) = cache("bits");
        assert_eq!(entry.read().unwrap(), CacheLookup::Code(CODE.to_vec()));
        let damaged = |bytes: &[u8]| {
            put(&entry, bytes);
            matches!(entry.read().unwrap(), CacheLookup::Damaged(_))
        };
        for bit in 0..8 * bytes.len() {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(damaged(&flipped), "bit {bit}");
        }
        for len in 0..bytes.len() {
            assert!(damaged(&bytes[..len]), "{len} bytes");
        }
        assert!(damaged(&[&bytes[..], b"x"].concat()) && damaged(CODE) && damaged(b"\x7fELF"));
        let other = CacheEntry::of(&cache, b"another component", Nans::Native);
        assert!(damaged(&[&other.head(CODE), CODE].concat()));
        File::options().write(true).open(&entry.path).unwrap().set_len(1 << 40).unwrap();
        assert_eq!(entry.read().unwrap(), CacheLookup::Damaged("it is too long".to_owned()));
        fs::remove_file(&entry.path).unwrap();
        assert_eq!(entry.read().unwrap(), CacheLookup::Nothing);
        fs::remove_dir_all(&cache).unwrap();
    }

    #[test]
    fn code_that_others_may_write_is_not_trusted() {
        let (cache, entry, _) = cache("modes");
        let refused = |path: &Path, mode| {
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
            entry.read().unwrap_err().to_string()
        };
        let message = refused(&entry.path, 0o620);
        assert!(message.ends_with(".cwasm` is not loaded: others may write to it"), "{message}");
        let message = refused(&cache, 0o770);
        assert!(
            message.ends_with("others may write to it") && !message.contains(".cwasm"),
            "{message}"
        );
        fs::remove_dir_all(&cache).unwrap();
    }

    #[test]
    fn an_entry_that_is_not_a_regular_file_is_refused_without_blocking() {
        let (cache, entry, bytes) = cache("kinds");
        let place = &entry.path;
        let why = || {
            let error = entry.read().unwrap_err();
            fs::remove_file(place).or_else(|_| fs::remove_dir(place)).unwrap();
            error.to_string().rsplit_once(": ").unwrap().1.to_owned()
        };
        fs::rename(place, cache.join("elsewhere")).unwrap();
        symlink(cache.join("elsewhere"), place).unwrap();
        assert_eq!(why(), "it is a link");
        mknodat(CWD, place, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        assert_eq!(why(), "it is not a regular file");
        mknodat(CWD, place, FileType::Socket, Mode::RUSR | Mode::WUSR, 0).unwrap();
        assert_eq!(why(), "it is not a regular file");
        fs::create_dir(place).unwrap();
        assert_eq!(why(), "it is not a regular file");
        symlink("/dev/zero", place).unwrap();
        assert_eq!(why(), "it is a link");
        put(&entry, &bytes);
        assert_eq!(entry.read().unwrap(), CacheLookup::Code(CODE.to_vec()));
        fs::remove_dir_all(&cache).unwrap();
    }
}
