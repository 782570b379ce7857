//! The source files of the checkout.

use std::fs;
use std::path::Path;

use crate::root;

/// A text file of the checkout.
#[derive(Debug)]
pub struct File {
    /// Its path from the root of the checkout, with `/` between its parts.
    pub path: String,
    pub text: String,
}

impl File {
    /// Returns whether the name ends with one of `extensions`, given without dots.
    pub fn is_one_of(&self, extensions: &[&str]) -> bool {
        Path::new(&self.path)
            .extension()
            .is_some_and(|found| extensions.iter().any(|extension| found == *extension))
    }
}

/// All text files of the checkout, sorted by path. Generated ones are omitted: target folders,
/// results, build folders of lambdas, and hidden folders except the project's own.
pub fn files() -> Vec<File> {
    let root = root();
    let mut files = Vec::new();
    let mut folders = vec![String::new()];
    while let Some(folder) = folders.pop() {
        for entry in
            fs::read_dir(root.join(&folder)).expect("a folder of the checkout can be listed")
        {
            let entry = entry.expect("a folder of the checkout can be listed");
            let name = entry.file_name().into_string().expect("names in the checkout are text");
            let path = if folder.is_empty() { name.clone() } else { format!("{folder}/{name}") };
            let kind = entry.file_type().expect("a file of the checkout has a type");
            if kind.is_dir() {
                if is_source_folder(&root, &folder, &name) {
                    folders.push(path);
                }
            } else if kind.is_file() {
                // A file that is not text is a recording or an image.
                files.extend(fs::read_to_string(entry.path()).ok().map(|text| File { path, text }));
            }
        }
    }
    files.sort_by(|a, b| a.path.cmp(&b.path));
    files
}

fn is_source_folder(root: &Path, folder: &str, name: &str) -> bool {
    match name {
        ".ci" | ".cargo" | ".config" => true,
        "out" => !(folder.is_empty() || is_lambda(root, folder)),
        "build" => !is_lambda(root, folder),
        "__pycache__" => false,
        _ => !(name.starts_with('.') || folder.is_empty() && name.starts_with("target")),
    }
}

fn is_lambda(root: &Path, folder: &str) -> bool {
    root.join(folder).join("lambda.toml").is_file()
}
