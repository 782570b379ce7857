//! Files that are sent to a vehicle or to the cloud, as both check them.

use std::fs;
use std::io::{self, Read};
use std::path::PathBuf;

use sha2::{Digest, Sha256};

/// A file that is compared, piece by piece, with the length and the SHA-256 that were announced.
#[derive(Debug)]
pub struct AnnouncedFile {
    length: u64,
    received: u64,
    digest: Sha256,
}

impl AnnouncedFile {
    /// Begins with none of `length` bytes.
    pub fn new(length: u64) -> Self {
        Self { length, received: 0, digest: Sha256::new() }
    }

    /// Adds as much of the next piece as was announced.
    ///
    /// # Errors
    ///
    /// The reason, if the file is longer than announced.
    pub fn add(&mut self, piece: &[u8]) -> Result<(), String> {
        let left = usize::try_from(self.length - self.received).unwrap_or(usize::MAX);
        let fits = &piece[..piece.len().min(left)];
        self.received += fits.len() as u64;
        self.digest.update(fits);
        match fits.len() == piece.len() {
            true => Ok(()),
            false => Err(format!("it is longer than {} bytes", self.length)),
        }
    }

    /// Returns the number of bytes so far.
    pub fn received(&self) -> u64 {
        self.received
    }

    /// Returns the SHA-256 of the bytes so far, in lower-case hexadecimal digits.
    pub fn into_sha256(self) -> String {
        gleaner_base::hex(&self.digest.finalize())
    }

    /// Compares all of a file.
    ///
    /// # Errors
    ///
    /// The outer one if it cannot be read, and the inner one with the reason if it is another file.
    pub fn compare(mut self, sha256: &str, mut file: impl Read) -> io::Result<Result<(), String>> {
        let mut piece = vec![0; 1 << 20];
        loop {
            match file.read(&mut piece)? {
                0 => return Ok(self.finish(sha256)),
                read => {
                    if let Err(reason) = self.add(&piece[..read]) {
                        return Ok(Err(reason));
                    }
                }
            }
        }
    }

    /// Ends the file.
    ///
    /// # Errors
    ///
    /// The reason, if it is shorter than announced, or another one.
    pub fn finish(self, sha256: &str) -> Result<(), String> {
        let Self { length, received, .. } = self;
        let found = self.into_sha256();
        match received == length && found == sha256 {
            true => Ok(()),
            false => Err(format!("it has {received} of {length} bytes, and the SHA-256 {found}")),
        }
    }
}

/// The path of a file that is being received. Dropping it removes the file, unless that has its
/// final name by then.
#[derive(Debug)]
pub struct UnfinishedFile(pub PathBuf);

impl Drop for UnfinishedFile {
    fn drop(&mut self) {
        // The next start removes what stays.
        let _ = fs::remove_file(&self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// SHA-256 of `ab`.
    const AB: &str = "fb8e20fc2e4c3f248c60c39bd652f3c1347298bb977b8b4d5903b85055620603";

    fn compared(length: u64, pieces: &[&str]) -> Result<(), String> {
        let mut file = AnnouncedFile::new(length);
        pieces.iter().try_for_each(|piece| file.add(piece.as_bytes()))?;
        file.finish(AB)
    }

    #[test]
    fn only_the_announced_file_is_accepted() {
        assert_eq!(compared(2, &["a", "b"]), Ok(()));
        assert_eq!(compared(2, &["ab", "c"]), Err("it is longer than 2 bytes".to_owned()));
        assert!(compared(2, &["a"]).unwrap_err().starts_with("it has 1 of 2 bytes"));
        assert!(compared(3, &["ab"]).unwrap_err().starts_with("it has 2 of 3 bytes"));
        assert!(compared(2, &["ba"]).unwrap_err().contains("the SHA-256"));
        let whole = |content: &str| AnnouncedFile::new(2).compare(AB, content.as_bytes()).unwrap();
        assert_eq!(whole("ab"), Ok(()));
        assert_eq!(whole("abc"), Err("it is longer than 2 bytes".to_owned()));
    }

    #[test]
    fn an_unfinished_file_is_removed_and_a_finished_one_stays() {
        let folder = tempfile::tempdir().unwrap();
        let [part, whole] = ["part", "whole"].map(|name| folder.path().join(name));
        for is_finished in [false, true] {
            fs::write(&part, "x").unwrap();
            let unfinished = UnfinishedFile(part.clone());
            if is_finished {
                fs::rename(&unfinished.0, &whole).unwrap();
            }
            drop(unfinished);
            assert_eq!((part.exists(), whole.exists()), (false, is_finished));
        }
    }
}
