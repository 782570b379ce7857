//! Metadata of the package: version, libraries, sums and scripts.

use std::path::Path;

use gleaner_base::Failure;

use super::answer;
use super::source::{LIB, PackageSource};
use super::tree::{self, PackageTree};
use crate::architecture::Architecture;
use crate::checkout::Checkout;
use crate::glibc::GlibcNeeds;
use crate::steps;

/// Scripts that dpkg runs.
const SCRIPTS: [&str; 3] = ["postinst", "prerm", "postrm"];

pub(crate) struct PackagedCommit {
    pub(crate) version: String,
    /// Its time, in s since 1970: files of packages get it, so that the same files become the same
    /// package.
    pub(crate) time: String,
    /// The same in the format of mails.
    date: String,
}

pub(super) struct PackageMetadata {
    source: &'static PackageSource,
    architecture: Architecture,
    libraries: String,
    pub(super) commit: PackagedCommit,
}

impl PackagedCommit {
    pub(crate) fn of(checkout: &Checkout) -> Self {
        let mut log = checkout.command("git");
        let date = "--date=format-local:%Y%m%d%H%M%S";
        let commit = answer(log.args(["log", "-1", "--format=%cd.%h%n%ct%n%cD", date]));
        let mut lines = commit.iter().flat_map(|text| text.lines()).map(str::to_owned);
        // A later commit is a later version, so that `apt` upgrades to it.
        let release = env!("CARGO_PKG_VERSION");
        let version = lines.next().map_or(release.to_owned(), |it| format!("{release}+{it}"));
        let time = lines.next().unwrap_or_else(|| "0".to_owned());
        let date = lines.next().unwrap_or_else(|| "Thu, 01 Jan 1970 00:00:00 +0000".to_owned());
        Self { version, time, date }
    }
}

/// Returns the checkout for builds whose programs print the commit: its first 8 digits, followed
/// by `.dirty` if tracked files differ from it.
pub(crate) fn with_commit(checkout: &Checkout) -> Checkout {
    let mut describe = checkout.command("git");
    describe.args(["describe", "--always", "--exclude=*", "--abbrev=8", "--dirty=.dirty"]);
    let commit = answer(&mut describe);
    if commit.is_none() {
        println!("the programs will print no commit: `git describe` has failed");
    }
    checkout.with_commit(commit)
}

impl PackageMetadata {
    pub(super) fn collect(
        checkout: &Checkout,
        tree: &PackageTree,
        architecture: Architecture,
        source: &'static PackageSource,
    ) -> Result<Self, Failure> {
        let found =
            if architecture.is_of_this_machine() { libraries(checkout, tree)? } else { None };
        let libraries = match found {
            Some(found) => found,
            None => libraries_by_version(checkout, tree)?,
        };
        Ok(Self { source, architecture, libraries, commit: PackagedCommit::of(checkout) })
    }

    pub(super) fn file_name(&self) -> String {
        format!("{}_{}_{}.deb", self.source.name, self.commit.version, self.architecture.name())
    }

    pub(super) fn write_changelog(
        &self,
        checkout: &Checkout,
        tree: &PackageTree,
    ) -> Result<(), Failure> {
        let control = tree::read(&checkout.path(self.source.folder).join("debian/control"))?;
        let maintainer = control.lines().find_map(|line| line.strip_prefix("Maintainer: "));
        let entry = format!(
            "{} ({}) unstable; urgency=medium\n\n  * CHANGELOG.md in this folder lists what \
             changes for users.\n\n -- {}  {}\n",
            self.source.name,
            self.commit.version,
            maintainer.unwrap_or_default(),
            self.commit.date
        );
        tree.write(&format!("{}/changelog", self.source.doc()), &entry).map(drop)
    }

