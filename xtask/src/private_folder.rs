//! A temporary folder of this process.

use std::env;
use std::fs::{self, DirBuilder};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::Duration;

use gleaner_base::Failure;

use crate::steps::cannot;

/// A temporary folder, at first for this user only, removed with this value.
pub(crate) struct PrivateFolder(PathBuf);

impl PrivateFolder {
    pub(crate) fn create(name: &str) -> Result<Self, Failure> {
        let folder = env::temp_dir().join(format!("gleaner-{name}-{}", std::process::id()));
        let created = DirBuilder::new().mode(0o700).create(&folder);
        created.map_err(|error| cannot("create", &folder, &error))?;
        Ok(Self(folder))
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for PrivateFolder {
    fn drop(&mut self) {
        // The last processes of PostgreSQL end, and write, after it was killed.
        for _ in 0..50 {
            if fs::remove_dir_all(&self.0).is_ok() || !self.0.exists() {
                return;
            }
            sleep(Duration::from_millis(100));
        }
    }
}
