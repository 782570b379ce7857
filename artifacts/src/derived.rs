//! An entry of the store: bytes that a tool made of a file, behind a digest that binds them to
//! everything they were made from.
//!
//! Bytes that were changed, truncated or copied from another entry are never used. An attacker who
//! can write into the store can also write the digest, so owners and modes are checked first.

use std::fs::{self, File};
use std::io::{self, Read, Seek};
use std::path::{Path, PathBuf};

use gleaner_base::hex;
use gleaner_base::safe_file::{self, UnsafePath};
use sha2::{Digest, Sha256};

use super::prune::{STORE_BYTES, note_use, prune};
use super::trust::{check_folder, foreign};
use super::write::write_whole;
use super::{DerivedKind, StoreError};

/// First bytes of an entry. They are part of its key, so that entries of another layout have other
/// names.
const MAGIC: [u8; 16] = *b"gleaner store  1";
const DIGEST_BYTES: usize = 32;
const HEAD_BYTES: usize = MAGIC.len() + DIGEST_BYTES;

/// Everything that an entry was made from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DerivedKey {
    kind: DerivedKind,
    digest: [u8; DIGEST_BYTES],
}

/// The location of an entry in a store.
#[derive(Debug)]
pub struct DerivedEntry {
    path: PathBuf,
    key: DerivedKey,
}

#[derive(Debug, PartialEq, Eq)]
pub enum StoreLookup {
    /// The bytes as they were put.
    Content(Vec<u8>),
    Nothing,
    /// Damaged bytes, with the reason. They have to be replaced.
    Damaged(String),
}

impl DerivedKey {
    /// Returns the key of what a tool makes on this machine, by `settings`, of `input`: a file, or
    /// its digest. `settings` name the tool and its version.
    pub fn of(kind: DerivedKind, settings: &str, input: &[u8]) -> Self {
        let mut key = Sha256::new();
        let arch = std::env::consts::ARCH.as_bytes();
        let cpu = match kind {
            DerivedKind::NativeCode => cpu_features(),
            // It runs on the GPU, which its runtime names.
            DerivedKind::Engine => String::new(),
        };
        let kind_name = kind.extension().as_bytes();
        for part in [&MAGIC, kind_name, settings.as_bytes(), arch, cpu.as_bytes(), input] {
            key.update((part.len() as u64).to_le_bytes());
            key.update(part);
        }
        Self { kind, digest: key.finalize().into() }
    }

    /// Reads the content of an open entry into memory and compares its digest there, so that later
    /// changes to the file do not affect it.
    pub fn verified(&self, file: &File) -> StoreLookup {
        // A read error counts as damage.
        self.compared(file).unwrap_or_else(|error| StoreLookup::Damaged(error.to_string()))
    }

    fn compared(&self, mut file: &File) -> io::Result<StoreLookup> {
        let damaged = |why: &str| Ok(StoreLookup::Damaged(why.to_owned()));
        let (len, max) = (file.metadata()?.len(), self.kind.max_bytes());
        let Some(len) = usize::try_from(len).ok().and_then(|len| len.checked_sub(HEAD_BYTES))
        else {
            return damaged("it is too short");
        };
        if len > max {
            return damaged("it is too long");
        }
        file.rewind()?;
        let mut head = [0; HEAD_BYTES];
        file.read_exact(&mut head)?;
        let mut content = Vec::with_capacity(len);
        file.take(max as u64).read_to_end(&mut content)?;
        if head == self.head(&[&content]) {
            Ok(StoreLookup::Content(content))
        } else {
            damaged("its digest does not match its content")
        }
    }

    /// Returns the header before the content, which has these parts, in the file.
    fn head(&self, parts: &[&[u8]]) -> [u8; HEAD_BYTES] {
        let mut digest = Sha256::new().chain_update(self.digest);
        parts.iter().for_each(|part| digest.update(part));
        let digest = digest.finalize();
        let mut head = [0; HEAD_BYTES];
        head[..MAGIC.len()].copy_from_slice(&MAGIC);
        head[MAGIC.len()..].copy_from_slice(&digest);
        head
    }
}

