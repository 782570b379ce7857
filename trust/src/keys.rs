//! ed25519 keys and their files.
//!
//! A key file is PKCS#8 in PEM, as `openssl genpkey -algorithm ed25519` writes it, so that other
//! tools can use the key and check its signatures.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use gleaner_base::text::shell_word;
use gleaner_base::{ByteSize, Exit, Explain, NotPlain, PlainFile, excerpt, sync_folder};
use gleaner_lambda::manifest::Sha256;
use rustix::fs::{AtFlags, CWD, OFlags, linkat};
use rustix::io::Errno;
use rustix::process::geteuid;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::bounded;
use crate::digest::sha256;

/// Longest key file; the one that `create_file` writes has 119 bytes.
const FILE_MAX: ByteSize = ByteSize::kib(4);
const BEGIN: &str = "-----BEGIN PRIVATE KEY-----\n";
const END: &str = "-----END PRIVATE KEY-----\n";
/// Start of the DER form of an ed25519 key, before its 32 bytes (RFC 8410, section 7).
const PREFIX: [u8; 16] = [
    0x30, 0x2e, 0x02, 0x01, 0x00, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x04, 0x22, 0x04, 0x20,
];

pub struct SecretKey(SigningKey);

impl SecretKey {
    /// Creates a key from random bytes of the system.
    ///
    /// # Errors
    ///
    /// [`KeyError::Random`].
    pub fn generate() -> Result<Self, KeyError> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes)
            .map_err(|error| KeyError::Random { source: io::Error::other(error.to_string()) })?;
        Ok(Self(SigningKey::from_bytes(&bytes)))
    }

    pub fn from_bytes(bytes: &[u8; 32]) -> Self {
        Self(SigningKey::from_bytes(bytes))
    }

    /// Writes the key to the new file `path`, which only its user can read. After a kill, there is
    /// the whole file or none, except on a file system without unnamed files, such as NFS.
    ///
    /// # Errors
    ///
    /// [`KeyError::Exists`], [`KeyError::Create`].
    pub fn create_file(&self, path: &Path) -> Result<(), KeyError> {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
        let folder = folder.unwrap_or(Path::new("."));
        let der = [&PREFIX[..], self.0.as_bytes()].concat();
        let text = format!("{BEGIN}{}\n{END}", STANDARD.encode(der));
        write_new(folder, path, text.as_bytes()).map_err(|source| match source.kind() {
            io::ErrorKind::AlreadyExists => KeyError::Exists { path: path.to_owned() },
            _ => KeyError::Create { path: path.to_owned(), source },
        })?;
        sync_folder(folder).map_err(|source| {
            // It may be gone after a power cut. This error matters more than one of removing it.
            let _ = fs::remove_file(path);
            KeyError::Create { path: path.to_owned(), source }
        })
    }

    /// Loads the key in the file `path`.
    ///
    /// # Errors
    ///
    /// As for [`open`](Self::open).
    pub fn load(path: &Path) -> Result<Self, KeyError> {
        Self::open(path).map(|(key, _)| key)
    }

    /// Loads the key in the file `path`, and returns the open file with it: another program can
    /// [`read`](Self::read) the key from it, whatever it may open itself.
    ///
    /// # Errors
    ///
    /// [`KeyError::Read`], [`KeyError::NoKey`], [`KeyError::Foreign`] if it belongs to another
    /// user, [`KeyError::Shared`] if other users have access to it.
    pub fn open(path: &Path) -> Result<(Self, File), KeyError> {
        let failed = |source| KeyError::Read { path: path.to_owned(), source };
        let file = PlainFile::named(path, FILE_MAX).map_err(failed)?;
        let (mode, owner, user) = (file.mode(), file.owner(), geteuid().as_raw());
        let file = file.into_file();
        let text = text_of(&file).map_err(failed)?;
        match Self::parse(&text) {
            None => Err(KeyError::NoKey { path: path.to_owned() }),
            Some(_) if owner != user => {
                Err(KeyError::Foreign { path: path.to_owned(), owner, user })
            }
            Some(_) if mode & 0o077 != 0 => Err(KeyError::Shared { path: path.to_owned(), mode }),
            Some(key) => Ok((key, file)),
        }
    }

    /// Reads the key from an open file, whose access rights its opener has checked. The position of
    /// the file, which several programs may share, stays as it is.
    ///
    /// # Errors
    ///
    /// Those of the file system, and `InvalidData` if the file has no key.
    pub fn read(file: &File) -> io::Result<Self> {
        Self::parse(&text_of(file)?).ok_or_else(|| {
            io::Error::new(io::ErrorKind::InvalidData, "it is not an ed25519 key in PEM")
        })
    }

    /// Returns whether a file with this content is the file of a secret key.
    pub(crate) fn is_key(text: &[u8]) -> bool {
        text.len() as u64 <= FILE_MAX.bytes() && Self::parse(text).is_some()
    }

    fn parse(text: &[u8]) -> Option<Self> {
        let text = std::str::from_utf8(text).ok()?.replace('\r', "");
        let body = text.strip_prefix(BEGIN)?.trim_end().strip_suffix(END.trim_end())?;
        let der = STANDARD.decode(body.replace('\n', "")).ok()?;
        let bytes = der.strip_prefix(&PREFIX)?;
        Some(Self(SigningKey::from_bytes(bytes.try_into().ok()?)))
    }

    /// Returns the key that checks its signatures.
    pub fn public(&self) -> PublicKey {
        PublicKey(self.0.verifying_key())
    }

    pub(crate) fn sign(&self, message: &[u8]) -> [u8; 64] {
        self.0.sign(message).to_bytes()
    }
}

