//! The clip folder: file names, the list, and the lock.

use std::collections::HashSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use gleaner_lambda::Clip;
use gleaner_trust::ClipSigner;

use super::list::ClipList;
use crate::error::RecordError;

/// The folder of the clips, within the output folder.
pub(super) const CLIPS: &str = "clips";
pub(super) const CLIP: &str = ".mcap";
pub(super) const PART: &str = ".mcap.part";
/// Suffix of a recovered copy of an unfinished clip, in progress.
pub(super) const AGAIN: &str = ".mcap.part2";
pub(super) const JPG: &str = ".jpg";
pub(super) const JPG_PART: &str = ".jpg.part";

/// Maximum length of a name without its suffix, in bytes; file systems allow 255 with it.
const BASE_MAX: usize = 160;

/// The folder, shared with unfinished clips. Its lock is held as long as one of them lives.
pub(super) struct ClipDir {
    folder: PathBuf,
    list: ClipList,
    /// File names that are or were listed, or will be: no name is used twice, even after its clip
    /// was fetched and deleted.
    taken: Mutex<HashSet<String>>,
    signer: OnceLock<ClipSigner>,
    /// Number of clips that could not be signed.
    unsigned: Arc<AtomicU64>,
    _lock: File,
}

impl ClipDir {
    pub(super) fn new(folder: PathBuf, list: ClipList, taken: HashSet<String>, lock: File) -> Self {
        Self {
            folder,
            list,
            taken: Mutex::new(taken),
            signer: OnceLock::new(),
            unsigned: Arc::default(),
            _lock: lock,
        }
    }

    /// Signs the clips that are begun from now on. A second call has no effect.
    pub(super) fn sign_with(&self, signer: ClipSigner) {
        let _ = self.signer.set(signer);
    }

    pub(super) fn signer(&self) -> Option<&ClipSigner> {
        self.signer.get()
    }

    pub(super) fn count_unsigned(&self) {
        self.unsigned.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn unsigned(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.unsigned)
    }

    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }

    pub(super) fn list(&self) -> &ClipList {
        &self.list
    }

    pub(super) fn path(&self, name: &str, suffix: &str) -> PathBuf {
        self.folder.join(format!("{name}{suffix}"))
    }

    pub(super) fn exists(&self, name: &str, suffix: &str) -> bool {
        self.path(name, suffix).symlink_metadata().is_ok()
    }

    pub(super) fn add(&self, name: &str, clip: &Clip) -> Result<(), RecordError> {
        self.list.append(clip)?;
        self.take(name);
        Ok(())
    }

    pub(super) fn take(&self, name: &str) {
        self.taken().insert(format!("{name}{CLIP}"));
    }

    pub(super) fn is_taken(&self, file: &str) -> bool {
        self.taken().contains(file)
    }

    /// Replaces the reserved names by these files.
    pub(super) fn take_only(&self, files: HashSet<String>) {
        *self.taken() = files;
    }

    /// Returns a free name, without reserving it: `base`, or the first of `base-2`, `base-3` and so
    /// on.
    pub(super) fn free_name(&self, base: &str) -> String {
        let base = sanitized(base);
        names(&base)
            .find(|name| {
                let is_file = |suffix: &&str| self.exists(name, suffix);
                ![CLIP, PART, AGAIN, JPG, JPG_PART].iter().any(is_file)
                    && !self.is_taken(&format!("{name}{CLIP}"))
            })
            .expect("there are more numbers than files")
    }

    fn taken(&self) -> MutexGuard<'_, HashSet<String>> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns `base`, `base-2`, `base-3` and so on.
pub(crate) fn names(base: &str) -> impl Iterator<Item = String> + '_ {
    (1_u64..).map(move |n| if n == 1 { base.to_owned() } else { format!("{base}-{n}") })
}

/// Makes `base` valid as the beginning of a file name on any system.
fn sanitized(base: &str) -> String {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
    let name: String =
        base.chars().map(|c| if allowed(c) { c } else { '-' }).take(BASE_MAX).collect();
    match name.trim_start_matches('.') {
        "" => "clip".to_owned(),
        name => name.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_stays_within_the_folder() {
        assert_eq!(sanitized("hello-20180802T083451.136Z"), "hello-20180802T083451.136Z");
        assert_eq!(sanitized("../../etc/passwd"), "-..-etc-passwd");
        assert_eq!(sanitized(""), "clip");
        assert_eq!(sanitized(".."), "clip");
        assert_eq!(sanitized("é\0\n"), "---");
        assert_eq!(sanitized(&"x".repeat(1000)).len(), BASE_MAX);
    }
}
