use std::path::{Path, PathBuf};

use super::InstallationError;

#[derive(Debug, Clone)]
pub(super) struct SearchPaths {
    /// In search order.
    folders: Vec<PathBuf>,
    /// The checkout, if the program is in its cargo target folder.
    checkout: Option<PathBuf>,
}

impl SearchPaths {
    /// The folders for the program `exe`, with `home` first if it is set.
    pub(super) fn around(exe: &Path, home: Option<PathBuf>) -> SearchPaths {
        let mut folders = Vec::new();
        if let Some(home) = home {
            folders.push(home.join("lib/gleaner"));
            folders.push(home);
        }
        let beside = exe.parent().unwrap_or(Path::new(""));
        // A program in `lib/gleaner` was started by one in `bin`; its parts are beside it.
        if beside.ends_with("lib/gleaner") {
            folders.push(beside.to_owned());
        }
        if let Some(prefix) = beside.parent() {
            folders.push(prefix.join("lib/gleaner"));
        }
        let mut checkout = None;
        if let Some(target) = cargo_target(beside) {
            folders.push(beside.to_owned());
            // Cargo puts test programs into `deps`, below the folder of the programs under test.
            if beside.ends_with("deps") {
                folders.extend(beside.parent().map(Path::to_owned));
            }
            checkout =
                target.ancestors().skip(1).find(|folder| is_checkout(folder)).map(Path::to_owned);
            folders.extend(checkout.as_ref().map(|checkout| checkout.join("guest-sdk-python")));
        }
        SearchPaths { folders, checkout }
    }

    pub(super) fn checkout(&self) -> Option<&Path> {
        self.checkout.as_deref()
    }

    /// Returns the first match of `part` in the folders.
    pub(super) fn first(
        &self,
        name: &str,
        made_by: &'static str,
        part: impl Fn(&Path) -> Option<PathBuf>,
    ) -> Result<PathBuf, InstallationError> {
        let found = self.folders.iter().find_map(|folder| part(folder));
        found.ok_or_else(|| InstallationError::Missing {
            part: name.to_owned(),
            folders: self.folders.clone(),
            made_by,
        })
    }
}

/// Returns whether `home` or its `lib/gleaner` has a part of an installation.
pub(super) fn has_parts(home: &Path) -> bool {
    let parts = ["gleaner-cloud", "gleaner-runtime", "lib_gleaner.so", "start.py"];
    [home.join("lib/gleaner"), home.to_owned()]
        .iter()
        .any(|folder| parts.iter().any(|part| folder.join(part).is_file()))
}

/// Finds the cargo target folder around `folder` by cargo's tag file. Programs are at most
/// `target/<triple>/<profile>/deps` deep.
fn cargo_target(folder: &Path) -> Option<&Path> {
    folder.ancestors().take(4).find(|folder| folder.join("CACHEDIR.TAG").is_file())
}

fn is_checkout(folder: &Path) -> bool {
    folder.join("Cargo.toml").is_file() && folder.join("guest-sdk-python").is_dir()
}