impl DerivedEntry {
    /// Returns the entry with this key in the folder `store`, such as `<store>/<key>.cwasm`.
    pub fn of(store: &Path, key: DerivedKey) -> Self {
        let name = format!("{}.{}", hex(&key.digest), key.kind.extension());
        Self { path: store.join(name), key }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reads the content and verifies it, see [`DerivedKey::verified`].
    ///
    /// # Errors
    ///
    /// Those of [`open`](Self::open).
    pub fn read(&self) -> Result<StoreLookup, StoreError> {
        let Some(file) = self.open()? else { return Ok(StoreLookup::Nothing) };
        Ok(self.key.verified(&file))
    }

    /// Opens the file, unverified; `None` if there is none. Notes the use for pruning.
    ///
    /// # Errors
    ///
    /// [`StoreError::Untrusted`] if another user could have written it: file and folders above it
    /// must belong to this user or to root, and only they may write to them. Also if it is not a
    /// regular file. [`StoreError::Read`] if it cannot be opened.
    pub fn open(&self) -> Result<Option<File>, StoreError> {
        self.check_store()?;
        let kind = self.key.kind;
        let untrusted = |path: &Path, why: String| {
            let path = path.to_owned();
            StoreError::Untrusted { kind, path, why }
        };
        let cannot = |error: io::Error| match UnsafePath::of(&error) {
            Some(other) => untrusted(&self.path, other.to_string()),
            None => StoreError::Read { kind, path: self.path.clone(), source: error },
        };
        let file = match safe_file::read(&self.path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            opened => opened.map_err(cannot)?,
        };
        match foreign(&file.metadata().map_err(cannot)?) {
            Some(why) => Err(untrusted(&self.path, why.to_owned())),
            None => {
                note_use(&file);
                Ok(Some(file))
            }
        }
    }

    /// Checks that only this user can put entries into the store.
    fn check_store(&self) -> Result<(), StoreError> {
        let kind = self.key.kind;
        let folder = self.path.parent().unwrap_or(&self.path);
        let read = |source| StoreError::Read { kind, path: folder.to_owned(), source };
        match check_folder(folder).map_err(read)? {
            Ok(()) => Ok(()),
            Err((path, why)) => Err(StoreError::Untrusted { kind, path, why: why.to_owned() }),
        }
    }

    /// Writes the content, in parts, as a whole; a process that is killed meanwhile leaves the file
    /// as it was. Then removes the least recently used entries beyond [`STORE_BYTES`], but not this
    /// one.
    ///
    /// # Errors
    ///
    /// [`StoreError::Write`]; content above the maximum of its kind is an error, too.
    /// [`StoreError::Untrusted`] for a store from which it would not be read.
    pub fn put(&self, content: &[&[u8]]) -> Result<(), StoreError> {
        let (len, max) = (content.iter().map(|part| part.len()).sum::<usize>(), self.max_bytes());
        if len > max {
            return Err(self.refused(format!("it has {len} bytes; the maximum is {max}")));
        }
        self.check_store()?;
        let head = self.key.head(content);
        let parts = [&[&head[..]], content].concat();
        write_whole(&self.path, &parts).map_err(|error| self.failed(error))?;
        // Entries that cannot be removed now are removed with a later one.
        let _ = prune(self.path.parent().unwrap_or(&self.path), &self.path, STORE_BYTES);
        Ok(())
    }

    fn max_bytes(&self) -> usize {
        self.key.kind.max_bytes()
    }

    /// Returns the error for content that is not put, for this reason.
    pub(crate) fn refused(&self, reason: String) -> StoreError {
        self.failed(io::Error::new(io::ErrorKind::InvalidInput, reason))
    }

    fn failed(&self, source: io::Error) -> StoreError {
        StoreError::Write { kind: self.key.kind, path: self.path.clone(), source }
    }
}

/// Returns the CPU features of this machine, as the kernel names them, since a store in a home
/// folder may be shared by several machines. Wasmtime checks them again when it loads code.
fn cpu_features() -> String {
    let cpus = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let features =
        cpus.lines().find(|line| line.starts_with("flags") || line.starts_with("Features"));
    features.unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, symlink};

    use rustix::fs::{CWD, FileType, Mode, mknodat};

    use super::*;
    use crate::make_store;

    const CODE: &[u8] = b"native code";

