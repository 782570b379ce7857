//! `cargo xtask dist`: a tarball for machines without a toolchain, and the Debian packages, with
//! the sums of all files. Programs are checked to run with the C library of JetPack 6.

mod tarball;

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};

use crate::aarch64::{self, Tools};
use crate::architecture::Architecture;
use crate::checkout::{Checkout, FAMILIES};
use crate::deb::{self, PackagedCommit};
use crate::steps::{self, Steps, cannot};
use crate::{glibc, player, setup};
use tarball::TARBALL;

const USAGE: &str =
    "usage: cargo xtask dist [--target aarch64|x86_64] [--out DIR] [--programs DIR] [--install]
  --target    architecture of the programs; default: that of this machine
  --out       folder for the files; default: dist/TARGET in the target folder
  --programs  folder with the built programs; default: build them
  --install   as root: install the compilers for the target first";

/// Packages of cargo with programs of the tarball that are in no other package.
const BENCH: [&str; 2] = ["gleaner-bench", "gleaner-player"];

#[derive(Debug, PartialEq, Eq)]
struct DistOptions {
    architecture: Architecture,
    out: Option<PathBuf>,
    programs: Option<PathBuf>,
    install: bool,
}

impl DistOptions {
    fn parse(arguments: &[OsString]) -> Result<Self, Failure> {
        let architecture = Architecture::of_this_machine();
        let mut options = Self { architecture, out: None, programs: None, install: false };
        let mut arguments = arguments.iter();
        while let Some(argument) = arguments.next() {
            let mut value = || arguments.next().ok_or_else(usage);
            match argument.to_str() {
                Some("--install") => options.install = true,
                Some("--out") => options.out = Some(value()?.into()),
                Some("--programs") => options.programs = Some(value()?.into()),
                Some("--target") => {
                    let name = value()?;
                    let known = Architecture::ALL.into_iter().find(|it| name == it.machine());
                    options.architecture = known.ok_or_else(usage)?;
                }
                _ => return Err(usage()),
            }
        }
        let is_built_here = options.architecture.is_of_this_machine()
            || options.architecture == Architecture::Arm64;
        if !is_built_here && options.programs.is_none() {
            return Err(Failure::new(Exit::Usage, "this machine builds no programs for x86_64")
                .with_help("build them elsewhere, and name their folder with --programs DIR"));
        }
        Ok(options)
    }
}

fn usage() -> Failure {
    Failure::new(Exit::Usage, "`cargo xtask dist` does not take these arguments").with_help(USAGE)
}

/// Builds everything.
pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let options = DistOptions::parse(arguments)?;
    let (architecture, machine) = (options.architecture, options.architecture.machine());
    let mut steps = Steps::of(setup::STEPS + deb::ALL_STEPS + 4);
    steps.begin(&format!("tools for {machine}"));
    let tools = tools(checkout, &options)?;
    deb::check_tools(checkout, architecture)?;
    setup::run(checkout, &mut steps, &checkout.lambdas(&FAMILIES))?;
    steps.begin(&format!("programs for {machine} (the first time this takes half an hour)"));
    let programs = match (&options.programs, &tools) {
        (Some(folder), _) => folder.clone(),
        (None, Some(tools)) => aarch64::programs_with_player(checkout, tools, &BENCH)?,
        (None, None) => {
            setup::binary(checkout, "gleaner-bench")?;
            player::build(checkout)?;
            checkout.target().join("release")
        }
    };
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

/// Finds or installs the tools for another architecture; `None` if none are needed.
fn tools(checkout: &Checkout, options: &DistOptions) -> Result<Option<Tools>, Failure> {
    if options.architecture.is_of_this_machine() {
        return Ok(None);
    }
    if options.install {
        return Tools::install(checkout).map(Some);
    }
    // With the programs built, only binutils are needed.
    if options.programs.is_some() { Ok(None) } else { Tools::find(checkout).map(Some) }
}

/// Writes the sums of all files beside them.
fn write_sums(checkout: &Checkout, out: &Path, files: &[PathBuf]) -> Result<(), Failure> {
    let mut sums = checkout.command("sha256sum");
    sums.current_dir(out).args(files.iter().filter_map(|file| file.file_name()));
    let text = steps::output(&mut sums, "see the error above")?;
    let path = out.join("SHA256SUMS");
    fs::write(&path, text).map_err(|error| cannot("write", &path, &error))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(arguments: &[&str]) -> Option<DistOptions> {
        DistOptions::parse(&arguments.iter().map(OsString::from).collect::<Vec<_>>()).ok()
    }

    #[test]
    fn options_name_a_target_of_cargo() {
        let options = parse(&["--target", "aarch64", "--out", "here", "--install"]).unwrap();
        assert_eq!(options.architecture, Architecture::Arm64);
        assert_eq!((options.out, options.install), (Some("here".into()), true));
        assert_eq!(parse(&[]).unwrap().architecture, Architecture::of_this_machine());
        let built = parse(&["--target", "x86_64", "--programs", "built"]).unwrap();
        assert_eq!(
            (built.architecture, built.programs),
            (Architecture::Amd64, Some("built".into()))
        );
        for wrong in [&["--target"][..], &["--target", "arm64"], &["--out"], &["aarch64"]] {
            assert_eq!(parse(wrong), None, "{wrong:?}");
        }
    }
}
