//! Finds the sources of a build: the files to copy and the files to compile.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::manifest::LambdaKind;
use crate::{LayoutError, Manifest};
use gleaner_base::{ByteSize, NotPlain};

/// Folders beside the manifest without Python code of the lambda: output of tools, and its tests.
const SKIPPED_FOLDERS: [&str; 4] = ["build", "out", "target", "tests"];

/// Beginnings and ends of the names of files that are not data of a lambda: those of tools, texts
/// for its authors, keys, drives and journals.
const NO_DATA: &str = "LICENSE README lambda.toml pyproject.toml requirements revision.json \
                       .db3 .ipynb .journal .lock .log .mcap .md .pem .rst";

/// Longest Python file or message definition of a build. The longest of the standard library has
/// 700 KiB.
pub const SOURCE_MAX: ByteSize = ByteSize::mib(16);

/// The packages of a Python lambda, with a hash of each wheel. The file is optional.
pub const REQUIREMENTS: &str = "requirements.txt";

/// The sources of a build besides `lambda.toml`: used to build, and to check whether a build is up
/// to date.
///
/// Paths are relative to the lambda's folder. Files that the manifest names are listed whether they
/// exist or not; the others are found in the folder. Hidden files and folders, `__pycache__/` and
/// virtual environments (folders with a `pyvenv.cfg`) are skipped, and links to folders are not
/// followed, as they may lead in circles.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sources {
    /// Files copied into the build under the same name: models, message definitions
    /// (`msg/**/*.msg`), and of a Python lambda its entry, its data `files` and every `.py` file
    /// that is not in `build/`, `out/`, `target/` or `tests/` beside the manifest.
    pub copied: BTreeSet<PathBuf>,
    /// Files that a build reads but does not copy. Of a Rust lambda, those that are compiled into
    /// the entry: `Cargo.toml`, `build.rs`, and all in `src/`. Of a Python lambda,
    /// [`REQUIREMENTS`], which locks its wheels.
    pub compiled: BTreeSet<PathBuf>,
}

impl Sources {
    /// Finds the sources of the lambda in `lambda_dir`, whose manifest is `manifest`.
    ///
    /// # Errors
    ///
    /// [`LayoutError::Read`] if a folder cannot be listed, or is a link that leads out of the
    /// lambda's folder.
    pub fn of(lambda_dir: impl AsRef<Path>, manifest: &Manifest) -> Result<Sources, LayoutError> {
        let dir = lambda_dir.as_ref();
        let models = manifest.models.iter();
        let named = models.flat_map(|model| std::iter::once(&model.file).chain(&model.labels));
        let copied = named.map(|file| file.as_path().to_owned()).collect();
        let mut sources = Sources { copied, compiled: BTreeSet::new() };
        let is_file = |file: &Path| dir.join(file).is_file();
        let is_message = |file: &Path| has_extension(file, "msg") && is_file(file);
        sources.copied.extend(files(dir, "msg", |_| true, is_message)?);
        for data in &manifest.lambda.files {
            if dir.join(data.as_path()).is_dir() {
                // A link to a folder, or a pipe, is listed too: the build refuses it by name.
                sources.copied.extend(files(dir, data.as_str(), |_| true, |_| true)?);
            } else {
                sources.copied.insert(data.as_path().to_owned());
            }
        }
        match manifest.lambda.kind {
            LambdaKind::Python => {
                sources.compiled.insert(REQUIREMENTS.into());
                sources.copied.insert(manifest.lambda.entry.as_path().to_owned());
                let is_code = |file: &Path| has_extension(file, "py") && is_file(file);
                let enters = |at: &Path| !SKIPPED_FOLDERS.iter().any(|it| at == Path::new(it));
                sources.copied.extend(files(dir, "", enters, is_code)?);
            }
            LambdaKind::Wasm => {
                sources.compiled.extend(["Cargo.toml", "build.rs"].map(PathBuf::from));
                sources.compiled.extend(files(dir, "src", |_| true, is_file)?);
            }
        }
        Ok(sources)
    }

