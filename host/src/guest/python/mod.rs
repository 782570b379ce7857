//! Starts Python lambdas: this process becomes the interpreter of the lambda's environment.
//!
//! `gleaner-runtime` links no libpython. It replaces itself by `python3 -I -S start.py`, which
//! loads `_gleaner` (crate `host/python`), which runs this library again inside the interpreter. So
//! any virtual environment works.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::programs::{InstallationError, InstalledPrograms, RejectedPython};
use gleaner_base::{Exit, Explain};
use gleaner_protocol::LAYERS_ENV;
use gleaner_sandbox::cgroup::CGROUP_ENV;

use crate::isolation::{self, SandboxPermissions};

/// Variables that limit numpy's linear algebra to one thread, unless the user sets them: receivers
/// share the cores, and with its default, OpenBLAS hangs where memory is capped.
const ONE_THREAD: [&str; 4] =
    ["OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"];

/// A Python interpreter that cannot be started.
#[derive(Debug, thiserror::Error)]
pub enum PythonError {
    #[error(transparent)]
    InstalledPrograms(#[from] InstallationError),
    #[error("cannot start `{}`", python.display())]
    Start { python: PathBuf, source: std::io::Error },
}

impl Explain for PythonError {
    fn help(&self) -> Option<String> {
        match self {
            Self::InstalledPrograms(error) => error.help(),
            Self::Start { .. } => {
                Some("name another interpreter: GLEANER_PYTHON=/path/to/python3".to_owned())
            }
        }
    }

    fn exit(&self) -> Exit {
        match self {
            Self::InstalledPrograms(error) => error.exit(),
            Self::Start { .. } => Exit::Usage,
        }
    }
}

/// Becomes the interpreter that hosts the lambda in `lambda_dir`, with `args` for Gleaner's library
/// in it. It can open only the files of `permissions`, its own and Gleaner's, and its memory is
/// limited. Returns only errors.
pub fn become_interpreter(
    lambda_dir: &Path,
    args: &[OsString],
    permissions: SandboxPermissions,
) -> PythonError {
    match interpreter(lambda_dir, args, permissions) {
        Ok((python, mut command)) => PythonError::Start { python, source: command.exec() },
        Err(error) => error.into(),
    }
}

fn interpreter(
    lambda_dir: &Path,
    args: &[OsString],
    mut permissions: SandboxPermissions,
) -> Result<(PathBuf, Command), InstallationError> {
    let parts = InstalledPrograms::find()?;
    let (python, unused) = parts.python_and_unused_venv(Some(lambda_dir))?;
    if let Some(RejectedPython { path, reason }) = unused {
        let (environment, instead) = (path.display(), python.display());
        tracing::warn!(%environment, %reason, %instead, "cannot use the lambda's environment");
    }
    let mut command = Command::new(&python);
    // Isolated: neither PYTHONPATH nor the current folder decides what a lambda imports.
    let (home, extension) = (parts.python_home()?, parts.extension()?);
    // Without `site`: start-up code of the environment is untrusted, and runs once this process is
    // sandboxed.
    command.args(["-I", "-S"]).arg(home.join("start.py")).arg(&extension).args(args);
    permissions.paths.read.extend([home, extension]);
    // It may be any program named Python, which finds its libraries relative to its own path.
    command
        .env(LAYERS_ENV, isolation::before_interpreter(permissions, &python))
        .env_remove(CGROUP_ENV);
    for name in ONE_THREAD {
        if std::env::var_os(name).is_none() {
            command.env(name, "1");
        }
    }
    Ok((python, command))
}
