//! A virtual environment of the wheels of a revision, beside its build.
//!
//! It is never trusted: before each start, its files are compared with the wheels, whose digests
//! the revision has. What differs in any way is made again. So it needs no list of its own, and
//! nothing has to be durable: a power cut leaves an environment that differs.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::{OpenOptionsExt, symlink};
use std::path::{Path, PathBuf};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{PlainFile, is_shortage};
use gleaner_lambda::BuildDir;
use gleaner_lambda::layout::FILE_MAX;
use sha2::{Digest, Sha256};

use crate::wheels::archive::{
    FILES_MAX, FileDigest, UNPACKED_MAX, WheelArchive, WheelFile, merged,
};
use crate::wheels::{Interpreter, WheelError, WheelName, wheels_of};

/// Name of the environment in the folder of a revision.
const ENVIRONMENT: &str = "environment";

const PYTHON: &str = "bin/python3";
/// The file that makes a folder an environment.
const CONFIG: &str = "pyvenv.cfg";

/// An environment that is as the wheels of its revision.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PreparedPython {
    pub python: PathBuf,
    /// The reason why it was made now; `None` if it was there.
    pub made: Option<String>,
}

/// Makes the environment of the revision in `folder`, unless it is there and as it should be. The
/// caller has compared the files of the revision with its signature. Returns `None` for a revision
/// without wheels.
///
/// # Errors
///
/// [`WheelError`]: a wheel that does not fit this machine's interpreter, or is refused.
pub fn prepare(folder: &Path) -> Result<Option<PreparedPython>, WheelError> {
    let build = BuildDir::of(folder);
    let wheels = wheels_of(&build)?;
    if wheels.is_empty() {
        return Ok(None);
    }
    let python = InstalledPrograms::find()?.python(None)?;
    let interpreter = Interpreter::probe(&python)?;
    let wheels: Vec<_> = wheels.iter().map(|path| build.path().join(path)).collect();
    prepare_for(&interpreter, &wheels, folder).map(Some)
}

fn prepare_for(
    interpreter: &Interpreter,
    wheels: &[PathBuf],
    folder: &Path,
) -> Result<PreparedPython, WheelError> {
    let wanted = WantedFiles::of(interpreter, wheels)?;
    let path = folder.join(ENVIRONMENT);
    // Another process may prepare it, too: the orchestrator for a deployment, or the supervisor.
    let _lock = File::open(folder)
        .and_then(|folder| folder.lock().map(|()| folder))
        .map_err(failed("lock", folder))?;
    let made = wanted.difference(&path).map_err(failed("read", &path))?;
    if made.is_some() {
        wanted.make(&path)?;
    }
    Ok(PreparedPython { python: path.join(PYTHON), made })
}

struct WantedFiles {
    /// The paths of the wheels, with the files that they have. One is open at a time: a lambda may
    /// have more wheels than a process may have open files.
    wheels: Vec<(PathBuf, Vec<WheelFile>)>,
    packages: PathBuf,
    /// Paths in the environment, with the number of the wheel.
    files: BTreeMap<PathBuf, (FileDigest, usize)>,
    folders: BTreeSet<PathBuf>,
    config: String,
    /// The target of the interpreter, which is a link.
    program: PathBuf,
}

impl WantedFiles {
    fn of(interpreter: &Interpreter, paths: &[PathBuf]) -> Result<Self, WheelError> {
        let packages = interpreter.packages();
        let (mut wheels, mut names) = (Vec::new(), Vec::new());
        let (mut count, mut bytes) = (0, 0);
        for path in paths {
            let wheel = WheelArchive::open(path)?;
            wheel.name.check_fits(interpreter)?;
            count += wheel.files.len();
            bytes += wheel.files.iter().map(|file| file.digest.bytes).sum::<u64>();
            if count > FILES_MAX || bytes > UNPACKED_MAX.bytes() {
                return Err(wheel.too_much());
            }
            names.push(wheel.name);
            wheels.push((path.clone(), wheel.files));
        }
        let files = wheels.iter().map(|(_, files)| &**files);
        let files = merged(names.iter().map(WheelName::as_str).zip(files))?;
        let files = files.into_iter().map(|(path, file)| (packages.join(path), file));
        let files: BTreeMap<_, _> = files.collect();
        let (major, minor) = interpreter.version;
        let home = interpreter.program.parent().unwrap_or(Path::new("/")).display();
        let config = format!(
            "home = {home}\ninclude-system-site-packages = false\nversion = {major}.{minor}\n"
        );
        let paths = files.keys().map(PathBuf::as_path).chain([Path::new(PYTHON), &packages]);
        let folders = paths.flat_map(|path| path.ancestors().skip(1)).map(Path::to_owned);
        let mut folders: BTreeSet<_> = folders.collect();
        folders.insert(packages.clone());
        let program = interpreter.program.clone();
        Ok(Self { wheels, packages, files, folders, config, program })
    }

