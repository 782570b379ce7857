use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

/// A folder for one test, removed with everything in it when the test ends.
pub struct TestFolder {
    root: PathBuf,
}

impl TestFolder {
    #[expect(clippy::new_without_default, reason = "it creates a folder")]
    pub fn new() -> TestFolder {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!(
            "gleaner-test-{}-{}",
            std::process::id(),
            COUNT.fetch_add(1, Ordering::Relaxed)
        );
        let root = std::env::temp_dir().join(name);
        fs::create_dir(&root).unwrap();
        // With links resolved, so that it equals the paths that programs find at run time.
        TestFolder { root: root.canonicalize().unwrap() }
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    pub fn path(&self, relative: &str) -> PathBuf {
        self.root.join(relative)
    }

    /// Writes a file and the folders above it.
    pub fn write(&self, relative: &str, text: &str) -> PathBuf {
        let path = self.path(relative);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, text).unwrap();
        path
    }

    /// As [`write`](Self::write), for an executable file.
    pub fn write_program(&self, relative: &str, text: &str) -> PathBuf {
        let path = self.write(relative, text);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        path
    }
}

impl Drop for TestFolder {
    fn drop(&mut self) {
        // A leftover folder is harmless; a panic during another panic would abort.
        let _ = fs::remove_dir_all(&self.root);
    }
}
