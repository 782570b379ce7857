//! Licences of the crates that the programs contain.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure};
use serde::Deserialize;

use super::source::PackageSource;
use super::tree::PackageTree;
use crate::checkout::Checkout;
use crate::steps;

#[derive(Deserialize)]
struct CargoMetadata {
    packages: Vec<CratePackage>,
}

#[derive(Deserialize)]
struct CratePackage {
    name: String,
    version: String,
    license: Option<String>,
    /// None for crates of the workspace.
    source: Option<String>,
    manifest_path: PathBuf,
}

/// Writes one file with all crates, and the text of each licence once.
pub(super) fn write(
    checkout: &Checkout,
    tree: &PackageTree,
    source: &PackageSource,
) -> Result<(), Failure> {
    // Both download crates of other platforms, which no build here needed.
    let help = "see the message of cargo above";
    let mut metadata = checkout.cargo();
    metadata.args(["metadata", "--format-version=1", "--locked"]);
    let workspace: CargoMetadata = serde_json::from_str(&steps::output(&mut metadata, help)?)
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot parse the crates", &error))?;
    let mut linked = checkout.cargo();
    linked.args(["tree", "--locked", "--edges=normal", "--prefix=none"]);
    linked.args(["--format={p}", "--target=all"]);
    let packages = source.cargo_packages.iter().copied().flatten();
    linked.args(packages.flat_map(|package| ["--package", package]));
    let linked = steps::output(&mut linked, help)?;
    // A line is `NAME vVERSION`, with a path or a mark.
    let linked: BTreeSet<(&str, &str)> = linked
        .lines()
        .filter_map(|line| {
            let mut words = line.split(' ');
            Some((words.next()?, words.next()?.strip_prefix('v')?))
        })
        .collect();
    let crates = workspace.packages.iter().filter(|package| {
        package.source.is_some() && linked.contains(&(&*package.name, &*package.version))
    });
    let (mut list, mut texts) = (String::new(), BTreeMap::<String, Vec<String>>::new());
    for package in crates {
        let name = format!("{} {}", package.name, package.version);
        let licence = package.license.as_deref().unwrap_or("see the text below");
        list += &format!("{name}: {licence}\n");
        for text in texts_of(package.manifest_path.parent().unwrap_or(Path::new("/"))) {
            texts.entry(text).or_default().push(name.clone());
        }
    }
    let mut page = format!("The programs of Gleaner contain these crates:\n\n{list}");
    for (text, names) in &texts {
        page += &format!("\n\n==== {}\n\n{}\n", names.join(", "), text.trim_end());
    }
    println!("{} crates, {} texts of licences", list.lines().count(), texts.len());
    tree.write(&format!("{}/licences", source.doc()), &page).map(drop)
}

/// The files of a crate with a licence or a notice.
fn texts_of(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    let mut files: Vec<PathBuf> = entries
        .filter(|entry| {
            let name = entry.file_name().to_string_lossy().to_ascii_uppercase();
            ["LICENSE", "LICENCE", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE"]
                .iter()
                .any(|start| name.starts_with(start))
        })
        .map(|entry| entry.path())
        .collect();
    files.sort();
    files.iter().filter_map(|file| fs::read_to_string(file).ok()).collect()
}