    fn difference(&self, root: &Path) -> io::Result<Option<String>> {
        let found = match root.symlink_metadata() {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return Ok(Some("there was none".to_owned()));
            }
            found => found?,
        };
        if !found.is_dir() {
            return Ok(Some("it is not a directory".to_owned()));
        }
        let sha256 = Sha256::digest(&self.config).into();
        let config = FileDigest { bytes: self.config.len() as u64, sha256 };
        let (mut found, mut folders) = (0, vec![PathBuf::new()]);
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(root.join(&folder))? {
                let entry = entry?;
                let (kind, path) = (entry.file_type()?, folder.join(entry.file_name()));
                let wanted = match self.files.get(&path) {
                    Some((digest, ..)) => Some(*digest),
                    None => (path == Path::new(CONFIG)).then_some(config),
                };
                let is_wanted = if kind.is_dir() {
                    folders.push(path.clone());
                    self.folders.contains(&path)
                } else if kind.is_symlink() {
                    found += 1;
                    path == Path::new(PYTHON) && fs::read_link(entry.path())? == self.program
                } else {
                    found += 1;
                    match wanted {
                        Some(wanted) => is_file(&entry.path(), wanted)?,
                        None => false,
                    }
                };
                if !is_wanted {
                    return Ok(Some(format!("`{}` was changed", path.display())));
                }
            }
        }
        // Each of those that were found is wanted, and there are the link and the configuration.
        let is_complete = found == self.files.len() + 2;
        Ok((!is_complete).then(|| "files were missing".to_owned()))
    }

    /// Makes the environment `path`, in place of what is there. A process that still runs with that
    /// keeps its open files.
    fn make(&self, path: &Path) -> Result<(), WheelError> {
        let [unfinished, old] = ["tmp", "old"].map(|it| path.with_extension(it));
        let remake = || {
            remove(&unfinished).map_err(failed("remove", &unfinished))?;
            remove(&old).map_err(failed("remove", &old))
        };
        remake()?;
        let filled = self.fill(&unfinished);
        if filled.is_err() {
            // The first error matters more.
            let _ = remove(&unfinished);
            return filled;
        }
        match fs::rename(path, &old) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(failed("replace", path)(error));
            }
            _ => {}
        }
        fs::rename(&unfinished, path).map_err(failed("write", path))?;
        remake()
    }

    fn fill(&self, root: &Path) -> Result<(), WheelError> {
        let folder = |path: &Path| fs::create_dir_all(path).map_err(failed("create", path));
        folder(root)?;
        self.folders.iter().try_for_each(|path| folder(&root.join(path)))?;
        for (wheel, (path, files)) in self.wheels.iter().enumerate() {
            let mut archive = WheelArchive::open(path)?;
            if archive.files != *files {
                let source = io::Error::other("it was changed while it was unpacked");
                return Err(WheelError::Read { path: path.clone(), source });
            }
            for (number, file) in files.iter().enumerate() {
                let path = self.packages.join(&file.path);
                // Of a file in several wheels, the last one counts.
                if self.files.get(&path).is_some_and(|(_, last)| *last == wheel) {
                    let path = root.join(path);
                    let mut file = create(&path).map_err(failed("create", &path))?;
                    archive.copy(number, &mut file)?;
                }
            }
        }
        let config = root.join(CONFIG);
        let write = |mut file: File| io::Write::write_all(&mut file, self.config.as_bytes());
        create(&config).and_then(write).map_err(failed("write", &config))?;
        let python = root.join(PYTHON);
        symlink(&self.program, &python).map_err(failed("create", &python))
    }
}

/// Creates a file that its user can only read.
fn create(path: &Path) -> io::Result<File> {
    File::options().write(true).create_new(true).mode(0o400).open(path)
}

/// Returns whether the file `path`, not through a link, has this length and digest. One that cannot
/// be read has not, unless that is a shortage of this machine.
fn is_file(path: &Path, wanted: FileDigest) -> io::Result<bool> {
    let found = PlainFile::result(path, FILE_MAX).and_then(|mut file| {
        if file.length() != wanted.bytes {
            return Ok(false);
        }
        let mut sha256 = Sha256::new();
        io::copy(&mut file, &mut sha256)?;
        Ok(<[u8; 32]>::from(sha256.finalize()) == wanted.sha256)
    });
    found.or_else(|error| if is_shortage(&error) { Err(error) } else { Ok(false) })
}

fn remove(path: &Path) -> io::Result<()> {
    match path.symlink_metadata() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Ok(found) if found.is_dir() => fs::remove_dir_all(path),
        found => found.and_then(|_| fs::remove_file(path)),
    }
}