    fn key(settings: &str, input: &[u8]) -> DerivedKey {
        DerivedKey::of(DerivedKind::NativeCode, settings, input)
    }

    /// Creates a store with an entry. Returns the store, the entry, and the bytes of the entry.
    fn store(name: &str) -> (PathBuf, DerivedEntry, Vec<u8>) {
        let store =
            std::env::temp_dir().join(format!("gleaner-entry-{name}-{}", std::process::id()));
        make_store(&store).unwrap();
        let entry = DerivedEntry::of(&store, key("a", b"component"));
        entry.put(&[CODE]).unwrap();
        let bytes = fs::read(&entry.path).unwrap();
        (store, entry, bytes)
    }

    fn put(entry: &DerivedEntry, bytes: &[u8]) {
        fs::write(&entry.path, bytes).unwrap();
        fs::set_permissions(&entry.path, PermissionsExt::from_mode(0o600)).unwrap();
    }

    #[test]
    fn other_settings_or_another_input_have_another_entry() {
        let path = |settings, input| DerivedEntry::of(Path::new("/s"), key(settings, input)).path;
        assert_eq!(path("1", b"a"), path("1", b"a"));
        assert_ne!(path("1", b"a"), path("1", b"b"));
        assert_ne!(path("1", b"a"), path("2", b"a"));
        assert_ne!(path("1", b"2"), path("12", b""));
        assert_eq!(path("1", b"a").file_name().unwrap().len(), 64 + ".cwasm".len());
    }

    #[test]
    fn changed_code_is_not_read_back() {
        let (store, entry, bytes) = store("bits");
        assert_eq!(entry.read().unwrap(), StoreLookup::Content(CODE.to_vec()));
        let damaged = |bytes: &[u8]| {
            put(&entry, bytes);
            matches!(entry.read().unwrap(), StoreLookup::Damaged(_))
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
        let other = key("a", b"another component");
        assert!(damaged(&[&other.head(&[CODE]), CODE].concat()));
        File::options().write(true).open(&entry.path).unwrap().set_len(1 << 40).unwrap();
        assert_eq!(entry.read().unwrap(), StoreLookup::Damaged("it is too long".to_owned()));
        fs::remove_file(&entry.path).unwrap();
        assert_eq!(entry.read().unwrap(), StoreLookup::Nothing);
        fs::remove_dir_all(&store).unwrap();
    }

    #[test]
    fn code_that_others_may_write_is_not_trusted() {
        let (store, entry, _) = store("modes");
        let refused = |path: &Path, mode| {
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
            entry.read().unwrap_err().to_string()
        };
        let message = refused(&entry.path, 0o620);
        assert!(message.ends_with(".cwasm` is not loaded: others may write to it"), "{message}");
        let message = refused(&store, 0o770);
        assert!(
            message.ends_with("others may write to it") && !message.contains(".cwasm"),
            "{message}"
        );
        fs::remove_dir_all(&store).unwrap();
    }

    #[test]
    fn an_entry_that_is_not_a_regular_file_is_refused_without_blocking() {
        let (store, entry, bytes) = store("kinds");
        let place = &entry.path;
        let why = || {
            let error = entry.read().unwrap_err();
            fs::remove_file(place).or_else(|_| fs::remove_dir(place)).unwrap();
            error.to_string().rsplit_once(": ").unwrap().1.to_owned()
        };
        fs::rename(place, store.join("elsewhere")).unwrap();
        symlink(store.join("elsewhere"), place).unwrap();
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
        assert_eq!(entry.read().unwrap(), StoreLookup::Content(CODE.to_vec()));
        fs::remove_dir_all(&store).unwrap();
    }

    #[test]
    fn content_above_the_maximum_is_not_put() {
        let (store, entry, _) = store("large");
        let error = entry.put(&[&vec![0; entry.max_bytes()], b"x"]).unwrap_err();
        let cause = std::error::Error::source(&error).unwrap().to_string();
        assert_eq!(cause, "it has 268435457 bytes; the maximum is 268435456");
        assert_eq!(entry.read().unwrap(), StoreLookup::Content(CODE.to_vec()));
        assert_eq!(fs::read_dir(&store).unwrap().count(), 1, "no partial file is left");
        fs::remove_dir_all(&store).unwrap();
    }
}