    /// Returns the files in the folder of a Python lambda that its build leaves out, sorted, except
    /// for those that are no data: of tools, for readers, keys, drives and results.
    ///
    /// # Errors
    ///
    /// As for [`of`](Self::of).
    pub fn left_out(&self, lambda_dir: impl AsRef<Path>) -> Result<Vec<PathBuf>, LayoutError> {
        let enters = |at: &Path| {
            let is_other = SKIPPED_FOLDERS.iter().chain(&["live"]).any(|it| at == Path::new(it));
            !is_other && !has_extension(at, "egg-info")
        };
        let is_data = |file: &Path| {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            !self.copied.contains(file)
                && !NO_DATA.split(' ').any(|part| name.starts_with(part) || name.ends_with(part))
        };
        let mut found = files(lambda_dir.as_ref(), "", enters, is_data)?;
        found.sort();
        Ok(found)
    }

    pub fn iter(&self) -> impl Iterator<Item = &Path> {
        self.copied.iter().chain(&self.compiled).map(PathBuf::as_path)
    }
}

/// Lists the files that `takes` accepts, in the folder `start` of `dir`, which need not exist, and
/// in the folders below it that `enters` accepts.
fn files(
    dir: &Path,
    start: &str,
    enters: impl Fn(&Path) -> bool,
    takes: impl Fn(&Path) -> bool,
) -> Result<Vec<PathBuf>, LayoutError> {
    lies_in(dir, start)?;
    let mut found = Vec::new();
    let mut folders = vec![PathBuf::from(start)];
    while let Some(folder) = folders.pop() {
        let path = dir.join(&folder);
        let failed = |source| LayoutError::Read { path: path.clone(), source };
        let entries = match fs::read_dir(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            entries => entries.map_err(failed)?,
        };
        for entry in entries {
            let entry = entry.map_err(failed)?;
            let (name, relative) = (entry.file_name(), folder.join(entry.file_name()));
            if name.as_encoded_bytes().starts_with(b".") || name == "__pycache__" {
                continue;
            }
            // The type of the entry itself, not of the target of a link.
            if entry.file_type().map_err(failed)?.is_dir() {
                if enters(&relative) && !entry.path().join("pyvenv.cfg").is_file() {
                    folders.push(relative);
                }
            } else if takes(&relative) {
                found.push(relative);
            }
        }
    }
    Ok(found)
}

/// Refuses the folder `start` of `dir` if it is a link that leads out of `dir`, to any folder of
/// the machine.
fn lies_in(dir: &Path, start: &str) -> Result<(), LayoutError> {
    let path = dir.join(start);
    let (Ok(target), Ok(folder)) = (path.canonicalize(), dir.canonicalize()) else { return Ok(()) };
    if target.starts_with(&folder) {
        return Ok(());
    }
    Err(LayoutError::Read { path, source: io::Error::other(NotPlain::Outside { target, folder }) })
}

