//! Computes the checksums of the drives, which identify their files byte for byte.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::thread::{self, JoinHandle};

use gleaner_base::Explain;
use gleaner_journal::DriveDigest;

/// Bytes that are read at a time.
const PIECE: usize = 64 << 10;

/// A drive that cannot be read a second time.
#[derive(Debug, thiserror::Error)]
#[error("cannot take the checksum of drive `{}`", path.display())]
pub(super) struct DigestError {
    path: PathBuf,
    source: io::Error,
}

impl Explain for DigestError {}

/// Checksums of the drives, computed by a thread while the lambda runs over the same files.
pub(super) struct Digests(JoinHandle<Result<Vec<DriveDigest>, DigestError>>);

impl Digests {
    pub(super) fn start(drives: Vec<PathBuf>) -> Self {
        Self(thread::spawn(move || drives.iter().map(|drive| digest(drive)).collect()))
    }

    /// Waits for the checksums.
    pub(super) fn take(self) -> Result<Vec<DriveDigest>, DigestError> {
        self.0.join().expect("reading a file does not panic")
    }
}

fn digest(path: &Path) -> Result<DriveDigest, DigestError> {
    let failed = |source| DigestError { path: path.to_owned(), source };
    let mut file = File::open(path).map_err(failed)?;
    let (mut crc, mut bytes, mut piece) = (crc32fast::Hasher::new(), 0, vec![0; PIECE]);
    loop {
        match file.read(&mut piece) {
            Ok(0) => break,
            Ok(n) => {
                crc.update(&piece[..n]);
                bytes += n as u64;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(failed(error)),
        }
    }
    // The folder does not identify a drive.
    let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    Ok(DriveDigest { name, bytes, crc32: crc.finalize() })
}
