//! The build folder of a lambda, `DIR/build/`: what `gleaner build DIR` leaves and every other command uses.
//!
//! It is complete: manifest, entry, models and `msg/`. Nothing here builds, and no reader of a build folder writes
//! into it.

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use crate::{Exit, Explain, Manifest};

/// `DIR/build/` of one lambda.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BuildDir {
    path: PathBuf,
}

impl BuildDir {
    /// The build folder of the lambda in `lambda_dir`, whether it exists or not.
    pub fn of(lambda_dir: impl AsRef<Path>) -> BuildDir {
        BuildDir { path: lambda_dir.as_ref().join("build") }
    }

    /// The build folder of the lambda in `lambda_dir`, if it is there and no source is newer.
    ///
    /// The age of a build is that of its `lambda.toml`, which whoever builds writes last. Sources are `lambda.toml`,
    /// `Cargo.toml`, everything in `src/` and `msg/`, and every `.py` file; not what lies in `DIR/build/`, `DIR/target/`,
    /// or anywhere in a `__pycache__/` or a hidden folder such as `.venv/`. Links to folders are not followed.
    ///
    /// # Errors
    ///
    /// [`LayoutError::Missing`], [`LayoutError::Older`], or [`LayoutError::Read`] if a folder cannot be listed.
    pub fn check_fresh(lambda_dir: impl AsRef<Path>) -> Result<BuildDir, LayoutError> {
        let dir = lambda_dir.as_ref();
        let build = BuildDir::of(dir);
        let built = match fs::metadata(build.manifest_path()).and_then(|data| data.modified()) {
            Ok(time) => time,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return Err(LayoutError::Missing { dir: dir.to_owned() });
            }
            Err(source) => {
                return Err(LayoutError::Read { path: build.manifest_path(), source });
            }
        };
        match newest_source(dir)? {
            Some((modified, source)) if modified > built => {
                Err(LayoutError::Older { dir: dir.to_owned(), source_file: source })
            }
            _ => Ok(build),
        }
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its `lambda.toml`.
    pub fn manifest_path(&self) -> PathBuf {
        self.path.join("lambda.toml")
    }

    /// What `lambda.entry` of its manifest names.
    pub fn entry_path(&self, manifest: &Manifest) -> PathBuf {
        self.path.join(manifest.lambda.entry.as_path())
    }

    /// Its `msg/`, the message definitions that came with the lambda; it need not exist.
    pub fn messages_path(&self) -> PathBuf {
        self.path.join("msg")
    }
}

/// Why a build folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LayoutError {
    /// There is none.
    #[error("lambda `{}` is not built", dir.display())]
    Missing {
        /// The lambda's folder.
        dir: PathBuf,
    },
    /// A source changed since.
    #[error("the build of lambda `{}` is older than its source `{}`", dir.display(), source_file.display())]
    Older {
        /// The lambda's folder.
        dir: PathBuf,
        /// The newest source, relative to it.
        source_file: PathBuf,
    },
    /// A file or folder of the lambda cannot be read.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
}

