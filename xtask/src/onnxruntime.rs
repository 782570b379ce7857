//! The library of ONNX Runtime, from its wheel for Python: the demo, the tests and the packages use
//! the same one.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{self, Command};

use gleaner_base::Failure;

use crate::architecture::Architecture;
use crate::checkout::Checkout;
use crate::steps::{self, cannot};
use crate::venv;

/// Its version, which `cargo xtask models` tests.
const VERSION: &str = "1.32.0";

/// SHA-256 of its wheels for Python 3.11 on x86-64 and on aarch64. The version of Python does not
/// matter: only the library is used.
const SHA256: [&str; 2] = [
    "5a34fc4dfeb5a7b4a74c95dcba1e773d722abda720b474edf1b0c419dc6d163d",
    "2303372a85299b6757b0e11e1cbf13e410ddf7e10c37f4b37e99d1c90e7daf7c",
];

/// The environment variable with the path of the library.
const VARIABLE: &str = "ORT_DYLIB_PATH";

/// Files of the wheel that a copy of the library needs.
pub(crate) const LICENCES: [&str; 2] = ["LICENSE", "ThirdPartyNotices.txt"];

/// Fetches the wheel, unless that was done before, and returns the folder of its package. If it
/// cannot be fetched, prints the reason, and that models run by rten.
pub(crate) fn fetch(checkout: &Checkout, architecture: Architecture) -> Option<PathBuf> {
    let (folder, machine) = (folder(checkout, architecture), architecture.machine());
    if !folder.exists()
        && let Err(failure) = download(checkout, machine, &folder)
    {
        println!("{failure}\nskipped: no ONNX Runtime for {machine}, so models run by rten");
        return None;
    }
    Some(folder.join("onnxruntime"))
}

/// Returns the path of the library in the folder that [`fetch`] returns.
pub(crate) fn library(package: &Path) -> PathBuf {
    package.join(format!("capi/libonnxruntime.so.{VERSION}"))
}

/// A command of a program that cargo built and that may run models.
pub(crate) fn with_models(checkout: &Checkout, program: &str) -> Command {
    let mut command = checkout.command(checkout.program(program));
    pass_to(checkout, &mut command);
    command
}

/// Passes the path of the fetched library to `command`, if there is one, unless the user has named
/// another one.
pub(crate) fn pass_to(checkout: &Checkout, command: &mut Command) {
    let folder = folder(checkout, Architecture::of_this_machine());
    let library = library(&folder.join("onnxruntime"));
    if library.is_file() && env::var_os(VARIABLE).is_none() {
        command.env(VARIABLE, library);
    }
}

fn folder(checkout: &Checkout, architecture: Architecture) -> PathBuf {
    checkout.target().join(format!("onnxruntime-{VERSION}-{}", architecture.machine()))
}

fn download(checkout: &Checkout, machine: &str, folder: &Path) -> Result<(), Failure> {
    venv::set_up(checkout)?;
    // Another process may fetch it, too.
    let unfinished = checkout.target().join(format!("onnxruntime-new-{}", process::id()));
    let _ = fs::remove_dir_all(&unfinished);
    // pip takes sums from such a file only.
    let requirements = unfinished.with_extension("txt");
    let sums = SHA256.map(|sum| format!(" --hash=sha256:{sum}")).concat();
    fs::write(&requirements, format!("onnxruntime=={VERSION}{sums}\n"))
        .map_err(|error| cannot("write", &requirements, &error))?;
    let mut pip = checkout.command(checkout.python());
    pip.args("-m pip install -q --disable-pip-version-check --no-deps --no-compile".split(' '));
    pip.args("--only-binary=:all: --python-version=3.11 --require-hashes".split(' '));
    pip.arg(format!("--platform=manylinux_2_28_{machine}"));
    pip.arg("--requirement").arg(&requirements).arg("--target").arg(&unfinished);
    let help = format!("pip fetches onnxruntime {VERSION}: {}", venv::NETWORK);
    steps::download(&mut pip, &help)?;
    let _ = fs::remove_file(&requirements);
    match fs::rename(&unfinished, folder) {
        Err(_) if folder.exists() => fs::remove_dir_all(&unfinished),
        moved => moved,
    }
    .map_err(|error| cannot("move", &unfinished, &error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_of_licences_and_the_tests_of_models_name_the_same_wheels() {
        let page = include_str!("../../THIRD_PARTY.md");
        for text in [&[VERSION][..], &SHA256].concat() {
            assert!(page.contains(text), "{text}");
        }
        assert!(include_str!("models.rs").contains(&format!("onnxruntime=={VERSION}")));
    }
}
