//! The build folder of a lambda, `DIR/build/`: `gleaner build DIR` creates it, and every other
//! command uses it.
//!
//! It is complete: manifest, entry, models, and the message definitions in `msg/`, for transports
//! that do not provide them. Nothing here builds, and no reader of a build folder writes into it.
//! The files are untrusted: all are checked before one of them is used.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use crate::{Manifest, ManifestError, Sources};
use gleaner_base::text::shell_word;
use gleaner_base::{ByteSize, Exit, Explain, NotPlain, PlainFile};

/// Longest file of a build. No model is longer: ONNX is protobuf, whose messages end at 2 GiB.
pub const FILE_MAX: ByteSize = ByteSize::gib(2);

/// Maximum length of all files of a build together.
pub const BUILD_MAX: ByteSize = ByteSize::gib(4);

/// Maximum number of files of a build, far more than any has. With names of 255 bytes they fit into
/// the header of a journal.
pub const FILES_MAX: usize = 4_000;

pub const COMPONENT_MAX: ByteSize = ByteSize::mib(64);

/// `DIR/build/` of one lambda.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BuildDir {
    path: PathBuf,
}

impl BuildDir {
    /// Returns the build folder of the lambda in `lambda_dir`, whether it exists or not.
    pub fn of(lambda_dir: impl AsRef<Path>) -> BuildDir {
        BuildDir { path: lambda_dir.as_ref().join("build") }
    }

    /// Returns the build folder of the lambda in `lambda_dir`, if it exists and no source is newer.
    ///
    /// The age of a build is that of its `lambda.toml`, which the build writes last. [`Sources`]
    /// lists its sources; one that was removed since does not count.
    ///
    /// # Errors
    ///
    /// [`LayoutError::NoFolder`], [`LayoutError::File`], [`LayoutError::NoManifest`] or
    /// [`LayoutError::IsBuild`] if `lambda_dir` is not a lambda's folder, [`LayoutError::Missing`],
    /// [`LayoutError::Older`], [`LayoutError::Manifest`] if the build's manifest is refused, or
    /// [`LayoutError::Read`], [`LayoutError::TooMany`] and [`LayoutError::TooLarge`] as for
    /// [`files`](Self::files).
    pub fn check_fresh(lambda_dir: impl AsRef<Path>) -> Result<BuildDir, LayoutError> {
        let dir = lambda_dir.as_ref();
        let build = BuildDir::of(dir);
        let built = match modified(&build.manifest_path()) {
            Ok(time) => time,
            Err(error)
                if matches!(
                    error.kind(),
                    io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
                ) =>
            {
                return Err(missing(dir));
            }
            Err(source) => {
                return Err(LayoutError::Read { path: build.manifest_path(), source });
            }
        };
        // This refuses links, whose age would be that of another file.
        let text = Manifest::read(build.path())?;
        // A file that an editor removed meanwhile does not count.
        let age = |source: &Path| modified(&dir.join(source)).ok().filter(|age| *age > built);
        let older = |source: &Path| LayoutError::Older {
            dir: dir.to_owned(),
            source_file: source.to_owned(),
        };
        // Checked before the build's manifest is parsed: a newer manifest may name other sources,
        // and the old one need not be valid for this Gleaner.
        let manifest = Path::new("lambda.toml");
        if age(manifest).is_some() {
            return Err(older(manifest));
        }
        let sources = Sources::of(dir, &Manifest::parse(&text, build.manifest_path())?)?;
        match sources.iter().filter_map(|source| age(source).map(|age| (age, source))).max() {
            Some((_, source)) => Err(older(source)),
            // Checks the files: a pipe would block the interpreter, and the digest of an endless
            // file would not end.
            None => build.files().map(|_| build),
        }
    }

