//! The files of a package, as they lie on its machine.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use gleaner_base::Failure;

use super::licences;
use super::source::{LIB, PackageSource};
use crate::architecture::Architecture;
use crate::checkout::Checkout;
use crate::onnxruntime;
use crate::steps::{self, cannot};

const COMPLETIONS: [(&str, &str); 3] = [
    ("bash", "usr/share/bash-completion/completions/gleaner"),
    ("zsh", "usr/share/zsh/vendor-completions/_gleaner"),
    ("fish", "usr/share/fish/vendor_completions.d/gleaner.fish"),
];

pub(crate) struct PackageTree {
    root: PathBuf,
}

impl PackageTree {
    /// Creates the folder `root` again, with all files but the metadata.
    pub(crate) fn create(
        checkout: &Checkout,
        root: &Path,
        programs: &Path,
        architecture: Architecture,
        source: &PackageSource,
    ) -> Result<Self, Failure> {
        let tree = Self { root: root.to_owned() };
        steps::remove_folder(root)?;
        for (name, folder) in source.programs.iter().copied().flatten() {
            let file = tree.place(&programs.join(name), &Path::new(folder).join(name))?;
            // Symbols are most of the size. A panic names its place without them.
            let mut strip = checkout.command(architecture.strip());
            steps::run(strip.arg("--strip-unneeded").arg(&file), "install binutils")?;
            // A library is not started.
            set_mode(&file, if name.ends_with(".so") { 0o644 } else { 0o755 })?;
        }
        for (name, place) in source.files {
            tree.place(&checkout.path(source.folder).join(name), Path::new(place))?;
        }
        tree.documentation(checkout, &source.doc())?;
        if source.has_command {
            tree.sdk(checkout)?;
            // The command of this machine: that of the package may be for another one.
            tree.generated(checkout, &programs.join("gleaner"), architecture)?;
            tree.onnxruntime(checkout, architecture, &source.doc())?;
        }
        licences::write(checkout, &tree, source)?;
        Ok(tree)
    }

    /// Sets the modes of all files, and compresses those of which Debian demands it.
    pub(crate) fn finish(&self) -> Result<(), Failure> {
        for file in self.files()? {
            let mode =
                file.metadata().map_err(|error| cannot("read", &file, &error))?.permissions();
            set_mode(&file, if mode.mode() & 0o100 == 0 { 0o644 } else { 0o755 })?;
            let is_page = file.starts_with(self.root.join("usr/share/man"));
            let is_long = ["changelog", "licences"].iter().any(|name| file.ends_with(name));
            if is_page || is_long {
                let mut gzip = std::process::Command::new("gzip");
                steps::run(gzip.args(["-9n"]).arg(&file), "see the error above")?;
            }
        }
        Ok(())
    }

    pub(crate) fn root(&self) -> &Path {
        &self.root
    }

    pub(crate) fn write(&self, place: &str, text: &str) -> Result<PathBuf, Failure> {
        let file = self.parent(Path::new(place))?;
        fs::write(&file, text).map_err(|error| cannot("write", &file, &error))?;
        set_mode(&file, 0o644)?;
        Ok(file)
    }

    /// All files, in the order of their paths.
    pub(super) fn files(&self) -> Result<Vec<PathBuf>, Failure> {
        let (mut folders, mut files) = (vec![self.root.clone()], Vec::new());
        while let Some(folder) = folders.pop() {
            set_mode(&folder, 0o755)?;
            for path in entries(&folder)? {
                if path.is_dir() { folders.push(path) } else { files.push(path) }
            }
        }
        files.sort();
        Ok(files)
    }

    /// The package `gleaner` of Python, and the program that starts a lambda with it.
    fn sdk(&self, checkout: &Checkout) -> Result<(), Failure> {
        let (sdk, lib) = (checkout.path("guest-sdk-python"), Path::new(LIB));
        self.place(&sdk.join("start.py"), &lib.join("start.py"))?;
        let fleet = checkout.path("fleet-client-python");
        for (from, folder) in
            [(&sdk, "gleaner"), (&sdk, "gleaner/testing"), (&fleet, "gleaner_fleet")]
        {
            for file in entries(&from.join(folder))? {
                let name = file.file_name().unwrap_or_default();
                if name.to_string_lossy().ends_with(".py") || name == "py.typed" {
                    self.place(&file, &lib.join(folder).join(name))?;
                }
            }
        }
        Ok(())
    }

