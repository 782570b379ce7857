//! Embeds the files of a new lambda in `gleaner`: the SDKs, the WIT and the example.

use std::env;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

/// Packed files, and folders of which all files with one of the [`EXTENSIONS`] are packed.
const PACKED: &[&str] = &[
    // Pins the versions that Gleaner was tested with; cargo removes the packages that a lambda does
    // not need.
    "Cargo.lock",
    "LICENSE",
    "examples/hello/python/lambda.toml",
    "examples/hello/python/main.py",
    "examples/hello/rust/lambda.toml",
    "examples/hello/rust/src",
    "guest-sdk-python/gleaner",
    "guest-sdk-python/pyproject.toml",
    "guest-sdk-rust/src",
    "rules/src",
    "wit",
];
const EXTENSIONS: &[&str] = &["py", "pyi", "rs", "typed", "wit"];

fn main() {
    let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("..");
    let mut list = "&[\n".to_owned();
    for packed in PACKED {
        println!("cargo::rerun-if-changed=../{packed}");
        add(&root, Path::new(packed), &mut list);
    }
    list.push(']');
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    fs::write(out.join("packed.rs"), list).expect("OUT_DIR is writable");
}

fn add(root: &Path, path: &Path, list: &mut String) {
    let full = root.join(path);
    if full.is_dir() {
        let entries = fs::read_dir(&full).expect("a folder of the repository");
        let mut inside: Vec<_> =
            entries.map(|entry| entry.expect("a readable entry").file_name()).collect();
        inside.sort();
        // Hidden files and caches come from tools.
        let inside = inside
            .iter()
            .filter(|name| *name != "__pycache__" && !name.as_encoded_bytes().starts_with(b"."));
        inside.for_each(|name| add(root, &path.join(name), list));
    } else if PACKED.iter().any(|packed| Path::new(packed) == path)
        || path
            .extension()
            .is_some_and(|found| EXTENSIONS.iter().any(|extension| found == *extension))
    {
        let full = full.canonicalize().expect("a file of the repository");
        let _ = writeln!(list, "    ({:?}, include_bytes!({:?})),", path, full);
    }
}