/// Reads an open key file from its start.
fn text_of(file: &File) -> io::Result<Vec<u8>> {
    let mut text = vec![0; FILE_MAX.bytes() as usize + 1];
    let mut length = 0;
    while length < text.len() {
        match file.read_at(&mut text[length..], length as u64)? {
            0 => break,
            read => length += read,
        }
    }
    if length == text.len() {
        let (bytes, most) = (length as u64, FILE_MAX);
        return Err(io::Error::other(NotPlain::TooLong { bytes, most }));
    }
    text.truncate(length);
    Ok(text)
}

/// Writes `text` to a file without a name in `folder`, and names it `path` once it is whole.
fn write_new(folder: &Path, path: &Path, text: &[u8]) -> io::Result<()> {
    let (mut open, flags) = (File::options(), OFlags::TMPFILE.bits().cast_signed());
    open.write(true).mode(0o600);
    let write = |file: &mut File| file.write_all(text).and_then(|()| file.sync_all());
    match open.clone().custom_flags(flags).open(folder) {
        Ok(mut file) => {
            write(&mut file)?;
            let unnamed = format!("/proc/self/fd/{}", file.as_raw_fd());
            Ok(linkat(CWD, unnamed, CWD, path, AtFlags::SYMLINK_FOLLOW)?)
        }
        // A file system without such files, such as NFS: a kill may leave an incomplete file.
        Err(error) if Errno::from_io_error(&error) == Some(Errno::OPNOTSUPP) => {
            let mut file = open.create_new(true).open(path)?;
            write(&mut file).inspect_err(|_| {
                let _ = fs::remove_file(path);
            })
        }
        Err(error) => Err(error),
    }
}

/// Without the key, which must not be in a log.
impl fmt::Debug for SecretKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SecretKey({})", self.public().id())
    }
}

/// A key that checks signatures. Its text is the base64 of its 32 bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PublicKey(VerifyingKey);

impl PublicKey {
    /// Returns the id that names the key in envelopes: the SHA-256 of its 32 bytes.
    pub fn id(&self) -> Sha256 {
        sha256(self.0.as_bytes())
    }

    pub(crate) fn verifies(&self, message: &[u8], signature: &[u8; 64]) -> bool {
        self.0.verify_strict(message, &Signature::from_bytes(signature)).is_ok()
    }
}

