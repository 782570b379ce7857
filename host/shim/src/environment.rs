//! The part of our environment that a runtime is given. What else is in it, such as somebody's keys, is not for a lambda.

use std::env;
use std::ffi::{OsStr, OsString};

/// Variables by name.
const NAMES: [&str; 14] = [
    "PATH",
    "HOME",
    "LANG",
    "TZ",
    "USER",
    "LOGNAME",
    "TERM",
    "TMPDIR",
    "XDG_CACHE_HOME",
    "LD_LIBRARY_PATH",
    "AMENT_PREFIX_PATH",
    "RUST_LOG",
    "RUST_BACKTRACE",
    "NO_COLOR",
];

/// Variables by how their names begin or end.
const BEGINNINGS: [&str; 8] = ["GLEANER_", "ROS_", "LC_", "CUDA_", "NVIDIA_", "PYENV", "ORT_", "OPENCV_"];
const ENDINGS: [&str; 1] = ["_NUM_THREADS"];

/// What a runtime is given.
pub(crate) fn handed_on() -> impl Iterator<Item = (OsString, OsString)> {
    env::vars_os().filter(|(name, _)| is_handed_on(name))
}

fn is_handed_on(name: &OsStr) -> bool {
    let Some(name) = name.to_str() else { return false };
    NAMES.contains(&name)
        || BEGINNINGS.iter().any(|beginning| name.starts_with(beginning))
        || ENDINGS.iter().any(|ending| name.ends_with(ending))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_of_others_stay_here() {
        for name in ["AWS_SECRET_ACCESS_KEY", "SSH_AUTH_SOCK", "PATHS", "XGLEANER_", "LD_PRELOAD"] {
            assert!(!is_handed_on(OsStr::new(name)), "{name}");
        }
        for name in ["PATH", "ROS_DOMAIN_ID", "OMP_NUM_THREADS", "GLEANER_PYTHON"] {
            assert!(is_handed_on(OsStr::new(name)), "{name}");
        }
    }
}
