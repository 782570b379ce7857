//! The part of our environment that a runtime is given. What else is in it, such as somebody's
//! keys, is not for a lambda.

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

/// Those of CUDA and of NVIDIA's containers, by name: services of the same maker have keys under
/// names that begin like these.
const CUDA: [&str; 16] = [
    "CUDA_VISIBLE_DEVICES",
    "CUDA_DEVICE_ORDER",
    "CUDA_DEVICE_MAX_CONNECTIONS",
    "CUDA_HOME",
    "CUDA_PATH",
    "CUDA_CACHE_PATH",
    "CUDA_CACHE_DISABLE",
    "CUDA_CACHE_MAXSIZE",
    "CUDA_FORCE_PTX_JIT",
    "CUDA_MODULE_LOADING",
    "CUDA_LAUNCH_BLOCKING",
    "NVIDIA_VISIBLE_DEVICES",
    "NVIDIA_DRIVER_CAPABILITIES",
    "NVIDIA_REQUIRE_CUDA",
    "NVIDIA_DISABLE_REQUIRE",
    "NVIDIA_TF32_OVERRIDE",
];

/// Variables by how their names begin or end.
const BEGINNINGS: [&str; 6] = ["GLEANER_", "ROS_", "LC_", "PYENV", "ORT_", "OPENCV_"];
const ENDINGS: [&str; 1] = ["_NUM_THREADS"];

/// What stands in the name of a secret, however it begins. Letters of either case are the same.
const SECRETS: [&str; 6] = ["KEY", "TOKEN", "SECRET", "PASSWORD", "PASSWD", "CREDENTIAL"];

/// Variables of cargo and of rustc, by how their names begin.
const COMPILER: [&str; 2] = ["CARGO_", "RUST"];

/// What a runtime is given.
pub(crate) fn handed_on() -> impl Iterator<Item = (OsString, OsString)> {
    env::vars_os().filter(|(name, _)| is_handed_on(name))
}

/// Returns the environment of a compiler.
pub(crate) fn of_compiler() -> impl Iterator<Item = (OsString, OsString)> {
    env::vars_os().filter(|(name, _)| is_of_compiler(name))
}

fn is_of_compiler(name: &OsStr) -> bool {
    let is_its_own = |name: &str| {
        NAMES.contains(&name) || COMPILER.iter().any(|beginning| name.starts_with(beginning))
    };
    name.to_str().is_some_and(|name| is_its_own(name) && !is_secret(name))
}

fn is_secret(name: &str) -> bool {
    let capitals = name.to_ascii_uppercase();
    SECRETS.iter().any(|secret| capitals.contains(secret))
}

fn is_handed_on(name: &OsStr) -> bool {
    let Some(name) = name.to_str().filter(|name| !is_secret(name)) else { return false };
    NAMES.contains(&name)
        || CUDA.contains(&name)
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
        for name in
            ["PATH", "ROS_DOMAIN_ID", "OMP_NUM_THREADS", "GLEANER_PYTHON", "CUDA_VISIBLE_DEVICES"]
        {
            assert!(is_handed_on(OsStr::new(name)), "{name}");
        }
    }

    #[test]
    fn a_compiler_gets_its_own_and_no_secrets() {
        for name in [
            "PATH",
            "CARGO_HOME",
            "CARGO_NET_OFFLINE",
            "RUSTC",
            "RUSTFLAGS",
            "RUST_BACKTRACE",
            "TMPDIR",
        ] {
            assert!(is_of_compiler(OsStr::new(name)), "{name}");
        }
        for name in [
            "CARGO_REGISTRY_TOKEN",
            "CARGO_REGISTRIES_X_SECRET_KEY",
            "GLEANER_HOME",
            "SSH_AUTH_SOCK",
            "XCARGO_",
        ] {
            assert!(!is_of_compiler(OsStr::new(name)), "{name}");
        }
    }

    #[test]
    fn a_secret_stays_here_however_its_name_begins() {
        for name in [
            "NVIDIA_API_KEY",
            "NVIDIA_NGC",
            "CUDA_SOMETHING",
            "GLEANER_TOKEN",
            "ROS_MASTER_TOKEN",
            "ROS_Secret",
            "GLEANER_password",
            "PYENV_PASSWD",
            "ORT_CREDENTIALS",
            "KEY_NUM_THREADS",
        ] {
            assert!(!is_handed_on(OsStr::new(name)), "{name}");
        }
    }
}
