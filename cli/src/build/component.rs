//! Compiles a Rust lambda with cargo, and finds the component among cargo's messages.

use std::env;
use std::ffi::OsString;
use std::fs;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use gleaner_base::{Exit, PlainFile};
use gleaner_lambda::layout::COMPONENT_MAX;
use serde_json::Value;

use super::error::{BuildError, TARGET};
use super::sandbox::Sandbox;

const STRIP: &str = "CARGO_PROFILE_RELEASE_STRIP";

/// Enables 128-bit SIMD, which every host supports: kernels of the SDK are several times slower
/// without it. `relaxed-simd` stays off, since its results depend on the CPU.
const SIMD: &str = "-Ctarget-feature=+simd128";

/// A component in cargo's target folder.
pub(super) struct Compiled {
    pub(super) path: PathBuf,
    pub(super) opened: io::Result<PlainFile>,
}

pub(super) fn compile(dir: &Path, sandboxed: bool) -> Result<Compiled, BuildError> {
    let package = dir.join("Cargo.toml");
    if !package.is_file() {
        return Err(BuildError::NoPackage { path: package });
    }
    let read = |source| BuildError::File { action: "read", path: package.clone(), source };
    // Cargo names manifests by their full path.
    let package = fs::canonicalize(&package).map_err(read)?;

    let sandbox = if sandboxed { Some(Sandbox::prepare(&package)?) } else { None };
    let mut build = sandbox.as_ref().map_or_else(cargo, Sandbox::cargo);
    let program = PathBuf::from(build.get_program());
    let no_cargo = |source| BuildError::NoCargo { program: program.clone(), source };
    if env::var_os(STRIP).is_none() {
        // The standard library's line tables are most of a component: 2.6 MB with them, a tenth
        // without. Names stay.
        build.env(STRIP, "debuginfo");
    }
    let mut child = with_simd(&mut build, |variable| env::var_os(variable))
        .args([
            "--release",
            "--target",
            TARGET,
            "--message-format=json-render-diagnostics",
            "--manifest-path",
        ])
        .arg(&package)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .map_err(no_cargo)?;
    let mut component = None;
    if let Some(messages) = child.stdout.take() {
        // A read error ends the list; cargo's exit status decides.
        for line in BufReader::new(messages).lines().map_while(Result::ok) {
            component = component_in(&line, &package).or(component);
        }
    }
    let status = child.wait().map_err(no_cargo)?;
    if !status.success() {
        return Err(match &sandbox {
            // Cargo itself exits with 1 or 101.
            Some(_) if status.code() == Some(i32::from(Exit::Denied.code())) => {
                BuildError::NoSandbox
            }
            Some(_) => BuildError::CompileSandboxed { status },
            None if target_is_missing() => BuildError::NoTarget,
            None => BuildError::Compile { status },
        });
    }
    let path = component.ok_or(BuildError::NoComponent { package })?;
    let opened = match &sandbox {
        // The path comes from untrusted code, which could name any file.
        Some(sandbox) => PlainFile::inside(sandbox.target(), &path, COMPONENT_MAX),
        None => PlainFile::named(&path, COMPONENT_MAX),
    };
    Ok(Compiled { path, opened })
}

fn cargo() -> Command {
    let mut cargo = Command::new(program("CARGO", "cargo"));
    cargo.arg("build");
    cargo
}

/// Adds [`SIMD`] to the compiler flags. Cargo reads flags from one place only, variables first, so
/// they are added to the variable that the user has set, if any.
fn with_simd(cargo: &mut Command, variable: impl Fn(&str) -> Option<OsString>) -> &mut Command {
    for (name, between) in [("CARGO_ENCODED_RUSTFLAGS", "\x1f"), ("RUSTFLAGS", " ")] {
        // An empty variable still takes precedence over configuration files.
        if let Some(mut flags) = variable(name) {
            if !flags.is_empty() {
                flags.push(between);
            }
            flags.push(SIMD);
            return cargo.env(name, flags);
        }
    }
    // Cargo adds these to the flags of the user's configuration files for this target.
    cargo.arg("--config").arg(format!("target.{TARGET}.rustflags=['{SIMD}']"))
}