impl Explain for LayoutError {
    fn help(&self) -> Option<String> {
        match self {
            LayoutError::Missing { dir } | LayoutError::Older { dir, .. } => {
                Some(format!("run `gleaner build {}`", dir.display()))
            }
            LayoutError::Read { .. } => None,
        }
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

/// The newest source of the lambda in `dir`, relative to it, and its time.
fn newest_source(dir: &Path) -> Result<Option<(SystemTime, PathBuf)>, LayoutError> {
    let mut newest = None;
    let mut folders = vec![PathBuf::new()];
    while let Some(folder) = folders.pop() {
        let path = dir.join(&folder);
        let failed = |source| LayoutError::Read { path: path.clone(), source };
        for entry in fs::read_dir(&path).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let relative = folder.join(entry.file_name());
            // Of the entry itself, so that a link back into the folder makes no circle.
            if entry.file_type().map_err(failed)?.is_dir() {
                if may_have_sources(&relative) {
                    folders.push(relative);
                }
            } else if is_source(&relative) {
                // Of what a link leads to. An editor may have removed the file meanwhile: then it is no source.
                let modified = fs::metadata(entry.path()).and_then(|data| data.modified());
                newest = newest.max(modified.ok().map(|modified| (modified, relative)));
            }
        }
    }
    Ok(newest)
}

fn may_have_sources(folder: &Path) -> bool {
    let name = folder.file_name().unwrap_or_default();
    let made = folder == Path::new("build") || folder == Path::new("target") || name == "__pycache__";
    !made && !name.as_encoded_bytes().starts_with(b".")
}

fn is_source(relative: &Path) -> bool {
    relative == Path::new("lambda.toml")
        || relative == Path::new("Cargo.toml")
        || relative.starts_with("src")
        || relative.starts_with("msg")
        || relative.extension() == Some(OsStr::new("py"))
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::time::Duration;

    use super::*;
    use crate::scratch::Scratch;

    /// A lambda's folder with these files, each of a second more than the one before.
    fn lambda(files: &[&str]) -> Scratch {
        let dir = Scratch::new();
        for (age, file) in files.iter().enumerate() {
            dir.write(file, "");
            let time = SystemTime::UNIX_EPOCH + Duration::from_secs(1000 + age as u64);
            File::options().write(true).open(dir.path(file)).unwrap().set_modified(time).unwrap();
        }
        dir
    }

    #[test]
    fn a_build_newer_than_every_source_is_used() {
        let dir = lambda(&["lambda.toml", "Cargo.toml", "src/lib.rs", "msg/a/msg/B.msg", "build/lambda.toml"]);
        let build = BuildDir::check_fresh(dir.root()).unwrap();
        assert_eq!(build.path(), dir.path("build"));
        assert_eq!(build.manifest_path(), dir.path("build/lambda.toml"));
        assert_eq!(build.messages_path(), dir.path("build/msg"));
    }

    #[test]
    fn the_entry_lies_in_the_build_folder() {
        let text =
            "lambda = { name = 'x', version = '0.1.0', kind = 'python', entry = 'main.py' }\nschedule.period = '1s'";
        let manifest = Manifest::parse(text, "lambda.toml").unwrap();
        assert_eq!(BuildDir::of("x").entry_path(&manifest), Path::new("x/build/main.py"));
    }

    #[test]
    fn a_lambda_without_a_build_is_refused() {
        let dir = lambda(&["lambda.toml"]);
        let error = BuildDir::check_fresh(dir.root()).unwrap_err();
        assert_eq!(error.to_string(), format!("lambda `{}` is not built", dir.root().display()));
        assert_eq!(error.help(), Some(format!("run `gleaner build {}`", dir.root().display())));
        assert_eq!(error.exit(), Exit::Usage);
    }

    #[test]
    fn a_build_older_than_a_source_is_refused_and_names_the_newest() {
        for source in ["lambda.toml", "Cargo.toml", "src/build/b.rs", "msg/a/msg/B.msg", "main.py", "package/part.py"] {
            let dir = lambda(&["other.py", "build/lambda.toml", "old/middle.py", source]);
            let error = BuildDir::check_fresh(dir.root()).unwrap_err();
            let shown = dir.root().display();
            assert_eq!(error.to_string(), format!("the build of lambda `{shown}` is older than its source `{source}`"));
            assert_eq!(error.help(), Some(format!("run `gleaner build {shown}`")));
        }
    }

    #[test]
    fn what_is_no_source_may_be_newer() {
        let dir = lambda(&[
            "lambda.toml",
            "build/lambda.toml",
            "build/main.py",
            "target/x.py",
            ".venv/x.py",
            "__pycache__/x.py",
            "package/__pycache__/x.py",
            "README.md",
        ]);
        assert!(BuildDir::check_fresh(dir.root()).is_ok());
    }

    #[cfg(unix)]
    #[test]
    fn a_link_back_into_the_folder_makes_no_circle() {
        let dir = lambda(&["lambda.toml", "src/lib.rs", "build/lambda.toml"]);
        std::os::unix::fs::symlink(dir.root(), dir.path("again")).unwrap();
        assert!(BuildDir::check_fresh(dir.root()).is_ok());
    }
}