    /// The library that runs models, unchanged, with its licences.
    fn onnxruntime(
        &self,
        checkout: &Checkout,
        architecture: Architecture,
        doc: &str,
    ) -> Result<(), Failure> {
        let Some(package) = onnxruntime::fetch(checkout, architecture) else { return Ok(()) };
        let library = onnxruntime::library(&package);
        let place = Path::new(LIB).join(library.file_name().unwrap_or_default());
        set_mode(&self.place(&library, &place)?, 0o644)?;
        for name in onnxruntime::LICENCES {
            self.place(&package.join(name), &Path::new(doc).join("onnxruntime").join(name))?;
        }
        Ok(())
    }

    fn documentation(&self, checkout: &Checkout, doc: &str) -> Result<(), Failure> {
        let doc = Path::new(doc);
        for name in ["CHANGELOG.md", "THIRD_PARTY.md"] {
            self.place(&checkout.path(name), &doc.join(name))?;
        }
        for file in entries(&checkout.path("docs"))? {
            if file.extension().is_some_and(|it| it == "md") && !file.ends_with("SUMMARY.md") {
                self.place(&file, &doc.join(file.file_name().unwrap_or_default()))?;
            }
        }
        Ok(())
    }

    /// Manual pages and completions, by the command itself.
    fn generated(
        &self,
        checkout: &Checkout,
        gleaner: &Path,
        architecture: Architecture,
    ) -> Result<(), Failure> {
        let own = checkout.program("gleaner");
        let gleaner = if architecture.is_of_this_machine() { gleaner } else { &own };
        if !gleaner.is_file() {
            println!("skipped: no manual pages, as this machine has no `{}`", gleaner.display());
            return Ok(());
        }
        let pages = self.parent(Path::new("usr/share/man/man1/x"))?.with_file_name("");
        let mut man = checkout.command(gleaner);
        steps::output(man.arg("man").arg(&pages), "see the error above")?;
        for (shell, place) in COMPLETIONS {
            let mut completions = checkout.command(gleaner);
            let help = "see the error above";
            let script = steps::output(completions.args(["completions", shell]), help)?;
            self.write(place, &script)?;
        }
        Ok(())
    }

    pub(crate) fn place(&self, file: &Path, place: &Path) -> Result<PathBuf, Failure> {
        let to = self.parent(place)?;
        fs::copy(file, &to).map_err(|error| {
            cannot("copy", file, &error)
                .with_help("without `--programs`, `cargo xtask deb` builds all programs")
        })?;
        Ok(to)
    }

    /// Creates the folder of `place`, and returns the whole path.
    fn parent(&self, place: &Path) -> Result<PathBuf, Failure> {
        let path = self.root.join(place);
        let folder = path.parent().unwrap_or(&self.root);
        fs::create_dir_all(folder).map_err(|error| cannot("create", folder, &error))?;
        Ok(path)
    }
}

pub(super) fn read(file: &Path) -> Result<String, Failure> {
    fs::read_to_string(file).map_err(|error| cannot("read", file, &error))
}

pub(super) fn set_mode(path: &Path, mode: u32) -> Result<(), Failure> {
    fs::set_permissions(path, fs::Permissions::from_mode(mode))
        .map_err(|error| cannot("change", path, &error))
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let failed = |error| cannot("read", folder, &error);
    let mut paths = Vec::new();
    for entry in fs::read_dir(folder).map_err(failed)? {
        paths.push(entry.map_err(failed)?.path());
    }
    paths.sort();
    Ok(paths)
}

#[cfg(test)]
mod tests {
    use gleaner_lambda::Vehicle;

    /// The file of the package with its keys active.
    fn active() -> String {
        let text = include_str!("../../../orchestrator/package/vehicle.toml");
        text.lines()
            .filter_map(|line| line.strip_prefix('#'))
            .filter(|line| !line.starts_with(' '))
            .map(|line| format!("{line}\n"))
            .collect()
    }

    #[test]
    fn the_default_configuration_is_that_without_a_file() {
        let text = include_str!("../../../orchestrator/package/vehicle.toml");
        assert_eq!(Vehicle::parse(text, "vehicle.toml").unwrap(), Vehicle::default());
        Vehicle::parse(&active(), "vehicle.toml").unwrap();
    }

    #[test]
    fn the_default_configuration_has_all_keys_of_the_page() {
        let page = include_str!("../../../docs/vehicle.md");
        let section = page.split("## Configuration\n").nth(1).unwrap();
        let block = section.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
        let keys = |text: &str| -> Vec<String> {
            let lines = text.lines().map(|line| line.split(['#', '=']).next().unwrap_or_default());
            lines.map(|key| key.trim().to_owned()).filter(|key| !key.is_empty()).collect()
        };
        assert_eq!(keys(&active()), keys(block));
    }
}
