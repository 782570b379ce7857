use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use super::{Looked, PartsError};
use gleaner_base::text::excerpt;
use gleaner_base::{ByteSize, NotPlain, PlainFile};

/// Prints the version and the path of the interpreter itself: `python3` is often a script that
/// chooses one, and would choose again at every start. Fails where the system's Python comes in
/// pieces and lacks the two modules. They are looked for and not imported, which would take 30 ms
/// at each start of a lambda.
const PROBE: &str = "\
import sys
for name in ('venv', 'ensurepip'):
    if not any(finder.find_spec(name, None) for finder in sys.meta_path):
        raise ModuleNotFoundError(f'No module named {name!r}')
print(*sys.version_info[:2])
print(sys.executable)";

/// The interpreter that the user wants: if it will not do, another would hide that.
pub(super) fn wanted(python: &Path) -> Result<PathBuf, PartsError> {
    probe(python)
        .map_err(|why| PartsError::WantedPython { wanted: Looked { at: python.to_owned(), why } })
}

/// The interpreters to try, in order. Those with a folder are paths, the others are searched for in
/// `PATH`.
pub(super) fn candidates(lambda_dir: Option<&Path>, checkout: Option<&Path>) -> Vec<PathBuf> {
    let folders = [lambda_dir, checkout].into_iter().flatten();
    let mut candidates: Vec<PathBuf> = folders.map(|dir| dir.join(".venv/bin/python3")).collect();
    candidates.push("python3".into());
    candidates.extend((9..=13).rev().map(|minor| PathBuf::from(format!("python3.{minor}"))));
    candidates
}

/// The first of `candidates` that runs, and those before it with why they will not do. What lies in
/// `lambda_dir` is not run unless it is a link to a program elsewhere, and that program is then
/// started by its own name: by that of the link, Python looks into the folder of the link.
pub(super) fn first_that_runs(
    candidates: Vec<PathBuf>,
    lambda_dir: Option<&Path>,
) -> Result<(PathBuf, Vec<Looked>), PartsError> {
    let mut tried = Vec::new();
    for candidate in candidates {
        let of_lambda = lambda_dir.filter(|dir| candidate.starts_with(dir));
        if of_lambda.is_some()
            && let Err(source) = config_of(&candidate)
            && NotPlain::of(&source).is_some()
        {
            // Made on purpose: another interpreter would hide that.
            return Err(PartsError::Environment {
                config: environment_of(&candidate).join(CONFIG),
                source,
            });
        }
        match of_lambda.map_or_else(|| probe(&candidate), |dir| linked(&candidate, dir)) {
            Ok(interpreter) => return Ok((interpreter, tried)),
            Err(why) => tried.push(Looked { at: candidate, why }),
        }
    }
    Err(PartsError::NoPython { tried })
}

/// `candidate`, in the environment of a lambda, if the interpreter that it links to will do;
/// nothing of the environment is run.
fn linked(candidate: &Path, lambda_dir: &Path) -> Result<PathBuf, String> {
    let program = only_linked(candidate, lambda_dir)?;
    // A script that chooses an interpreter would choose without the environment.
    if probe(&program)?.canonicalize().ok() != Some(program) {
        return Err(format!("links to a program that starts another; {ANEW}"));
    }
    std::path::absolute(candidate).map_err(|error| error.to_string())
}

/// The way out where an environment is not one that can be used.
const ANEW: &str = "make the environment with `python3 -m venv`, which links";
/// What an environment says of itself.
const CONFIG: &str = "pyvenv.cfg";
/// Longest `pyvenv.cfg` that is read. `python3 -m venv` writes 200 bytes.
const CONFIG_MAX: ByteSize = ByteSize::mib(1);
/// Longest line of a `pyvenv.cfg`, in bytes: old Pythons take what is longer apart.
const LINE_BYTES: usize = 4096;

/// The program that `candidate`, in a virtual environment in the folder of a lambda, links to: one
/// from elsewhere, with the libraries of that. Whatever else is in such a folder must not run
/// before it is shut in.
fn only_linked(candidate: &Path, lambda_dir: &Path) -> Result<PathBuf, String> {
    let real = |path: &Path| path.canonicalize().map_err(|_| "not found".to_owned());
    let (program, lambda) = (real(candidate)?, real(lambda_dir)?);
    if program.starts_with(&lambda) {
        return Err(format!("is a program in the lambda's folder; {ANEW}"));
    }
    let name = program.file_name().unwrap_or_default().to_string_lossy();
    if !["python", "pypy"].iter().any(|known| name.starts_with(known)) {
        return Err(format!("links to `{}`, which is no Python; {ANEW}", program.display()));
    }
    let bin = candidate.parent().unwrap_or(lambda_dir);
    if let Some(file) = paths_of_its_own(bin)? {
        return Err(format!(
            "has `{}` beside it, which names other libraries; {ANEW}",
            excerpt(&file)
        ));
    }
    let config = config_of(candidate).unwrap_or_default();
    // Python takes some of these for blanks or ends of lines, others not.
    if config
        .lines()
        .any(|line| line.len() > LINE_BYTES || line.chars().any(|c| c.is_control() && c != '\t'))
    {
        return Err(format!("its pyvenv.cfg has lines that can be read in two ways; {ANEW}"));
    }
    let entries = config.lines().filter_map(|line| line.split_once('='));
    let homes: Vec<_> =
        entries.filter(|(key, _)| key.trim().eq_ignore_ascii_case("home")).collect();
    let is_home =
        |home: &str| Path::new(home.trim()).canonicalize().ok().as_deref() == program.parent();
    if homes.is_empty() || !homes.iter().all(|(_, home)| is_home(home)) {
        return Err(
            "its pyvenv.cfg names another home than that of its program; make the environment anew"
                .to_owned(),
        );
    }
    Ok(program)
}

/// The folder of the environment that has the interpreter `candidate` in its `bin`.
fn environment_of(candidate: &Path) -> &Path {
    candidate.parent().and_then(Path::parent).unwrap_or(candidate)
}

/// The `pyvenv.cfg` of that environment.
fn config_of(candidate: &Path) -> io::Result<String> {
    let config = PlainFile::inside(environment_of(candidate), Path::new(CONFIG), CONFIG_MAX)?
        .read_whole()?;
    String::from_utf8(config).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))
}

/// The name of a `._pth` file in `bin`: an interpreter that finds one takes its libraries from
/// where it says.
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

/// The interpreter that `candidate` starts, or why it will not do.
fn probe(candidate: &Path) -> Result<PathBuf, String> {
    // Isolated: else a `venv.py` in the current folder would be run. Without `site`: else what an
    // environment has for its start.
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