impl FromStr for PublicKey {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let bytes = STANDARD.decode(text).ok().and_then(|bytes| bytes.try_into().ok());
        let key = bytes.and_then(|bytes| VerifyingKey::from_bytes(&bytes).ok());
        // A weak key accepts signatures without its secret key.
        key.filter(|key| !key.is_weak())
            .map(Self)
            .ok_or_else(|| format!("`{}` is not an ed25519 public key", excerpt(text)))
    }
}

impl fmt::Display for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&STANDARD.encode(self.0.as_bytes()))
    }
}

impl Serialize for PublicKey {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for PublicKey {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        bounded::text(from)
    }
}

/// The reason why a key file cannot be created or used.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    #[error("the system has no random bytes for a key")]
    Random { source: io::Error },
    #[error("key file `{}` exists", path.display())]
    Exists { path: PathBuf },
    #[error("cannot create key file `{}`", path.display())]
    Create { path: PathBuf, source: io::Error },
    #[error("cannot read key file `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("key file `{}` belongs to user {owner}, and this is user {user}", path.display())]
    Foreign { path: PathBuf, owner: u32, user: u32 },
    #[error("other users have access to key file `{}` (mode {mode:03o})", path.display())]
    Shared { path: PathBuf, mode: u32 },
    #[error("`{}` is not an ed25519 key in PEM", path.display())]
    NoKey { path: PathBuf },
}

impl Explain for KeyError {
    fn help(&self) -> Option<String> {
        Some(match self {
            Self::Random { .. } => return None,
            Self::Exists { .. } => "a key is never overwritten: choose another name".to_owned(),
            Self::Create { .. } => {
                "check that the folder exists and is writable, and that its disk has room"
                    .to_owned()
            }
            Self::Read { path, source } => match NotPlain::of(source) {
                Some(reason) => reason.help(),
                None if source.kind() == io::ErrorKind::NotFound => {
                    format!(
                        "check its path, or make a key: `gleaner keys new {}`",
                        shell_word(path)
                    )
                }
                None => "name a file that you can read".to_owned(),
            },
            Self::Shared { path, .. } => format!(
                "run `chmod 600 {}`; if another user may have read it, make a new key",
                shell_word(path)
            ),
            Self::Foreign { .. } => {
                "use a key of your own; that user can read this one, and replace it".to_owned()
            }
            Self::NoKey { .. } => {
                "name the file of a key; `gleaner keys new FILE` makes one under a new name"
                    .to_owned()
            }
        })
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Random { .. } => Exit::Internal,
            Self::Foreign { .. } | Self::Shared { .. } => Exit::Denied,
            _ => Exit::Usage,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_of_rfc_8032_has_its_public_key_and_its_signature() {
        // RFC 8032, section 7.1, TEST 2, as a file of openssl.
        let file = "-----BEGIN PRIVATE KEY-----\n\
                    MC4CAQAwBQYDK2VwBCIEIEzNCJso/5banbbDRuwRTg9bijGfNaumJNqM9u1PuKb7\n\
                    -----END PRIVATE KEY-----\n";
        let key = SecretKey::parse(file.as_bytes()).expect("a key in PEM");
        assert_eq!(key.public().to_string(), "PUAXw+hDiVqStwqnTRt+vJyYLM8uxJaMwM1V8Sr0Zgw=");
        let signature = gleaner_base::hex(&key.sign(&[0x72]));
        assert!(signature.starts_with("92a009a9f0d4cab8720e820b5f642540"), "{signature}");
        assert!(!format!("{key:?}").contains("4ccd"));
    }

    #[test]
    fn weak_and_broken_public_keys_are_refused() {
        // The neutral element of the curve: any message has a signature that it accepts.
        let mut weak = [0; 32];
        weak[0] = 1;
        for text in [&STANDARD.encode(weak), "", "AAAA", "no base64", &"A".repeat(1 << 16)] {
            let error = text.parse::<PublicKey>().unwrap_err();
            assert!(error.len() < 200, "{error}");
        }
    }
}
