//! The architectures that packages are made for.

use std::env;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Architecture {
    Amd64,
    Arm64,
}

impl Architecture {
    pub(crate) const ALL: [Self; 2] = [Self::Amd64, Self::Arm64];

    pub(crate) fn of_this_machine() -> Self {
        if env::consts::ARCH == "aarch64" { Self::Arm64 } else { Self::Amd64 }
    }

    pub(crate) fn is_of_this_machine(self) -> bool {
        self == Self::of_this_machine()
    }

    /// Its name in packages of Debian.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Amd64 => "amd64",
            Self::Arm64 => "arm64",
        }
    }

    /// Its name in rustup and cargo, as a part of that of a target.
    pub(crate) fn machine(self) -> &'static str {
        match self {
            Self::Amd64 => "x86_64",
            Self::Arm64 => "aarch64",
        }
    }

    /// Tool of the package binutils, for programs of this architecture.
    pub(crate) fn strip(self) -> &'static str {
        match self {
            _ if self.is_of_this_machine() => "strip",
            Self::Amd64 => "x86_64-linux-gnu-strip",
            Self::Arm64 => "aarch64-linux-gnu-strip",
        }
    }
}
