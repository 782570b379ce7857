//! The part of the shim's environment that is passed to a runtime. The rest, such as a user's
//! credentials, is not for a lambda.

use std::env;
use std::ffi::{OsStr, OsString};

/// Variables with these names.
const NAMES: &str = "PATH HOME LANG TZ USER LOGNAME TERM TMPDIR XDG_CACHE_HOME LD_LIBRARY_PATH \
                     AMENT_PREFIX_PATH RUST_LOG RUST_BACKTRACE NO_COLOR";

/// Variables of CUDA and of NVIDIA's containers, by full name: credentials of NVIDIA's services
/// have names with the same prefixes.
const CUDA: &str = "CUDA_VISIBLE_DEVICES CUDA_DEVICE_ORDER CUDA_DEVICE_MAX_CONNECTIONS CUDA_HOME \
                    CUDA_PATH CUDA_CACHE_PATH CUDA_CACHE_DISABLE CUDA_CACHE_MAXSIZE \
                    CUDA_FORCE_PTX_JIT CUDA_MODULE_LOADING CUDA_LAUNCH_BLOCKING \
                    NVIDIA_VISIBLE_DEVICES NVIDIA_DRIVER_CAPABILITIES NVIDIA_REQUIRE_CUDA \
                    NVIDIA_DISABLE_REQUIRE NVIDIA_TF32_OVERRIDE";

/// Prefixes and suffixes of further names.
const BEGINNINGS: [&str; 6] = ["GLEANER_", "ROS_", "LC_", "PYENV", "ORT_", "OPENCV_"];
const ENDINGS: [&str; 1] = ["_NUM_THREADS"];

/// Parts of names that mean a secret, whatever the prefix, in upper or lower case.
const SECRETS: [&str; 6] = ["KEY", "TOKEN", "SECRET", "PASSWORD", "PASSWD", "CREDENTIAL"];

/// Prefixes of the names of variables of cargo and rustc.
const COMPILER: [&str; 2] = ["CARGO_", "RUST"];

pub(crate) fn for_runtime() -> impl Iterator<Item = (OsString, OsString)> {
    env::vars_os().filter(|(name, _)| is_for_runtime(name))
}

pub(crate) fn for_compiler() -> impl Iterator<Item = (OsString, OsString)> {
    env::vars_os().filter(|(name, _)| is_of_compiler(name))
}

fn is_of_compiler(name: &OsStr) -> bool {
    let is_its_own = |name: &str| {
        is_in(NAMES, name) || COMPILER.iter().any(|beginning| name.starts_with(beginning))
    };
    name.to_str().is_some_and(|name| is_its_own(name) && !is_secret(name))
}

fn is_in(names: &str, name: &str) -> bool {
    names.split(' ').any(|it| it == name)
}

fn is_secret(name: &str) -> bool {
    let capitals = name.to_ascii_uppercase();
    SECRETS.iter().any(|secret| capitals.contains(secret))
}

fn is_for_runtime(name: &OsStr) -> bool {
    let Some(name) = name.to_str().filter(|name| !is_secret(name)) else { return false };
    is_in(NAMES, name)
        || is_in(CUDA, name)
        || BEGINNINGS.iter().any(|beginning| name.starts_with(beginning))
        || ENDINGS.iter().any(|ending| name.ends_with(ending))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn check(passes: fn(&OsStr) -> bool, expected: bool, names: &str) {
        for name in names.split_whitespace() {
            assert_eq!(passes(OsStr::new(name)), expected, "{name}");
        }
    }

    #[test]
    fn credentials_are_not_passed_on_whatever_their_prefix() {
        let own = "PATH ROS_DOMAIN_ID OMP_NUM_THREADS GLEANER_PYTHON CUDA_VISIBLE_DEVICES";
        check(is_for_runtime, true, own);
        let others = "AWS_SECRET_ACCESS_KEY SSH_AUTH_SOCK PATHS XGLEANER_ LD_PRELOAD \
                      NVIDIA_API_KEY NVIDIA_NGC CUDA_SOMETHING GLEANER_TOKEN ROS_MASTER_TOKEN \
                      ROS_Secret GLEANER_password PYENV_PASSWD ORT_CREDENTIALS KEY_NUM_THREADS";
        check(is_for_runtime, false, others);
    }

    #[test]
    fn a_compiler_gets_its_own_variables_and_no_secrets() {
        let own = "PATH CARGO_HOME CARGO_NET_OFFLINE RUSTC RUSTFLAGS RUST_BACKTRACE TMPDIR";
        check(is_of_compiler, true, own);
        let others = "CARGO_REGISTRY_TOKEN CARGO_REGISTRIES_X_SECRET_KEY GLEANER_HOME XCARGO_ \
                      SSH_AUTH_SOCK";
        check(is_of_compiler, false, others);
    }
}
