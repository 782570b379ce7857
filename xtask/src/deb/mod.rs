//! `cargo xtask deb`: builds the Debian packages `gleaner`, with the service of a vehicle, and
//! `gleaner-cloud`, with that of the cloud.
//!
//! `source` lists what they consist of, `tree` lays out their files, `control` writes their
//! metadata, `licences` collects those of crates, `unit` checks the services with
//! `systemd-analyze`, and `in-roots.sh` tests the packages in roots of their own. The files that
//! are not built are in `orchestrator/package` and `cloud/package`.
//!
//! cargo-deb is not used: it takes the description of a package of cargo, leaves out libgcc and
//! sums of files, and names libraries once for each program, for another architecture only where
//! its packages are installed. cargo-about is not used: it leaves out notices, licences of sources
//! in C, and each but one of the licences that a crate offers.

mod control;
mod licences;
mod options;
mod source;
mod tree;
mod unit;

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};

use crate::architecture::Architecture;
use crate::checkout::Checkout;
use crate::steps::{self, Steps};
use crate::{aarch64, player, setup};
use control::PackageMetadata;
pub(crate) use control::{PackagedCommit, with_commit};
pub(crate) use options::PackageOptions;
use source::PACKAGES;
pub(crate) use source::{PLAYER, PackageSource, VEHICLE_PROGRAMS};
pub(crate) use tree::PackageTree;

const USAGE: &str = "usage: cargo xtask deb [--arch amd64|arm64] [--programs DIR] [--test]
  --arch      architecture of the packages; default: that of this machine
  --programs  folder with the built programs; default: build them
  --test      as root: install, run, upgrade and purge each in a root that debootstrap makes";

/// Builds the packages, and tests them if that is wanted.
pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let options = PackageOptions::parse(arguments, USAGE)?;
    let architecture = options.architecture;
    let checkout = &with_commit(checkout);
    check_tools(checkout, architecture)?;
    let each = if options.test { STEPS + 1 } else { STEPS };
    let mut steps = Steps::of(1 + PACKAGES.len() * each);
    steps.begin(&format!("programs for {}", architecture.name()));
    let programs = programs(checkout, architecture, options.programs, &[])?;
    println!("{}", programs.display());
    for source in &PACKAGES {
        let package = package(checkout, &mut steps, architecture, &programs, source)?;
        if options.test {
            steps.begin(&format!("{}: installation in a root of its own", source.name));
            let mut test = checkout.command("bash");
            test.args(["-c", include_str!("in-roots.sh"), "in-roots"]).arg(package);
            test.arg(folder(checkout)).arg(source.folder);
            test.args(source.has_command.then_some("lambdas"));
            let ended = steps::run_script(&mut test)?;
            if ended != Exit::Ok {
                return Ok(ended);
            }
        }
    }
    Ok(Exit::Ok)
}

const STEPS: usize = 3;
pub(crate) const ALL_STEPS: usize = PACKAGES.len() * STEPS;

/// Builds all packages from the programs in a folder, and returns their files.
pub(crate) fn packages(
    checkout: &Checkout,
    steps: &mut Steps,
    architecture: Architecture,
    programs: &Path,
) -> Result<Vec<PathBuf>, Failure> {
    let build = |source| package(checkout, steps, architecture, programs, source);
    PACKAGES.iter().map(build).collect()
}

pub(crate) fn check_tools(checkout: &Checkout, architecture: Architecture) -> Result<(), Failure> {
    let strip = architecture.strip();
    steps::require(checkout, &[("dpkg-deb", "dpkg"), ("gzip", "gzip"), (strip, "binutils")])
}

fn folder(checkout: &Checkout) -> PathBuf {
    checkout.target().join("deb")
}

fn package(
    checkout: &Checkout,
    steps: &mut Steps,
    architecture: Architecture,
    programs: &Path,
    source: &'static PackageSource,
) -> Result<PathBuf, Failure> {
    let name = source.name;
    steps.begin(&format!("{name}: files"));
    let work = folder(checkout);
    let root = work.join(architecture.name()).join(name);
    let tree = PackageTree::create(checkout, &root, programs, architecture, source)?;
    let metadata = PackageMetadata::collect(checkout, &tree, architecture, source)?;
    metadata.write_changelog(checkout, &tree)?;
    tree.finish()?;
    steps.begin(&format!("{name}: service"));
    unit::check(checkout, &tree, &work, source)?;
    steps.begin(&format!("{name}: package"));
    metadata.write(checkout, &tree)?;
    let package = work.join(metadata.file_name());
    build(checkout, &tree, &package, &metadata)?;
    lint(checkout, &package, source)?;
    println!("built {} ({} MiB)", package.display(), size_mib(&package));
    Ok(package)
}

/// Builds the programs of the packages and `others`, unless `built` is their folder; returns their
/// folder.
pub(crate) fn programs(
    checkout: &Checkout,
    architecture: Architecture,
    built: Option<PathBuf>,
    others: &[&str],
) -> Result<PathBuf, Failure> {
    if let Some(folder) = built {
        return Ok(folder);
    }
    if !architecture.is_of_this_machine() {
        return aarch64::programs(checkout, &[others, &[PLAYER]].concat());
    }
    setup::programs(checkout)?;
    if !others.is_empty() {
        setup::binaries(checkout, others)?;
    }
    player::build(checkout)?;
    Ok(checkout.target().join("release"))
}

fn build(
    checkout: &Checkout,
    tree: &PackageTree,
    package: &Path,
    metadata: &PackageMetadata,
) -> Result<(), Failure> {
    let mut build = checkout.command("dpkg-deb");
    // No file is newer than the commit: the same files become the same package.
    build.env("SOURCE_DATE_EPOCH", &metadata.commit.time);
    build.args(["--build", "--root-owner-group", "-Zxz"]).arg(tree.root()).arg(package);
    steps::run(&mut build, "see the error above")
}

/// Runs lintian, if it is installed. Its remarks are shown; errors fail.
fn lint(checkout: &Checkout, package: &Path, source: &PackageSource) -> Result<(), Failure> {
    if !steps::succeeds(checkout.command("lintian").arg("--version")) {
        println!("skipped: lintian is not installed");
        return Ok(());
    }
    let overrides = checkout.path(source.folder).join("debian/lintian");
    let suppressed = tree::read(&overrides)?;
    let tags: Vec<&str> =
        suppressed.lines().filter(|line| !line.is_empty() && !line.starts_with('#')).collect();
    let mut lintian = checkout.command("lintian");
    lintian.args(["--allow-root", "--fail-on", "error", "--suppress-tags"]);
    lintian.arg(tags.join(",")).arg(package);
    steps::run(&mut lintian, "mend the package, or add the tag with its reason to `lintian`")
}

pub(crate) fn size_mib(file: &Path) -> u64 {
    file.metadata().map_or(0, |data| data.len().div_ceil(1 << 20))
}

/// Runs `command`, and returns its output; `None` if it fails or the program is missing.
fn answer(command: &mut Command) -> Option<String> {
    let output = command.stderr(std::process::Stdio::null()).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}
