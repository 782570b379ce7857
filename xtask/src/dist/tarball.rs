//! The tarball: a folder that runs where it is unpacked, with the programs of the packages and of
//! the bench, and the built lambdas and scripts that the bench needs.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use gleaner_base::Failure;

use super::BENCH;
use crate::architecture::Architecture;
use crate::checkout::{Checkout, FAMILIES};
use crate::deb::{PLAYER, PackageSource, PackageTree, PackagedCommit, VEHICLE_PROGRAMS};
use crate::setup;
use crate::steps::{self, cannot};

/// Its content, laid out like that of a package below `usr`, where the programs find each other.
pub(super) const TARBALL: PackageSource = PackageSource {
    name: "gleaner",
    folder: "",
    programs: &[&VEHICLE_PROGRAMS, &[("gleaner-cloud", "usr/bin"), (BENCH, "usr/bin")]],
    files: &[("LICENSE", "usr/LICENSE"), ("xtask/src/dist/README", "usr/README")],
    cargo_packages: &[&setup::PROGRAMS, &[BENCH, PLAYER]],
    has_command: true,
    // It has no service.
    exposure_max: 0,
};

/// Folders of the checkout whose files are in it, at the same places, with the builds of lambdas.
const FOLDERS: [&str; 6] = [
    "bench/analysis",
    "bench/baselines",
    "bench/lambdas",
    "examples",
    "tests/lambdas/attack",
    "wit",
];
const FILES: [&str; 1] = ["bench/rosbags_loop.py"];

/// Creates it in `out`, and returns its path. `work` is a folder for its tree.
pub(super) fn create(
    checkout: &Checkout,
    work: &Path,
    out: &Path,
    programs: &Path,
    architecture: Architecture,
    commit: &PackagedCommit,
) -> Result<PathBuf, Failure> {
    let tree = PackageTree::create(checkout, work, programs, architecture, &TARBALL)?;
    let mut tracked = checkout.command("git");
    tracked.args(["ls-files", "--"]).args(FOLDERS).args(FILES);
    let tracked = steps::output(&mut tracked, "run it in a clone of the repository")?;
    for file in tracked.lines() {
        tree.place(&checkout.path(file), &Path::new("usr").join(file))?;
    }
    for lambda in checkout.lambdas(&FAMILIES) {
        if FOLDERS.iter().any(|folder| lambda.starts_with(folder)) {
            let (from, to) = (checkout.path(&lambda), tree.root().join("usr").join(&lambda));
            steps::copy_files(&from.join("build"), &to.join("build"))
                .map_err(|error| cannot("copy", &from, &error))?;
        }
    }
    let mut revision = checkout.command("git");
    revision.args(["describe", "--always", "--dirty", "--abbrev=12"]);
    tree.write("usr/REVISION", &steps::output(&mut revision, "see the error above")?)?;
    tree.finish()?;
    let name = format!("gleaner-{}-{}", commit.version, architecture.machine());
    let (from, to) = (tree.root().join("usr"), tree.root().join(&name));
    fs::rename(&from, &to).map_err(|error| cannot("move", &from, &error))?;
    let file = out.join(format!("{name}.tar.gz"));
    pack(checkout, tree.root(), &name, &commit.time, &file)?;
    Ok(file)
}

/// Packs the folder `name` in `root` into `file`. The same files become the same bytes: they are
/// sorted, of `time`, and have no names of owners.
fn pack(
    checkout: &Checkout,
    root: &Path,
    name: &str,
    time: &str,
    file: &Path,
) -> Result<(), Failure> {
    let mut tar = checkout.command("tar");
    tar.args(["--create", "--sort=name", "--format=gnu", "--owner=0", "--group=0"]);
    tar.args(["--numeric-owner", "--use-compress-program=gzip -9n"]);
    tar.arg(format!("--mtime=@{time}")).arg("--directory").arg(root);
    tar.arg("--file").arg(file).arg("--").arg(OsStr::new(name));
    steps::run(&mut tar, "GNU tar and gzip are needed; see the error above")
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::process::Command;

    use super::*;
    use gleaner_test_support::TestFolder;

    /// Texts of the program's source after `call("`, up to the next quotation mark.
    fn arguments(folder: &Path, call: &str, found: &mut BTreeSet<String>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                arguments(&path, call, found);
                continue;
            }
            let text = fs::read_to_string(&path).unwrap();
            let begin = format!("{call}(\"");
            let calls = text.split(&begin).skip(1);
            found.extend(calls.filter_map(|rest| Some(rest.split_once('"')?.0.to_owned())));
        }
    }

    #[test]
    fn everything_that_the_bench_reads_and_starts_is_in_it() {
        let source = Checkout::find().unwrap().path("bench/src");
        let (mut files, mut programs) = (BTreeSet::new(), BTreeSet::new());
        arguments(&source, "root().join", &mut files);
        // Written there, or not needed.
        files.retain(|file| !file.starts_with("target/") && !file.starts_with(".venv/"));
        assert!(files.remove("REVISION") && files.len() > 3, "{files:?}");
        let is_in_it = |file: &&String| {
            FOLDERS.iter().any(|folder| Path::new(file).starts_with(folder))
                || FILES.contains(&&***file)
        };
        let missing: Vec<_> = files.iter().filter(|file| !is_in_it(file)).collect();
        assert!(missing.is_empty(), "{missing:?}");
        arguments(&source, "program", &mut programs);
        assert!(programs.contains("gleaner-shim"), "{programs:?}");
        let packed = TARBALL.programs.iter().copied().flatten();
        let packed: BTreeSet<_> = packed.map(|(name, _)| (*name).to_owned()).collect();
        assert!(packed.is_superset(&programs), "{programs:?}");
    }

    #[test]
    fn the_same_files_become_the_same_bytes() {
        let checkout = Checkout::find().unwrap();
        let folder = TestFolder::new();
        let packed = |names: [&str; 2], file: &str| {
            let _ = fs::remove_dir_all(folder.path("a"));
            names.iter().for_each(|name| drop(folder.write(&format!("a/{name}"), name)));
            let file = folder.path(file);
            pack(&checkout, folder.root(), "a", "86400", &file).unwrap();
            file
        };
        let files = [packed(["x", "y"], "1.tar.gz"), packed(["y", "x"], "2.tar.gz")];
        let list =
            Command::new("tar").arg("-tvf").arg(&files[1]).env("TZ", "UTC").output().unwrap();
        let bytes = files.map(|file| fs::read(file).unwrap());
        assert_eq!(bytes[0], bytes[1]);
        let list = String::from_utf8(list.stdout).unwrap();
        let lines: Vec<_> = list.lines().collect();
        assert!(lines[1].contains(" 0/0 ") && lines[1].ends_with("1970-01-02 00:00 a/x"), "{list}");
        assert!(lines[2].ends_with("a/y"), "{list}");
    }
}