    /// Returns the paths of its files, relative and sorted. All of them are regular files in the
    /// folder, wherever links lead, within the maximum number and length.
    ///
    /// # Errors
    ///
    /// [`LayoutError::Read`] if a folder cannot be listed or an entry is not such a file,
    /// [`LayoutError::TooMany`], [`LayoutError::TooLarge`].
    pub fn files(&self) -> Result<Vec<PathBuf>, LayoutError> {
        let (mut files, mut bytes, mut folders) = (Vec::new(), 0_u64, vec![PathBuf::new()]);
        while let Some(folder) = folders.pop() {
            let failed = |source| LayoutError::Read { path: self.path.join(&folder), source };
            for entry in fs::read_dir(self.path.join(&folder)).map_err(failed)? {
                let entry = entry.map_err(failed)?;
                let path = folder.join(entry.file_name());
                if entry.file_type().map_err(failed)?.is_dir() {
                    folders.push(path);
                    continue;
                }
                let file = PlainFile::inside(&self.path, &path, FILE_MAX)
                    .map_err(|source| LayoutError::Read { path: entry.path(), source })?;
                bytes = bytes.saturating_add(file.length());
                files.push(path);
                if files.len() > FILES_MAX {
                    return Err(LayoutError::TooMany { build: self.path.clone() });
                }
                if bytes > BUILD_MAX.bytes() {
                    return Err(LayoutError::TooLarge { build: self.path.clone() });
                }
            }
        }
        files.sort();
        Ok(files)
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn manifest_path(&self) -> PathBuf {
        self.path.join("lambda.toml")
    }

    /// Returns the path of the file that `lambda.entry` of its manifest names.
    pub fn entry_path(&self, manifest: &Manifest) -> PathBuf {
        self.path.join(manifest.lambda.entry.as_path())
    }
}

/// The reason why a build folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum LayoutError {
    #[error("there is no folder `{}`", dir.display())]
    NoFolder { dir: PathBuf },
    #[error("`{}` is not a folder", path.display())]
    File { path: PathBuf },
    #[error("`{}` is the build folder of a lambda", build.display())]
    IsBuild { build: PathBuf, dir: PathBuf },
    #[error("folder `{}` has no lambda.toml", dir.display())]
    NoManifest { dir: PathBuf },
    #[error("lambda `{}` is not built", dir.display())]
    Missing { dir: PathBuf },
    #[error(
        "the build of lambda `{}` is older than its source `{}`",
        dir.display(),
        source_file.display()
    )]
    Older {
        dir: PathBuf,
        /// The manifest, or else the newest source, relative to it.
        source_file: PathBuf,
    },
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    #[error("`{}` holds more than {FILES_MAX} files", build.display())]
    TooMany { build: PathBuf },
    #[error("the files in `{}` have more than {BUILD_MAX}", build.display())]
    TooLarge { build: PathBuf },
    #[error("cannot read `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
}

const FOLDER_FIRST: &str = "name the lambda's folder, which has a lambda.toml; \
                            `replay` and `dev` take it before the drives";

