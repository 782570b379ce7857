//! The interpreter of an environment: its version, ABI and platform.

use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::wheels::WheelError;

/// Prints one value per line, the path last. Nothing of an environment is imported.
const PROBE: &str = "\
import os, sys
try:
    libc = os.confstr('CS_GNU_LIBC_VERSION')
except (OSError, ValueError):
    libc = None
print(sys.implementation.name, *sys.version_info[:2], sep='\\n')
print(getattr(sys, 'abiflags', ''), os.uname().machine, libc or '', sep='\\n')
print(os.path.realpath(sys.executable))";

/// A Python interpreter of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Interpreter {
    /// Its program, with all links resolved.
    pub(super) program: PathBuf,
    pub(super) version: (u32, u32),
    /// The end of the name of its ABI: `t` without the global lock.
    pub(super) flags: String,
    /// The processor, for example `x86_64`.
    pub(super) machine: String,
    /// The version of glibc, if the system has it.
    pub(super) glibc: Option<(u32, u32)>,
}

impl Interpreter {
    /// Starts the interpreter `python` once, without code of any environment. It has to be CPython.
    /// Returns [`WheelError::Start`] if it cannot be started.
    pub(super) fn probe(python: &Path) -> Result<Self, WheelError> {
        let refused =
            |reason: String| WheelError::Interpreter { python: python.to_owned(), reason };
        let probe =
            Command::new(python).args(["-I", "-S", "-c", PROBE]).stdin(Stdio::null()).output();
        let output =
            probe.map_err(|source| WheelError::Start { python: python.to_owned(), source })?;
        let text = String::from_utf8_lossy(&output.stdout);
        let lines: Vec<_> = text.lines().collect();
        let [implementation, major, minor, flags, machine, libc, program] = lines[..] else {
            let error = String::from_utf8_lossy(&output.stderr);
            return Err(refused(gleaner_base::excerpt(&format!("{} {error}", output.status))));
        };
        if implementation != "cpython" {
            return Err(refused(format!("it is {implementation}")));
        }
        let number = |text: &str| text.parse::<u32>().ok();
        let glibc = libc.strip_prefix("glibc ").and_then(|it| it.split_once('.'));
        let version = number(major).zip(number(minor));
        Ok(Self {
            program: program.into(),
            version: version.ok_or_else(|| refused("it has no version".to_owned()))?,
            flags: flags.to_owned(),
            machine: machine.to_owned(),
            glibc: glibc.and_then(|(major, minor)| number(major).zip(number(minor))),
        })
    }

    /// Returns the tag of its ABI, for example `cp311`.
    pub(super) fn abi(&self) -> String {
        let (major, minor) = self.version;
        format!("cp{major}{minor}{}", self.flags)
    }

    pub(super) fn is_free_threaded(&self) -> bool {
        self.flags.contains('t')
    }

    pub(super) fn packages(&self) -> PathBuf {
        let ((major, minor), t) = (self.version, if self.is_free_threaded() { "t" } else { "" });
        format!("lib/python{major}.{minor}{t}/site-packages").into()
    }

    /// Returns the newest platform whose wheels it takes.
    fn platform(&self) -> String {
        match self.glibc {
            Some((major, minor)) => format!("manylinux_{major}_{minor}_{}", self.machine),
            None => format!("linux_{}", self.machine),
        }
    }

    /// Describes the tags of the wheels that it takes.
    pub(super) fn accepted(&self) -> String {
        let ((major, minor), abi) = (self.version, self.abi());
        let stable = if self.is_free_threaded() { "" } else { ", abi3" };
        format!("py{major} up to {minor}, {abi}{stable}, and platforms up to {}", self.platform())
    }

    pub(super) fn build_options(&self) -> String {
        let (major, minor) = self.version;
        format!("--python-version {major}.{minor} --python-platform {}", self.platform())
    }
}

impl fmt::Display for Interpreter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (major, minor) = self.version;
        write!(f, "Python {major}.{minor} at `{}`", self.program.display())
    }
}
