//! `cargo xtask player`: builds `gleaner-player`. It contains Cyclone DDS, which is C and needs
//! cmake, and libclang for its headers. Missing tools are installed into `.venv`, without root.

use std::env;
use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::steps::{self, Steps};
use crate::venv;

/// Finds or fetches the tools, and builds.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut steps = Steps::of(1);
    steps.begin("gleaner-player with Cyclone DDS (the first time this takes minutes)");
    build(checkout)?;
    println!("built {}", checkout.program("gleaner-player").display());
    Ok(Exit::Ok)
}

pub(crate) fn build(checkout: &Checkout) -> Result<(), Failure> {
    let mut build = cargo(checkout, &compiler())?;
    // With the features of the whole workspace, so that shared dependencies are built once.
    build.args(["build", "--release", "--workspace", "--bin", "gleaner-player"]);
    let help = "if a C compiler is missing, install one (`cc`); else see the first error above";
    steps::run(&mut build, help)
}

/// The C compiler of this machine.
pub(crate) fn compiler() -> String {
    env::var("CC").unwrap_or_else(|_| "cc".to_owned())
}

/// Cargo with the tools for the player, which are fetched if the system lacks them; `compiler` is
/// the one that builds the player.
pub(crate) fn cargo(checkout: &Checkout, compiler: &str) -> Result<Command, Failure> {
    let lacks_cmake = !steps::succeeds(checkout.command("cmake").arg("--version"));
    let lacks_libclang = env::var_os("LIBCLANG_PATH").is_none() && !has_libclang();
    if lacks_cmake || lacks_libclang {
        fetch(checkout)?;
    }
    let mut cargo = checkout.cargo();
    if lacks_cmake {
        cargo.env("PATH", path_with(checkout.path(".venv/bin"))?);
    }
    if lacks_libclang {
        cargo.env("LIBCLANG_PATH", fetched_libclang(checkout)?);
    }
    // libclang has no stddef.h and the like, and needs the path of those of the C compiler.
    if env::var_os("BINDGEN_EXTRA_CLANG_ARGS").is_none() {
        cargo.env("BINDGEN_EXTRA_CLANG_ARGS", format!("-I{}", headers(checkout, compiler)?));
    }
    Ok(cargo)
}

/// Returns whether libclang is in a folder that the crate `clang-sys` searches.
fn has_libclang() -> bool {
    let folders =
        ["/usr/lib", "/usr/lib64", "/usr/local/lib", "/usr/local/lib64"].map(PathBuf::from);
    // Distributions have subfolders for the architecture and for each version of LLVM.
    let deeper =
        folders.iter().flat_map(|folder| entries(folder)).flat_map(|path| [path.join("lib"), path]);
    deeper
        .chain(folders.iter().cloned())
        .any(|folder| entries(&folder).iter().any(|path| is_libclang(path)))
}

fn is_libclang(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    // Not libclang-cpp, another library.
    let has_version = name
        .strip_prefix("libclang-")
        .is_some_and(|rest| rest.starts_with(|c: char| c.is_ascii_digit()));
    name.starts_with("libclang.so") || has_version && name.contains(".so")
}

fn entries(folder: &Path) -> Vec<PathBuf> {
    fs::read_dir(folder)
        .into_iter()
        .flatten()
        .filter_map(|entry| Some(entry.ok()?.path()))
        .collect()
}

/// Installs both into `.venv`; pip skips installed packages.
fn fetch(checkout: &Checkout) -> Result<(), Failure> {
    venv::set_up(checkout)?;
    let help = "check the network, or install both packages of the system";
    venv::pip(checkout.command(checkout.python()), &["cmake", "libclang"], help)
}

fn path_with(folder: PathBuf) -> Result<OsString, Failure> {
    let path = env::var_os("PATH").unwrap_or_default();
    env::join_paths(env::split_paths(&path).chain([folder])).map_err(|error| {
        let message = "the path of the checkout cannot be part of PATH";
        Failure::caused_by(Exit::Internal, message, &error)
    })
}

fn fetched_libclang(checkout: &Checkout) -> Result<PathBuf, Failure> {
    let mut python = checkout.command(checkout.python());
    let code = "import clang, os; print(os.path.join(list(clang.__path__)[0], 'native'))";
    python.args(["-I", "-c", code]);
    let folder = steps::output(&mut python, "remove .venv, and run this again")?;
    Ok(PathBuf::from(folder.trim()))
}

/// Returns the folder with the headers of a C compiler.
pub(crate) fn headers(checkout: &Checkout, compiler: &str) -> Result<String, Failure> {
    let mut compiler = checkout.command(compiler);
    compiler.arg("-print-file-name=include");
    let folder = steps::output(&mut compiler, "install a C compiler (`cc`)")?;
    Ok(folder.trim().to_owned())
}