impl Explain for LayoutError {
    fn help(&self) -> Option<String> {
        match self {
            LayoutError::NoFolder { .. } | LayoutError::File { .. } => {
                Some(FOLDER_FIRST.to_owned())
            }
            LayoutError::NoManifest { .. } => Some(
                "name the lambda's folder; `gleaner new DIR` makes one with a lambda".to_owned(),
            ),
            LayoutError::IsBuild { dir, .. } => Some(format!("did you mean `{}`?", dir.display())),
            LayoutError::Missing { dir } | LayoutError::Older { dir, .. } => {
                Some(format!("run `gleaner build {}`", shell_word(dir)))
            }
            LayoutError::Manifest(error) => error.help(),
            LayoutError::TooMany { .. } | LayoutError::TooLarge { .. } => {
                Some("remove foreign files from the lambda's folder, and build it again".to_owned())
            }
            LayoutError::Read { source, .. } => NotPlain::of(source).map(NotPlain::help),
        }
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

/// Returns the reason why `dir` has no build.
fn missing(dir: &Path) -> LayoutError {
    if dir.is_file() {
        return LayoutError::File { path: dir.to_owned() };
    }
    if !dir.is_dir() {
        return LayoutError::NoFolder { dir: dir.to_owned() };
    }
    let named_build = dir.file_name().is_some_and(|name| name == "build");
    if let Some(parent) = dir.parent().filter(|_| named_build) {
        let parent = if parent.as_os_str().is_empty() { Path::new(".") } else { parent };
        if [dir, parent].iter().all(|folder| folder.join("lambda.toml").is_file()) {
            return LayoutError::IsBuild { build: dir.to_owned(), dir: parent.to_owned() };
        }
    }
    if !dir.join("lambda.toml").exists() {
        return LayoutError::NoManifest { dir: dir.to_owned() };
    }
    LayoutError::Missing { dir: dir.to_owned() }
}

fn modified(file: &Path) -> io::Result<SystemTime> {
    fs::metadata(file).and_then(|data| data.modified())
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::time::Duration;

    use super::*;
    use gleaner_test_support::TestFolder;

    /// Creates a lambda's folder with these files, each a second newer than the one before.
    fn lambda(kind: &str, files: &[&str]) -> TestFolder {
        let entry = if kind == "python" { "main.py" } else { "x.wasm" };
        let manifest = format!(
            "lambda = {{ name = 'x', version = '0.1.0', kind = '{kind}', entry = '{entry}' }}\n\
             schedule.period = '1s'\n\
             [[model]]\nname = 'm'\nfile = 'models/m.onnx'\nsha256 = '{}'\n",
            "0".repeat(64)
        );
        let dir = TestFolder::new();
        for (age, file) in files.iter().enumerate() {
            dir.write(file, if file.ends_with("lambda.toml") { &manifest } else { "" });
            let time = SystemTime::UNIX_EPOCH + Duration::from_secs(1000 + age as u64);
            File::options().write(true).open(dir.path(file)).unwrap().set_modified(time).unwrap();
        }
        dir
    }

    #[track_caller]
    fn is_older_than(dir: &TestFolder, source: &str) {
        let error = BuildDir::check_fresh(dir.root()).unwrap_err();
        let shown = dir.root().display();
        assert_eq!(
            error.to_string(),
            format!("the build of lambda `{shown}` is older than its source `{source}`")
        );
        assert_eq!(error.help(), Some(format!("run `gleaner build {shown}`")));
    }

    #[test]
    fn a_build_newer_than_every_source_is_used() {
        let dir = lambda(
            "wasm",
            &["lambda.toml", "Cargo.toml", "src/lib.rs", "msg/a/msg/B.msg", "build/lambda.toml"],
        );
        let build = BuildDir::check_fresh(dir.root()).unwrap();
        assert_eq!(build.path(), dir.path("build"));
        assert_eq!(build.manifest_path(), dir.path("build/lambda.toml"));
    }

    #[test]
    fn a_lambda_without_a_build_is_refused() {
        let dir = lambda("wasm", &["lambda.toml"]);
        let error = BuildDir::check_fresh(dir.root()).unwrap_err();
        assert_eq!(error.to_string(), format!("lambda `{}` is not built", dir.root().display()));
        assert_eq!(error.help(), Some(format!("run `gleaner build {}`", dir.root().display())));
        assert_eq!(error.exit(), Exit::Usage);
        let empty = TestFolder::new();
        let error = BuildDir::check_fresh(empty.root()).unwrap_err();
        let message = format!("folder `{}` has no lambda.toml", empty.root().display());
        assert_eq!(error.to_string(), message);
    }

    #[test]
    fn a_folder_that_is_not_a_lambdas_is_distinguished_from_one_that_is_not_built() {
        let dir = lambda("wasm", &["lambda.toml", "build/lambda.toml"]);
        let root = dir.root().display();
        let folder_first = FOLDER_FIRST.to_owned();
        for (name, message, help) in [
            ("nowhere", format!("there is no folder `{root}/nowhere`"), folder_first.clone()),
            ("lambda.toml", format!("`{root}/lambda.toml` is not a folder"), folder_first),
            (
                "build",
                format!("`{root}/build` is the build folder of a lambda"),
                format!("did you mean `{root}`?"),
            ),
        ] {
            let error = BuildDir::check_fresh(dir.path(name)).unwrap_err();
            assert_eq!((error.to_string(), error.help()), (message, Some(help)));
            assert_eq!(error.exit(), Exit::Usage);
        }
    }

    #[test]
    fn a_folder_with_a_space_is_quoted_in_the_suggested_command() {
        let help = LayoutError::Missing { dir: "my lambda".into() }.help();
        assert_eq!(help.as_deref(), Some("run `gleaner build 'my lambda'`"));
    }

    #[test]
    fn a_build_older_than_a_source_is_refused_and_names_the_newest() {
        for source in [
            "lambda.toml",
            "Cargo.toml",
            "build.rs",
            "src/a/b.rs",
            "msg/a/msg/B.msg",
            "models/m.onnx",
        ] {
            is_older_than(&lambda("wasm", &["build/lambda.toml", "src/lib.rs", source]), source);
        }
        for source in
            ["lambda.toml", "main.py", "package/part.py", "msg/a/msg/B.msg", "models/m.onnx"]
        {
            is_older_than(&lambda("python", &["build/lambda.toml", "other.py", source]), source);
        }
    }

    #[test]
    fn files_that_are_not_sources_may_be_newer() {
        for file in [
            "README.md",
            "tests/test_main.py",
            "out/x.py",
            ".venv/x.py",
            "build/main.py",
            "Cargo.toml",
        ] {
            let dir = lambda("python", &["lambda.toml", "main.py", "build/lambda.toml", file]);
            assert!(BuildDir::check_fresh(dir.root()).is_ok(), "{file}");
        }
        for file in ["README.md", "tests/all.rs", "plot.py", "target/x.rs", "Cargo.lock"] {
            let dir = lambda("wasm", &["lambda.toml", "src/lib.rs", "build/lambda.toml", file]);
            assert!(BuildDir::check_fresh(dir.root()).is_ok(), "{file}");
        }
    }

    #[test]
    fn a_build_may_not_have_links_outside_or_too_many_or_too_long_files() {
        let dir = lambda(
            "python",
            &["lambda.toml", "build/main.py", "build/msg/a/msg/B.msg", "build/lambda.toml"],
        );
        let refused = |message: &str| {
            let error = BuildDir::check_fresh(dir.root()).unwrap_err();
            assert_eq!(error.exit(), Exit::Usage);
            let text = gleaner_base::Failure::from(error).to_string();
            assert!(text.contains(message) && text.contains("help:"), "{text}");
        };
        let build = BuildDir::check_fresh(dir.root()).unwrap();
        assert_eq!(
            build.files().unwrap(),
            ["lambda.toml", "main.py", "msg/a/msg/B.msg"].map(PathBuf::from)
        );

        let outside = dir.write("secret", "secret");
        std::os::unix::fs::symlink(&outside, dir.path("build/x")).unwrap();
        refused(&format!("build/x`\n  cause: it is a link to `{}`, outside of", outside.display()));
        fs::remove_file(dir.path("build/x")).unwrap();

        let sparse = |name: &str, length: u64| {
            dir.write(name, "");
            File::options().write(true).open(dir.path(name)).unwrap().set_len(length).unwrap();
        };
        sparse("build/x", 1 << 40);
        refused("build/x`\n  cause: it has 1099511627776 bytes; at most 2 GiB are read");
        for name in ["build/x", "build/y", "build/z"] {
            sparse(name, FILE_MAX.bytes());
        }
        refused("have more than 4 GiB");
        for name in ["build/x", "build/y", "build/z"] {
            fs::remove_file(dir.path(name)).unwrap();
        }

        for number in 3..=FILES_MAX {
            dir.write(&format!("build/many/{number}"), "");
        }
        refused("holds more than 4000 files");
    }

    #[test]
    fn an_outdated_build_may_have_an_invalid_manifest_but_a_fresh_one_may_not() {
        let dir = lambda("wasm", &["lambda.toml", "build/lambda.toml"]);
        dir.write("build/lambda.toml", "colour = 1");
        let error = BuildDir::check_fresh(dir.root()).unwrap_err();
        assert!(matches!(error, LayoutError::Manifest(_)), "{error}");
        assert!(error.help().is_some());
        let later = SystemTime::now() + Duration::from_secs(60);
        File::options()
            .write(true)
            .open(dir.path("lambda.toml"))
            .unwrap()
            .set_modified(later)
            .unwrap();
        is_older_than(&dir, "lambda.toml");
    }
}
