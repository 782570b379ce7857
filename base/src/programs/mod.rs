//! Finds the parts of an installation: programs, Python files, the interpreter, the cache.
//!
//! It searches in this order: `$GLEANER_HOME`, `<exe>/../lib/gleaner`, and, for a program in a
//! cargo target folder, the folder of the program and `guest-sdk-python/` of the checkout. Nothing
//! is built, copied or remembered, and only the documented environment variables are read.

mod error;
mod python;
mod search_paths;

use std::env;
use std::path::{self, Path, PathBuf};

pub use error::{InstallationError, RejectedPython};
use search_paths::SearchPaths;

/// The parts of the installation that a program belongs to.
#[derive(Debug, Clone)]
pub struct InstalledPrograms {
    search_paths: SearchPaths,
    /// `GLEANER_PYTHON`, the interpreter that the user has chosen.
    wanted_python: Option<PathBuf>,
}

impl InstalledPrograms {
    /// Finds the installation that the running program belongs to. Reads `GLEANER_HOME` and
    /// `GLEANER_PYTHON`.
    ///
    /// # Errors
    ///
    /// [`InstallationError::NoExecutable`] if the path of the running program is unknown,
    /// [`InstallationError::Home`] if `GLEANER_HOME` has no part of an installation.
    pub fn find() -> Result<InstalledPrograms, InstallationError> {
        let exe =
            env::current_exe().map_err(|source| InstallationError::NoExecutable { source })?;
        // Absolute, since a program with another working folder may use the paths.
        let home = variable("GLEANER_HOME").map(|home| path::absolute(&home).unwrap_or(home));
        match home {
            // Otherwise parts of another installation would be used silently.
            Some(home) if !search_paths::has_parts(&home) => Err(InstallationError::Home { home }),
            home => Ok(InstalledPrograms::around(&exe, home, variable("GLEANER_PYTHON"))),
        }
    }

    fn around(
        exe: &Path,
        home: Option<PathBuf>,
        wanted_python: Option<PathBuf>,
    ) -> InstalledPrograms {
        InstalledPrograms { search_paths: SearchPaths::around(exe, home), wanted_python }
    }

    /// Finds the program `name`, for example `gleaner-runtime`.
    ///
    /// # Errors
    ///
    /// [`InstallationError::Missing`] with the searched folders.
    pub fn program(&self, name: &str) -> Result<PathBuf, InstallationError> {
        // The player is not built with the other programs: see its docs.
        let how =
            if name == "gleaner-player" { "cargo xtask player" } else { "cargo build --release" };
        self.search_paths.first(name, how, |folder| {
            let program = folder.join(name);
            is_program(&program).then_some(program)
        })
    }

    /// Finds the folder with `start.py` and the Python package `gleaner`.
    ///
    /// # Errors
    ///
    /// [`InstallationError::Missing`] with the searched folders.
    pub fn python_home(&self) -> Result<PathBuf, InstallationError> {
        self.search_paths.first("start.py with the package gleaner", "cargo xtask demo", |folder| {
            let complete =
                folder.join("start.py").is_file() && folder.join("gleaner/__init__.py").is_file();
            complete.then(|| folder.to_owned())
        })
    }

    /// Finds `lib_gleaner.so`, the extension module `_gleaner`, which is loaded by path.
    ///
    /// # Errors
    ///
    /// [`InstallationError::Missing`] with the searched folders.
    pub fn extension(&self) -> Result<PathBuf, InstallationError> {
        self.search_paths.first("lib_gleaner.so", "cargo build --release", |folder| {
            let module = folder.join("lib_gleaner.so");
            module.is_file().then_some(module)
        })
    }

    /// Finds the Python interpreter for the lambda in `lambda_dir`, as an absolute path. It is 3.9
    /// or newer and has `venv` and `ensurepip`. `GLEANER_PYTHON` is used if it is set, else the
    /// first working one of `lambda_dir/.venv`, the checkout's `.venv`, and `python3`, `python3.13`
    /// … `python3.9` in `PATH`.
    ///
    /// Each candidate is started once to check that it works.
    ///
    /// # Errors
    ///
    /// [`InstallationError::WantedPython`] if `GLEANER_PYTHON` cannot be used,
    /// [`InstallationError::Environment`] if `pyvenv.cfg` of the lambda is not a regular file,
    /// [`InstallationError::NoPython`] with all candidates and reasons.
    pub fn python(&self, lambda_dir: Option<&Path>) -> Result<PathBuf, InstallationError> {
        self.python_and_unused_venv(lambda_dir).map(|(python, _)| python)
    }

    /// As [`InstalledPrograms::python`]; also returns the environment in `lambda_dir`, with the
    /// reason, if it exists but is not used.
    ///
    /// # Errors
    ///
    /// As [`InstalledPrograms::python`].
    pub fn python_and_unused_venv(
        &self,
        lambda_dir: Option<&Path>,
    ) -> Result<(PathBuf, Option<RejectedPython>), InstallationError> {
        if let Some(wanted) = &self.wanted_python {
            return Ok((python::wanted(wanted)?, None));
        }
        let candidates = python::candidates(lambda_dir, self.search_paths.checkout());
        let (python, tried) = python::first_that_runs(candidates, lambda_dir)?;
        let environment =
            lambda_dir.map(|dir| dir.join(".venv")).filter(|it| it.symlink_metadata().is_ok());
        let unused = environment
            .and_then(|it| tried.into_iter().find(|rejected| rejected.path.starts_with(&it)));
        Ok((python, unused))
    }
}

/// Folder of the cache, for example for native code: `$XDG_CACHE_HOME/gleaner`, else
/// `~/.cache/gleaner`. It need not exist.
///
/// # Errors
///
/// [`InstallationError::NoCache`] if neither `XDG_CACHE_HOME` nor `HOME` is an absolute path.
///
/// Source: XDG base directory specification, by which a relative path counts as unset.
pub fn cache_dir() -> Result<PathBuf, InstallationError> {
    cache_below(variable("XDG_CACHE_HOME"), variable("HOME"))
}

fn cache_below(xdg: Option<PathBuf>, home: Option<PathBuf>) -> Result<PathBuf, InstallationError> {
    let absolute = |path: &PathBuf| path.is_absolute();
    let cache =
        xdg.filter(absolute).or_else(|| home.filter(absolute).map(|home| home.join(".cache")));
    cache.map(|cache| cache.join("gleaner")).ok_or(InstallationError::NoCache)
}

/// An environment variable as a path; `None` if unset or empty.
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
