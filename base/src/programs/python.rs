use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use super::{InstallationError, RejectedPython};
use crate::text::excerpt;
use crate::{ByteSize, NotPlain, PlainFile};

/// Prints the version and the path of the interpreter itself, since `python3` is often a script
/// that chooses one at every start. Fails if the system's Python lacks one of the two modules. They
/// are searched but not imported, which would take 30 ms at each start of a lambda.
const PROBE: &str = "\
import sys
for name in ('venv', 'ensurepip'):
    if not any(finder.find_spec(name, None) for finder in sys.meta_path):
        raise ModuleNotFoundError(f'No module named {name!r}')
print(*sys.version_info[:2])
print(sys.executable)";

/// Checks the interpreter that the user has chosen. No other one is tried, since that would hide
/// the error.
pub(super) fn wanted(python: &Path) -> Result<PathBuf, InstallationError> {
    probe(python).map_err(|reason| InstallationError::WantedPython {
        wanted: RejectedPython { path: python.to_owned(), reason },
    })
}

/// The interpreters to try, in order. Names without a folder are searched in `PATH`.
pub(super) fn candidates(lambda_dir: Option<&Path>, checkout: Option<&Path>) -> Vec<PathBuf> {
    let folders = [lambda_dir, checkout].into_iter().flatten();
    let mut candidates: Vec<PathBuf> = folders.map(|dir| dir.join(".venv/bin/python3")).collect();
    candidates.push("python3".into());
    candidates.extend((9..=13).rev().map(|minor| PathBuf::from(format!("python3.{minor}"))));
    candidates
}

/// Returns the first of `candidates` that works, and the rejected ones before it. A program in
/// `lambda_dir` is never run. A link there to a program elsewhere is resolved and started by the
/// target's path, since Python started by the link would read the folder of the link.
pub(super) fn first_that_runs(
    candidates: Vec<PathBuf>,
    lambda_dir: Option<&Path>,
) -> Result<(PathBuf, Vec<RejectedPython>), InstallationError> {
    let mut tried = Vec::new();
    for candidate in candidates {
        let of_lambda = lambda_dir.filter(|dir| candidate.starts_with(dir));
        if of_lambda.is_some()
            && let Err(source) = config_of(&candidate)
            && NotPlain::of(&source).is_some()
        {
            // This looks like tampering: trying another interpreter would hide it.
            return Err(InstallationError::Environment {
                config: environment_of(&candidate).join(CONFIG),
                source,
            });
        }
        match of_lambda.map_or_else(|| probe(&candidate), |dir| linked(&candidate, dir)) {
            Ok(interpreter) => return Ok((interpreter, tried)),
            Err(reason) => tried.push(RejectedPython { path: candidate, reason }),
        }
    }
    Err(InstallationError::NoPython { tried })
}

/// Checks the interpreter that `candidate`, in the environment of a lambda, links to. Nothing in
/// the environment is run.
fn linked(candidate: &Path, lambda_dir: &Path) -> Result<PathBuf, String> {
    let program = only_linked(candidate, lambda_dir)?;
    // A script that chooses an interpreter would ignore the environment.
    if probe(&program)?.canonicalize().ok() != Some(program) {
        return Err(format!("links to a program that starts another; {CREATE_VENV}"));
    }
    std::path::absolute(candidate).map_err(|error| error.to_string())
}

/// Advice if an environment cannot be used.
const CREATE_VENV: &str = "create the environment with `python3 -m venv`, which uses links";
const CONFIG: &str = "pyvenv.cfg";
/// Maximum size of `pyvenv.cfg`. `python3 -m venv` writes 200 bytes.
const CONFIG_MAX: ByteSize = ByteSize::mib(1);
/// Maximum length of a line of `pyvenv.cfg`, in bytes: old Pythons split longer lines.
const LINE_BYTES: usize = 4096;