fn has_extension(file: &Path, wanted: &str) -> bool {
    file.extension().is_some_and(|extension| extension == wanted)
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    fn sources(dir: &TestFolder, kind: &str, entry: &str) -> [Vec<String>; 2] {
        let manifest = format!(
            "lambda = {{ name = 'x', version = '0.1.0', kind = '{kind}', entry = '{entry}' }}\n\
             schedule.period = '1s'\n\
             [[model]]\nname = 'm'\nfile = 'models/m.onnx'\nsha256 = '{}'\n",
            "0".repeat(64)
        );
        let manifest = Manifest::parse(&manifest, "lambda.toml").unwrap();
        let Sources { copied, compiled } = Sources::of(dir.root(), &manifest).unwrap();
        [copied, compiled]
            .map(|files| files.iter().map(|file| file.display().to_string()).collect())
    }

    /// Creates a folder that could belong to a lambda of either kind.
    fn folder() -> TestFolder {
        let dir = TestFolder::new();
        for file in [
            ".hidden.py",
            ".venv/lib/y.py",
            "Cargo.toml",
            "README.md",
            "build/lambda.toml",
            "build/main.py",
            "msg/README.md",
            "msg/a/msg/B.msg",
            "other.py",
            "out/x.py",
            "part/__pycache__/z.py",
            "part/build/deep.py",
            "src/.lib.rs.swp",
            "src/data.bin",
            "src/inner/mod.rs",
            "target/t.py",
            "tests/test.py",
            "venv/lib/python3.11/site-packages/y.py",
            "venv/pyvenv.cfg",
        ] {
            dir.write(file, "");
        }
        dir
    }

    #[test]
    fn python_files_are_copied_except_tests_and_output_of_tools() {
        let [copied, compiled] = sources(&folder(), "python", "main.py");
        assert_eq!(
            copied,
            ["main.py", "models/m.onnx", "msg/a/msg/B.msg", "other.py", "part/build/deep.py"]
        );
        assert_eq!(compiled, ["requirements.txt"]);
    }

    #[test]
    fn data_files_are_copied_if_the_manifest_names_them_and_else_left_out() {
        let dir = folder();
        for file in ["a.json", "calib/.b", "calib/deep/c", "calib/d.csv", "live/log", "x.pem"] {
            dir.write(file, "");
        }
        let manifest = "lambda = { name = 'x', version = '0.1.0', kind = 'python', \
                        entry = 'main.py', files = ['calib', 'gone'] }\nschedule.period = '1s'\n";
        let manifest = Manifest::parse(manifest, "lambda.toml").unwrap();
        let sources = Sources::of(dir.root(), &manifest).unwrap();
        let code = ["main.py", "msg/a/msg/B.msg", "other.py", "part/build/deep.py"];
        let data = ["calib/d.csv", "calib/deep/c", "gone"];
        let expected = code.iter().chain(&data).map(PathBuf::from).collect::<BTreeSet<_>>();
        assert_eq!(sources.copied, expected);
        let left_out = ["Cargo.toml", "a.json", "src/data.bin", "src/inner/mod.rs"];
        assert_eq!(sources.left_out(dir.root()).unwrap(), left_out.map(PathBuf::from));
    }

    #[test]
    fn an_entry_is_a_source_in_any_folder() {
        let [copied, _] = sources(&folder(), "python", "tests/test.py");
        assert!(copied.contains(&"tests/test.py".to_owned()), "{copied:?}");
    }

    #[test]
    fn rust_is_compiled_with_its_build_script_and_all_files_in_src() {
        let [copied, compiled] = sources(&folder(), "wasm", "x.wasm");
        assert_eq!(copied, ["models/m.onnx", "msg/a/msg/B.msg"]);
        assert_eq!(compiled, ["Cargo.toml", "build.rs", "src/data.bin", "src/inner/mod.rs"]);
    }

    #[test]
    fn a_source_folder_that_links_elsewhere_is_refused_by_name() {
        let (dir, elsewhere) = (TestFolder::new(), folder());
        for (name, kind) in [("msg", "python"), ("src", "wasm")] {
            std::os::unix::fs::symlink(elsewhere.root(), dir.path(name)).unwrap();
            let manifest = format!(
                "lambda = {{ name = 'x', version = '0.1.0', kind = '{kind}', entry = 'x' }}\n\
                 schedule.period = '1s'\n"
            );
            let manifest = Manifest::parse(&manifest, "lambda.toml").unwrap();
            let error = Sources::of(dir.root(), &manifest).unwrap_err();
            let error = gleaner_base::Failure::from(error).to_string();
            assert!(
                error.contains(&format!(
                    "{name}`\n  cause: it is a link to `{}`",
                    elsewhere.root().display()
                )),
                "{error}"
            );
            std::fs::remove_file(dir.path(name)).unwrap();
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_link_back_to_the_folder_does_not_loop() {
        let dir = folder();
        std::os::unix::fs::symlink(dir.root(), dir.path("again")).unwrap();
        std::os::unix::fs::symlink(dir.root(), dir.path("src/again")).unwrap();
        assert_eq!(sources(&dir, "python", "main.py"), sources(&folder(), "python", "main.py"));
        assert_eq!(sources(&dir, "wasm", "x.wasm"), sources(&folder(), "wasm", "x.wasm"));
    }
}