fn failed(action: &'static str, path: &Path) -> impl Fn(io::Error) -> WheelError + use<> {
    let path = path.to_owned();
    move |source| WheelError::Environment { action, path: path.clone(), source }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;
    use std::process::Command;
    use std::thread;

    use super::*;
    use crate::wheels::made_wheel::MadeWheel;

    /// A folder of a revision with two wheels, and this machine's interpreter.
    struct BuiltEnvironment {
        folder: tempfile::TempDir,
        wheels: Vec<PathBuf>,
        interpreter: Interpreter,
    }

    impl BuiltEnvironment {
        fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let wheels = [
                MadeWheel::new("first").file("first/__init__.py", "NAME = 'first'\n"),
                MadeWheel::new("second")
                    .file("second.py", "import first\nprint(first.NAME, 'second')\n"),
            ];
            let wheels = wheels.map(|it| it.write(folder.path())).to_vec();
            let python = InstalledPrograms::find().unwrap().python(None).unwrap();
            Self { folder, wheels, interpreter: Interpreter::probe(&python).unwrap() }
        }

        fn prepare(&self) -> PreparedPython {
            prepare_for(&self.interpreter, &self.wheels, self.folder.path()).unwrap()
        }

        fn path(&self, name: &str) -> PathBuf {
            self.folder.path().join(ENVIRONMENT).join(name)
        }

        fn package(&self, name: &str) -> PathBuf {
            self.path("").join(self.interpreter.packages()).join(name)
        }
    }

    #[test]
    fn an_environment_has_exactly_its_wheels_and_is_made_once() {
        let made = BuiltEnvironment::new();
        let prepared = made.prepare();
        assert_eq!(prepared.made.as_deref(), Some("there was none"));
        let run = |code: &str| {
            let output = Command::new(&prepared.python).args(["-I", "-B", "-c", code]).output();
            let output = output.unwrap();
            String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
        };
        assert_eq!(run("import second"), "first second\n");
        assert!(run("import numpy").contains("No module named 'numpy'"));
        let version = "import importlib.metadata as it; print(it.distribution('first').name)";
        assert!(!run(version).contains("PackageNotFound"), "{}", run(version));
        assert_eq!(made.prepare(), PreparedPython { made: None, ..prepared });
    }

    #[test]
    fn whatever_differs_is_noticed_and_made_again() {
        let made = BuiltEnvironment::new();
        let code = made.package("second.py");
        let changes: [(&str, &dyn Fn()); 11] = [
            ("second.py", &|| {
                // Of the same length.
                fs::set_permissions(&code, fs::Permissions::from_mode(0o600)).unwrap();
                let text = fs::read_to_string(&code).unwrap().replace("first.NAME", "first.FAKE");
                fs::write(&code, text).unwrap();
            }),
            ("missing", &|| fs::remove_file(&code).unwrap()),
            ("sitecustomize.py", &|| fs::write(made.package("sitecustomize.py"), "").unwrap()),
            ("more.pth", &|| fs::write(made.package("more.pth"), "import os").unwrap()),
            ("__pycache__", &|| {
                let cache = made.package("first/__pycache__");
                fs::create_dir(&cache).unwrap();
                fs::write(cache.join("__init__.cpython-311.pyc"), "").unwrap();
            }),
            ("second.py", &|| {
                fs::rename(&code, made.folder.path().join("elsewhere.py")).unwrap();
                symlink(made.folder.path().join("elsewhere.py"), &code).unwrap();
            }),
            ("first", &|| {
                fs::rename(made.package("first"), made.folder.path().join("moved")).unwrap();
                symlink(made.folder.path().join("moved"), made.package("first")).unwrap();
            }),
            ("bin/python3", &|| {
                fs::remove_file(made.path(PYTHON)).unwrap();
                symlink("/bin/false", made.path(PYTHON)).unwrap();
            }),
            ("bin/python3", &|| {
                fs::remove_file(made.path(PYTHON)).unwrap();
                fs::copy("/bin/false", made.path(PYTHON)).unwrap();
            }),
            ("pyvenv.cfg", &|| {
                fs::remove_file(made.path(CONFIG)).unwrap();
                fs::write(made.path(CONFIG), "home = /tmp\n").unwrap();
            }),
            ("not a directory", &|| {
                fs::rename(made.path(""), made.folder.path().join("all")).unwrap();
                symlink(made.folder.path().join("all"), made.folder.path().join(ENVIRONMENT))
                    .unwrap();
            }),
        ];
        made.prepare();
        for (number, (part, change)) in changes.iter().enumerate() {
            change();
            let reason = made.prepare().made.unwrap_or_default();
            assert!(reason.contains(part), "{number}: {reason}");
            assert_eq!(made.prepare().made, None, "{number}");
        }
        let left: Vec<_> = fs::read_dir(made.folder.path()).unwrap().flatten().collect();
        let has = |name: &str| left.iter().any(|it| it.file_name() == name);
        assert!(!has("environment.tmp") && !has("environment.old"), "{left:?}");
    }

    #[test]
    fn remains_of_a_killed_process_are_replaced_and_two_at_once_agree() {
        let made = BuiltEnvironment::new();
        fs::create_dir_all(made.folder.path().join("environment.tmp/lib")).unwrap();
        fs::write(made.folder.path().join("environment.old"), "").unwrap();
        let all = thread::scope(|scope| {
            let threads = [(); 4].map(|()| scope.spawn(|| made.prepare()));
            threads.map(|it| it.join().unwrap())
        });
        assert_eq!(all.iter().filter(|it| it.made.is_some()).count(), 1, "{all:?}");
        assert!(!made.folder.path().join("environment.tmp").exists());
    }

    /// Set for a process of its own, which may have few open files.
    const FEW_FILES: &str = "GLEANER_FEW_FILES";

    #[test]
    fn many_wheels_need_few_open_files_and_a_shortage_of_them_is_reported_as_one() {
        let mut made = BuiltEnvironment::new();
        for number in 0..60 {
            let wheel = MadeWheel::new(&format!("more{number}")).file(&format!("m{number}.py"), "");
            made.wheels.push(wheel.write(made.folder.path()));
        }
        if std::env::var_os(FEW_FILES).is_some() {
            assert_eq!(made.prepare().made.as_deref(), Some("there was none"));
            let taken: Vec<_> = std::iter::from_fn(|| File::open("/dev/null").ok()).collect();
            let prepared = prepare_for(&made.interpreter, &made.wheels, made.folder.path());
            let python = Interpreter::probe(&made.interpreter.program);
            drop(taken);
            for error in [prepared.unwrap_err(), python.unwrap_err()] {
                assert!(is_shortage(&error), "{error:?}");
            }
            return assert_eq!(made.prepare().made, None);
        }
        let name = "many_wheels_need_few_open_files_and_a_shortage_of_them_is_reported_as_one";
        let (_, module) = module_path!().split_once("::").unwrap();
        let test = format!("{module}::{name}");
        let mut limited = Command::new("sh");
        limited.args(["-c", "ulimit -n 32; exec \"$@\"", "sh"]).env(FEW_FILES, "1");
        limited.arg(std::env::current_exe().unwrap()).args(["--exact", &test]);
        let output = limited.output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && text.contains("1 passed"), "{text}");
    }

    #[test]
    fn a_file_and_a_folder_of_one_name_are_refused_by_name() {
        let made = BuiltEnvironment::new();
        let refused = |wheel: MadeWheel| {
            let all = [&made.wheels[..], &[wheel.write(made.folder.path())]].concat();
            let error = prepare_for(&made.interpreter, &all, made.folder.path()).unwrap_err();
            gleaner_base::Failure::from(error).to_string()
        };
        let twice =
            MadeWheel::new("odd").file("odd.py", "1").file("odd-1.0.data/purelib/odd.py", "2");
        for (wheel, parts) in [
            (
                MadeWheel::new("third").file("second.py/x.py", ""),
                ["`second-1.0-py3-none-any.whl`", "`third-1.0-py3-none-any.whl`", "`second.py`"],
            ),
            (
                MadeWheel::new("third").file("first", ""),
                ["`third-1.0-py3-none-any.whl`", "`first-1.0-py3-none-any.whl`", "`first`"],
            ),
            (
                MadeWheel::new("odd").file("odd", "").file("odd/x.py", ""),
                ["wheel `odd-1.0-py3-none-any.whl` has", "a file and a folder", "`odd`"],
            ),
            (twice, ["wheel `odd-1.0-py3-none-any.whl` has", "two different files", "`odd.py`"]),
        ] {
            let text = refused(wheel);
            for part in parts.iter().chain(&["help:"]) {
                assert!(text.contains(part), "{part}: {text}");
            }
        }
        assert!(!made.path("").exists(), "nothing is unpacked");
    }

    #[test]
    fn wheels_with_different_files_of_one_name_are_refused() {
        let made = BuiltEnvironment::new();
        let init = "NAME = 'first'\n";
        let same = MadeWheel::new("third").file("first/__init__.py", init);
        // Also twice in one wheel.
        let same = same.file("third-1.0.data/purelib/first/__init__.py", init);
        let same = same.write(made.folder.path());
        let all = [&made.wheels[..], &[same]].concat();
        prepare_for(&made.interpreter, &all, made.folder.path()).unwrap();
        let other = MadeWheel::new("third").file("first/__init__.py", "NAME = 'other'\n");
        other.write(made.folder.path());
        let error = prepare_for(&made.interpreter, &all, made.folder.path()).unwrap_err();
        let text = error.to_string();
        assert!(text.contains("`first-1.0-py3") && text.contains("`third-1.0-py3"), "{text}");
    }
}