/// Returns the path of the component in this message of cargo, if it is about the component of
/// `package`.
fn component_in(message: &str, package: &Path) -> Option<PathBuf> {
    let message: Value = serde_json::from_str(message).ok()?;
    let of_package =
        message["manifest_path"].as_str().is_some_and(|path| Path::new(path) == package);
    if message["reason"] != "compiler-artifact" || !of_package {
        return None;
    }
    let kinds = message["target"]["kind"].as_array()?;
    if !kinds.iter().any(|kind| kind == "cdylib") {
        return None;
    }
    let files = message["filenames"].as_array()?;
    files
        .iter()
        .filter_map(Value::as_str)
        .map(PathBuf::from)
        .find(|file| file.extension().is_some_and(|e| e == "wasm"))
}

/// Returns whether the compiler lacks the target's libraries. Called only after a failure, since
/// cargo's own message about it is long, and its advice depends on how Rust was installed.
fn target_is_missing() -> bool {
    let output = Command::new(program("RUSTC", "rustc"))
        .args(["--print", "target-libdir", "--target", TARGET])
        .output();
    output.is_ok_and(|output| {
        let libraries = String::from_utf8_lossy(&output.stdout);
        output.status.success() && !Path::new(libraries.trim()).is_dir()
    })
}

fn program(variable: &str, name: &str) -> PathBuf {
    env::var_os(variable).filter(|value| !value.is_empty()).unwrap_or_else(|| name.into()).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MESSAGE: &str = r#"{"reason":"compiler-artifact","manifest_path":"/l/Cargo.toml",
        "target":{"kind":["cdylib","rlib"],"name":"hello"},
        "filenames":["/t/wasm32-wasip2/release/hello.wasm","/t/wasm32-wasip2/release/libhello.rlib"]}"#;

    #[test]
    fn the_component_is_the_wasm_file_of_the_packages_cdylib() {
        let found = component_in(MESSAGE, Path::new("/l/Cargo.toml"));
        assert_eq!(found, Some("/t/wasm32-wasip2/release/hello.wasm".into()));
    }

    #[test]
    fn simd_is_added_to_the_flags_of_the_user() {
        let build = |set: &'static str, flags: &'static str| {
            let mut cargo = Command::new("cargo");
            with_simd(&mut cargo, |name| (name == set).then(|| flags.into()));
            let variables = cargo
                .get_envs()
                .filter_map(|(name, value)| Some((name.to_owned(), value?.to_owned())));
            let arguments = cargo.get_args().map(ToOwned::to_owned).collect::<Vec<_>>();
            (variables.collect::<Vec<_>>(), arguments)
        };
        let config = "target.wasm32-wasip2.rustflags=['-Ctarget-feature=+simd128']";
        assert_eq!(build("", ""), (vec![], vec!["--config".into(), config.into()]));
        let flags = |name: &str, flags: &str| (vec![(name.into(), flags.into())], vec![]);
        assert_eq!(build("RUSTFLAGS", ""), flags("RUSTFLAGS", "-Ctarget-feature=+simd128"));
        assert_eq!(
            build("RUSTFLAGS", "-Dwarnings"),
            flags("RUSTFLAGS", "-Dwarnings -Ctarget-feature=+simd128")
        );
        assert_eq!(
            build("CARGO_ENCODED_RUSTFLAGS", "-C\x1flto"),
            flags("CARGO_ENCODED_RUSTFLAGS", "-C\x1flto\x1f-Ctarget-feature=+simd128")
        );
    }

    #[test]
    fn other_messages_name_no_component() {
        let package = Path::new("/l/Cargo.toml");
        for message in [
            MESSAGE.replace("/l/", "/dependency/"),
            MESSAGE.replace("cdylib", "lib"),
            MESSAGE.replace("compiler-artifact", "build-script-executed"),
            MESSAGE.replace(".wasm", ".so"),
            "{}".to_owned(),
            "no json".to_owned(),
        ] {
            assert_eq!(component_in(&message, package), None, "{message}");
        }
    }
}