    pub(super) fn write(&self, checkout: &Checkout, tree: &PackageTree) -> Result<(), Failure> {
        let files = tree.files()?;
        let kib = |file: &Path| file.metadata().map_or(0, |data| data.len().div_ceil(1024));
        let size: u64 = files.iter().map(|file| kib(file)).sum();
        let folder = checkout.path(self.source.folder).join("debian");
        let control = tree::read(&folder.join("control"))?
            .replace("@VERSION@", &self.commit.version)
            .replace("@ARCHITECTURE@", self.architecture.name())
            .replace("@LIBRARIES@", &self.libraries)
            .replace("@INSTALLED_SIZE@", &size.to_string());
        let relative = |file: &Path| file.strip_prefix(tree.root()).unwrap_or(file).to_owned();
        let mut sums = checkout.command("md5sum");
        sums.current_dir(tree.root())
            .args(files.iter().map(|file| relative(file)).filter(|file| !file.starts_with("etc")));
        let sums = steps::output(&mut sums, "see the error above")?;
        tree.write("DEBIAN/control", &control)?;
        tree.write("DEBIAN/md5sums", &sums)?;
        tree.write("DEBIAN/conffiles", &tree::read(&folder.join("conffiles"))?)?;
        for script in SCRIPTS {
            let text = tree::read(&folder.join(script))?;
            let file = tree.write(&format!("DEBIAN/{script}"), &text)?;
            tree::set_mode(&file, 0o755)?;
        }
        Ok(())
    }
}

/// Finds the packages with the libraries of all programs; `None` without `dpkg-shlibdeps`.
fn libraries(checkout: &Checkout, tree: &PackageTree) -> Result<Option<String>, Failure> {
    if !steps::succeeds(checkout.command("dpkg-shlibdeps").arg("--version")) {
        println!(
            "skipped: dpkg-shlibdeps is not installed (dpkg-dev); libraries by their versions"
        );
        return Ok(None);
    }
    // It reads `debian/control` of a source package.
    let folder = checkout.target().join("deb/shlibdeps");
    let control = "Source: gleaner\n\nPackage: gleaner\nArchitecture: any\n";
    steps::write_file(&folder.join("debian/control"), control)?;
    let mut find = checkout.command("dpkg-shlibdeps");
    // The extension module's symbols of Python are those of the interpreter that loads it.
    find.current_dir(&folder).args(["-O", "--warnings=0"]);
    let folders = ["usr/bin", LIB].map(|folder| tree.root().join(folder));
    for file in tree.files()? {
        let is_program = folders.iter().any(|folder| file.parent() == Some(folder));
        if is_program && is_elf(&file) {
            find.arg("-e").arg(file);
        }
    }
    // Its remarks are on the place of the programs.
    let text = answer(&mut find).unwrap_or_default();
    Ok(text.trim().strip_prefix("shlibs:Depends=").map(str::to_owned))
}

/// Returns the libraries, with the newest version of the C library that a program names. For
/// another architecture `dpkg-shlibdeps` would need its packages.
fn libraries_by_version(checkout: &Checkout, tree: &PackageTree) -> Result<String, Failure> {
    let (mut newest, files) = (None, tree.files()?);
    for file in files.iter().filter(|file| is_elf(file)) {
        newest = newest.max(GlibcNeeds::of(checkout, file)?.newest());
    }
    let libc6 = newest.map_or("libc6".to_owned(), |newest| format!("libc6 (>= {newest})"));
    // ONNX Runtime needs GLIBCXX_3.4.22 at most.
    let has_models = files.iter().any(|file| file.to_string_lossy().contains("/libonnxruntime."));
    let libstdcpp = if has_models { ", libstdc++6 (>= 6)" } else { "" };
    Ok(format!("{libc6}, libgcc-s1 (>= 4.2){libstdcpp}"))
}

fn is_elf(file: &Path) -> bool {
    use std::io::Read;
    let mut start = [0; 4];
    let read = std::fs::File::open(file).and_then(|mut file| file.read_exact(&mut start));
    read.is_ok() && start == *b"\x7fELF"
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn programs_of_packages_get_the_commit_and_whether_files_differ() {
        let folder = TestFolder::new();
        let checkout = Checkout::with_cargo(folder.root().to_owned(), "cargo".into());
        let commit = || {
            let cargo = with_commit(&checkout).cargo();
            let mut variables = cargo.get_envs();
            let found = variables.find(|(name, _)| *name == "GLEANER_COMMIT");
            found.and_then(|(_, value)| Some(value?.to_str()?.to_owned()))
        };
        assert_eq!(commit(), None);
        folder.write("file", "one");
        let head = checkout.commit_all()[..8].to_owned();
        assert_eq!(commit().as_ref(), Some(&head));
        folder.write("file", "two");
        assert_eq!(commit(), Some(head + ".dirty"));
    }
}
