use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use super::{Looked, PartsError};
use crate::words::excerpt;

/// Prints the version and the path of the interpreter itself: `python3` is often a script that chooses one, and would
/// choose again at every start. Fails where the system's Python comes in pieces and lacks the two modules. They are looked for and
/// not imported, which would take 30 ms at each start of a lambda.
const PROBE: &str = "\
import sys
for name in ('venv', 'ensurepip'):
    if not any(finder.find_spec(name, None) for finder in sys.meta_path):
        raise ModuleNotFoundError(f'No module named {name!r}')
print(*sys.version_info[:2])
print(sys.executable)";

/// The interpreter that the user wants: if it will not do, another would hide that.
pub(super) fn wanted(python: &Path) -> Result<PathBuf, PartsError> {
    probe(python).map_err(|why| PartsError::WantedPython { wanted: Looked { at: python.to_owned(), why } })
}

/// The interpreters to try, in order. Those with a folder are paths, the others are searched for in `PATH`.
pub(super) fn candidates(lambda_dir: Option<&Path>, checkout: Option<&Path>) -> Vec<PathBuf> {
    let folders = [lambda_dir, checkout].into_iter().flatten();
    let mut candidates: Vec<PathBuf> = folders.map(|dir| dir.join(".venv/bin/python3")).collect();
    candidates.push("python3".into());
    candidates.extend((9..=13).rev().map(|minor| PathBuf::from(format!("python3.{minor}"))));
    candidates
}

/// The first of `candidates` that runs. What lies in `lambda_dir` is not run unless it is a link to a program elsewhere.
pub(super) fn first_that_runs(candidates: Vec<PathBuf>, lambda_dir: Option<&Path>) -> Result<PathBuf, PartsError> {
    let mut tried = Vec::new();
    for candidate in candidates {
        let of_lambda = lambda_dir.filter(|dir| candidate.starts_with(dir));
        match of_lambda.map_or(Ok(()), |dir| is_only_linked(&candidate, dir)).and_then(|()| probe(&candidate)) {
            Ok(interpreter) => return Ok(interpreter),
            Err(why) => tried.push(Looked { at: candidate, why }),
        }
    }
    Err(PartsError::NoPython { tried })
}

/// Whether `candidate` in a virtual environment in the folder of a lambda is a program from elsewhere, with the libraries of that:
/// whatever else is in such a folder must not run before it is shut in.
fn is_only_linked(candidate: &Path, lambda_dir: &Path) -> Result<(), String> {
    let real = |path: &Path| path.canonicalize().map_err(|_| "not found".to_owned());
    let (program, lambda) = (real(candidate)?, real(lambda_dir)?);
    if program.starts_with(&lambda) {
        return Err(
            "is a program in the lambda's folder; make the environment with `python3 -m venv`, which links".to_owned()
        );
    }
    let environment = candidate.parent().and_then(Path::parent).unwrap_or(lambda_dir);
    let config = std::fs::read_to_string(environment.join("pyvenv.cfg")).unwrap_or_default();
    let entries = config.lines().filter_map(|line| line.split_once('='));
    let homes: Vec<_> = entries.filter(|(key, _)| key.trim().eq_ignore_ascii_case("home")).collect();
    let is_home = |home: &str| Path::new(home.trim()).canonicalize().ok().as_deref() == program.parent();
    if homes.is_empty() || !homes.iter().all(|(_, home)| is_home(home)) {
        return Err("its pyvenv.cfg names another home than that of its program; make the environment anew".to_owned());
    }
    Ok(())
}

/// The interpreter that `candidate` starts, or why it will not do.
fn probe(candidate: &Path) -> Result<PathBuf, String> {
    // Isolated: else a `venv.py` in the current folder would be run. Without `site`: else what an environment has for its start.
    let output = Command::new(candidate).args(["-I", "-S", "-c", PROBE]).stdin(Stdio::null()).output();
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
        None => Err("does not answer as Python does".to_owned()),
    }
}

/// The last line that a program wrote before it failed: Python ends a traceback with the error.
fn complaint(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr);
    match text.lines().map(str::trim).rfind(|line| !line.is_empty()) {
        Some(line) => excerpt(line),
        None => format!("ends with {}", output.status),
    }
}
