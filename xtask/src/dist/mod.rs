//! `cargo xtask dist`: a tarball for machines without a toolchain, and the Debian packages, with
//! the sums of all files. Programs are checked to run with the C library of JetPack 6.

mod tarball;

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};

use crate::aarch64::Tools;
use crate::checkout::{Checkout, FAMILIES};
use crate::deb::{self, PackageOptions, PackagedCommit};
use crate::steps::{self, Steps, cannot};
use crate::{glibc, setup};
use tarball::TARBALL;

pub(crate) const USAGE: &str =
    "usage: cargo xtask dist [--target aarch64|x86_64] [--out DIR] [--programs DIR] [--install]
  --target    architecture of the programs; default: that of this machine
  --out       folder for the files; default: dist/TARGET in the target folder
  --programs  folder with the built programs; default: build them
  --install   as root: install the compilers for the target first";

/// The package of cargo, and its program, that only the tarball has.
const BENCH: &str = "gleaner-bench";

pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let options = PackageOptions::parse(arguments, USAGE)?;
    let (architecture, machine) = (options.architecture, options.architecture.machine());
    let checkout = &deb::with_commit(checkout);
    let mut steps = Steps::of(setup::STEPS + deb::ALL_STEPS + 4);
    steps.begin(&format!("tools for {machine}"));
    check_compilers(checkout, &options)?;
    deb::check_tools(checkout, architecture)?;
    setup::run(checkout, &mut steps, &checkout.lambdas(&FAMILIES))?;
    steps.begin(&format!("programs for {machine} (the first time this takes half an hour)"));
    let programs = deb::programs(checkout, architecture, options.programs, &[BENCH])?;
    println!("{}", programs.display());
    steps.begin(&format!("the C library that they need, at most {}", glibc::OF_JETPACK));
    let names = TARBALL.programs.iter().copied().flatten();
    let files: Vec<_> = names.map(|(name, _)| programs.join(name)).collect();
    if let Some(newest) = glibc::check(checkout, &files, glibc::OF_JETPACK)? {
        println!("{} programs need glibc {newest} or newer", files.len());
    }
    let packages = deb::packages(checkout, &mut steps, architecture, &programs)?;
    steps.begin("tarball");
    let out = options.out.unwrap_or_else(|| folder(checkout).join(machine));
    fs::create_dir_all(&out).map_err(|error| cannot("create", &out, &error))?;
    let commit = PackagedCommit::of(checkout);
    let work = folder(checkout).join("tree");
    let mut made = vec![tarball::create(checkout, &work, &out, &programs, architecture, &commit)?];
    for package in packages {
        let copy = out.join(package.file_name().unwrap_or_default());
        fs::copy(&package, &copy).map_err(|error| cannot("copy", &package, &error))?;
        made.push(copy);
    }
    write_sums(checkout, &out, &made)?;
    for file in &made {
        println!("{} ({} MiB)", file.display(), deb::size_mib(file));
    }
    Ok(Exit::Ok)
}

fn folder(checkout: &Checkout) -> PathBuf {
    checkout.target().join("dist")
}

/// Finds or installs the compilers for another architecture. With the programs built, only binutils
/// are needed.
fn check_compilers(checkout: &Checkout, options: &PackageOptions) -> Result<(), Failure> {
    if options.architecture.is_of_this_machine() {
        Ok(())
    } else if options.install {
        Tools::install(checkout).map(drop)
    } else if options.programs.is_none() {
        Tools::find(checkout).map(drop)
    } else {
        Ok(())
    }
}

fn write_sums(checkout: &Checkout, out: &Path, files: &[PathBuf]) -> Result<(), Failure> {
    let mut sums = checkout.command("sha256sum");
    sums.current_dir(out).args(files.iter().filter_map(|file| file.file_name()));
    let text = steps::output(&mut sums, "see the error above")?;
    let path = out.join("SHA256SUMS");
    fs::write(&path, text).map_err(|error| cannot("write", &path, &error))
}
