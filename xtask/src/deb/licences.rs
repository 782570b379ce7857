//! Licences of the crates that the programs contain.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use gleaner_base::Failure;

use super::source::PackageSource;
use super::tree::PackageTree;
use crate::checkout::Checkout;
use crate::metadata::Metadata;
use crate::setup::SCALED;
use crate::steps;

/// Writes one file with all crates, and the text of each licence once.
pub(super) fn write(
    checkout: &Checkout,
    tree: &PackageTree,
    source: &PackageSource,
) -> Result<(), Failure> {
    // Both download crates of other platforms, which no build here needed.
    let help = "see the message of cargo above";
    let metadata = Metadata::read(checkout, "--locked")?;
    let mut linked = checkout.cargo();
    linked.args(["tree", "--locked", "--edges=normal", "--prefix=none"]);
    linked.args(["--format={p}", "--target=all", SCALED]);
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
    let crates = metadata.packages.iter().filter(|package| {
        package.source.is_some() && linked.contains(&(&*package.name, &*package.version))
    });
    let (mut list, mut texts) = (String::new(), BTreeMap::<String, Vec<String>>::new());
    for package in crates {
        let name = format!("{} {}", package.name, package.version);
        let licence = package.license.as_deref().unwrap_or("see the text below");
        list += &format!("{name}: {licence}\n");
        for text in texts_of(Path::new(&package.manifest_path).parent().unwrap_or(Path::new("/"))) {
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

/// The files of a crate with a licence or a notice, also of sources in C in a folder of it, such as
/// Cyclone DDS.
fn texts_of(folder: &Path) -> Vec<String> {
    let entries = |folder: &Path| {
        let entries = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
        entries.map(|entry| entry.path()).collect::<Vec<_>>()
    };
    let mut files = entries(folder);
    let nested: Vec<_> = files.iter().flat_map(|path| entries(path)).collect();
    files.extend(nested);
    files.retain(|file| {
        let name = file.file_name().unwrap_or_default().to_string_lossy().to_ascii_uppercase();
        ["LICENSE", "LICENCE", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE"]
            .iter()
            .any(|start| name.starts_with(start))
    });
    files.sort();
    files.iter().filter_map(|file| fs::read_to_string(file).ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn the_licences_of_a_crate_include_those_of_its_sources_in_c() {
        let folder = TestFolder::new();
        for file in ["LICENSE-MIT", "cyclonedds/NOTICE.md", "cyclonedds/a.c", "src/lib.rs"] {
            folder.write(file, file);
        }
        assert_eq!(texts_of(folder.root()), ["LICENSE-MIT", "cyclonedds/NOTICE.md"]);
    }
}