/// Returns the program that `candidate`, in a virtual environment of a lambda, links to. It must be
/// outside of the lambda's folder and use its own libraries, since nothing in that folder may run
/// unsandboxed.
fn only_linked(candidate: &Path, lambda_dir: &Path) -> Result<PathBuf, String> {
    let real = |path: &Path| path.canonicalize().map_err(|_| "not found".to_owned());
    let (program, lambda) = (real(candidate)?, real(lambda_dir)?);
    if program.starts_with(&lambda) {
        return Err(format!("is a program in the lambda's folder; {CREATE_VENV}"));
    }
    let name = program.file_name().unwrap_or_default().to_string_lossy();
    if !["python", "pypy"].iter().any(|known| name.starts_with(known)) {
        return Err(format!(
            "links to `{}`, which is not a Python; {CREATE_VENV}",
            program.display()
        ));
    }
    let bin = candidate.parent().unwrap_or(lambda_dir);
    if let Some(file) = paths_of_its_own(bin)? {
        return Err(format!(
            "has `{}` beside it, which names other libraries; {CREATE_VENV}",
            excerpt(&file)
        ));
    }
    let config = config_of(candidate).unwrap_or_default();
    // Python versions differ in which of these they treat as blanks or line ends.
    if config
        .lines()
        .any(|line| line.len() > LINE_BYTES || line.chars().any(|c| c.is_control() && c != '\t'))
    {
        return Err(format!("its pyvenv.cfg has ambiguous lines; {CREATE_VENV}"));
    }
    let entries = config.lines().filter_map(|line| line.split_once('='));
    let homes: Vec<_> =
        entries.filter(|(key, _)| key.trim().eq_ignore_ascii_case("home")).collect();
    let is_home =
        |home: &str| Path::new(home.trim()).canonicalize().ok().as_deref() == program.parent();
    if homes.is_empty() || !homes.iter().all(|(_, home)| is_home(home)) {
        return Err(format!(
            "its pyvenv.cfg names another home than that of its program; {CREATE_VENV}"
        ));
    }
    Ok(program)
}

/// Folder of the environment of the interpreter `candidate`.
fn environment_of(candidate: &Path) -> &Path {
    candidate.parent().and_then(Path::parent).unwrap_or(candidate)
}

fn config_of(candidate: &Path) -> io::Result<String> {
    let config = PlainFile::inside(environment_of(candidate), Path::new(CONFIG), CONFIG_MAX)?
        .read_whole()?;
    String::from_utf8(config).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
}

/// Returns the name of a `._pth` file in `bin`, from which an interpreter would take the paths of
/// its libraries.
fn paths_of_its_own(bin: &Path) -> Result<Option<String>, String> {
    for entry in bin.read_dir().map_err(|error| error.to_string())? {
        let name =
            entry.map_err(|error| error.to_string())?.file_name().to_string_lossy().into_owned();
        if name.to_ascii_lowercase().ends_with("._pth") {
            return Ok(Some(name));
        }
    }
    Ok(None)
}

/// Starts `candidate`; returns the path of the interpreter, or why it cannot be used.
fn probe(candidate: &Path) -> Result<PathBuf, String> {
    // `-I`: do not run a `venv.py` in the current folder. `-S`: do not run start-up code of an
    // environment.
    let output =
        Command::new(candidate).args(["-I", "-S", "-c", PROBE]).stdin(Stdio::null()).output();
    let output = output.map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => "not found".to_owned(),
        _ => error.to_string(),
    })?;
    if !output.status.success() {
        return Err(complaint(&output));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let answer = || {
        let (version, path) = text.trim_end().split_once('\n')?;
        let (major, minor) = version.trim_end().split_once(' ')?;
        let version: (u32, u32) = (major.parse().ok()?, minor.parse().ok()?);
        Some((version, PathBuf::from(path))).filter(|(_, path)| path.is_absolute())
    };
    match answer() {
        Some((version, path)) if version >= (3, 9) => Ok(path),
        Some(((major, minor), _)) => Err(format!("is Python {major}.{minor}")),
        None => Err("does not behave like Python".to_owned()),
    }
}

/// The last line of a failed program's standard error, which is the error in a Python traceback.
fn complaint(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr);
    match text.lines().map(str::trim).rfind(|line| !line.is_empty()) {
        Some(line) => excerpt(line),
        None => format!("ends with {}", output.status),
    }
}
