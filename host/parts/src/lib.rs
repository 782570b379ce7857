//! Where the parts of an installation are: programs, the Python side, the interpreter, the cache.
//!
//! Looked for in this order: `$GLEANER_HOME`, `<exe>/../lib/gleaner`, and, for a program in a cargo
//! target folder, beside it and in `guest-sdk-python/` of the checkout around that folder. Nothing
//! is built, copied or remembered here, and no environment variable but those named in the docs is
//! read.

mod error;
mod places;
mod python;
#[cfg(test)]
#[path = "../../../base/src/test_folder.rs"]
mod test_folder;

use std::env;
use std::path::{self, Path, PathBuf};

pub use error::{Looked, PartsError};
use places::Places;

/// The parts of the installation that a program belongs to.
#[derive(Debug, Clone)]
pub struct Parts {
    places: Places,
    /// `GLEANER_PYTHON`: the interpreter that the user wants.
    wanted_python: Option<PathBuf>,
}

impl Parts {
    /// The parts of the installation that the running program belongs to. Reads `GLEANER_HOME` and
    /// `GLEANER_PYTHON`.
    ///
    /// # Errors
    ///
    /// [`PartsError::NoExecutable`] if the system does not tell where the running program lies,
    /// [`PartsError::Home`] if there is no part at all in `GLEANER_HOME`.
    pub fn find() -> Result<Parts, PartsError> {
        let exe = env::current_exe().map_err(|source| PartsError::NoExecutable { source })?;
        // Absolute, since what is found may be used by a program with another working folder.
        let home = variable("GLEANER_HOME").map(|home| path::absolute(&home).unwrap_or(home));
        match home {
            // Else other parts than the wanted ones would be taken, and nobody told.
            Some(home) if !places::has_parts(&home) => Err(PartsError::Home { home }),
            home => Ok(Parts::around(&exe, home, variable("GLEANER_PYTHON"))),
        }
    }

    fn around(exe: &Path, home: Option<PathBuf>, wanted_python: Option<PathBuf>) -> Parts {
        Parts { places: Places::around(exe, home), wanted_python }
    }

    /// The program `name`, for example `gleaner-runtime`.
    ///
    /// # Errors
    ///
    /// [`PartsError::Missing`] with every place that was looked at.
    pub fn program(&self, name: &str) -> Result<PathBuf, PartsError> {
        // It is not built with the rest: see its docs.
        let how =
            if name == "gleaner-player" { "cargo xtask player" } else { "cargo build --release" };
        self.places.first(name, how, |folder| {
            let program = folder.join(name);
            is_program(&program).then_some(program)
        })
    }

    /// The folder with Python's side: `start.py` and the package `gleaner`.
    ///
    /// # Errors
    ///
    /// [`PartsError::Missing`] with every place that was looked at.
    pub fn python_home(&self) -> Result<PathBuf, PartsError> {
        self.places.first("start.py with the package gleaner", "cargo xtask demo", |folder| {
            let complete =
                folder.join("start.py").is_file() && folder.join("gleaner/__init__.py").is_file();
            complete.then(|| folder.to_owned())
        })
    }

    /// The extension module `_gleaner`, loaded by path from `lib_gleaner.so`.
    ///
    /// # Errors
    ///
    /// [`PartsError::Missing`] with every place that was looked at.
    pub fn extension(&self) -> Result<PathBuf, PartsError> {
        self.places.first("lib_gleaner.so", "cargo build --release", |folder| {
            let module = folder.join("lib_gleaner.so");
            module.is_file().then_some(module)
        })
    }

    /// The Python interpreter for the lambda in `lambda_dir`, as an absolute path: it runs, is 3.9
    /// or newer and has `venv` and `ensurepip`. That is `GLEANER_PYTHON` if it is set, else the
    /// first such of `lambda_dir/.venv`, the checkout's `.venv`, and `python3`, `python3.13` …
    /// `python3.9` of `PATH`.
    ///
    /// Each candidate is started once: a program that can be found may still not run.
    ///
    /// # Errors
    ///
    /// [`PartsError::WantedPython`] if `GLEANER_PYTHON` will not do, [`PartsError::Environment`] if
    /// `pyvenv.cfg` of the lambda is no file, [`PartsError::NoPython`] with every candidate and why
    /// it was refused.
    pub fn python(&self, lambda_dir: Option<&Path>) -> Result<PathBuf, PartsError> {
        self.python_or_why(lambda_dir).map(|(python, _)| python)
    }

    /// As [`Parts::python`], and the environment that `lambda_dir` has though another interpreter
    /// was chosen, with why it is not used.
    ///
    /// # Errors
    ///
    /// As [`Parts::python`].
    pub fn python_or_why(
        &self,
        lambda_dir: Option<&Path>,
    ) -> Result<(PathBuf, Option<Looked>), PartsError> {
        if let Some(wanted) = &self.wanted_python {
            return Ok((python::wanted(wanted)?, None));
        }
        let candidates = python::candidates(lambda_dir, self.places.checkout());
        let (python, tried) = python::first_that_runs(candidates, lambda_dir)?;
        let environment =
            lambda_dir.map(|dir| dir.join(".venv")).filter(|it| it.symlink_metadata().is_ok());
        let unused =
            environment.and_then(|it| tried.into_iter().find(|looked| looked.at.starts_with(&it)));
        Ok((python, unused))
    }
}

/// The folder for what can be made again, such as native code: `$XDG_CACHE_HOME/gleaner`, else
/// `~/.cache/gleaner`. It need not exist.
///
/// # Errors
///
/// [`PartsError::NoCache`] if neither `XDG_CACHE_HOME` nor `HOME` is an absolute path.
///
/// Source: XDG base directory specification, by which a relative path counts as unset.
pub fn cache_dir() -> Result<PathBuf, PartsError> {
    cache_below(variable("XDG_CACHE_HOME"), variable("HOME"))
}

fn cache_below(xdg: Option<PathBuf>, home: Option<PathBuf>) -> Result<PathBuf, PartsError> {
    let absolute = |path: &PathBuf| path.is_absolute();
    let cache =
        xdg.filter(absolute).or_else(|| home.filter(absolute).map(|home| home.join(".cache")));
    cache.map(|cache| cache.join("gleaner")).ok_or(PartsError::NoCache)
}

/// An environment variable as a path; set to nothing it counts as unset.
fn variable(name: &str) -> Option<PathBuf> {
    env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
}

#[cfg(unix)]
fn is_program(path: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt;
    path.metadata().is_ok_and(|data| data.is_file() && data.permissions().mode() & 0o111 != 0)
}

#[cfg(not(unix))]
fn is_program(path: &Path) -> bool {
    path.is_file()
}

#[cfg(all(test, unix))]
mod tests;
