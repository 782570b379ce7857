//! Finds the files of the directories that rosbag2 writes.

use std::collections::HashSet;
use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Component, Path, PathBuf};

use super::Bag;
use crate::error::ReplayError;
use crate::metadata;

/// File name suffixes of files without metadata.
const ENDINGS: [&str; 4] = [".mcap", ".db3", ".mcap.zstd", ".db3.zstd"];
const PACKED: &str = ".zstd";

pub fn list(folder: &Path) -> Result<Bag, ReplayError> {
    let path = folder.join("metadata.yaml");
    let root = folder
        .canonicalize()
        .map_err(|source| ReplayError::Open { path: folder.to_owned(), source })?;
    let text = match text_of(&path, &root) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return by_name(folder),
        Err(error) => return Err(ReplayError::Metadata { path, source: error.into() }),
    };
    let found = match metadata::read(&text) {
        Ok(found) => found,
        Err(source) => return Err(ReplayError::Metadata { path, source }),
    };
    let files = found
        .files
        .into_iter()
        .map(|file| named(folder, &root, &path, file))
        .collect::<Result<Vec<PathBuf>, _>>()?;
    let read: HashSet<_> = files.iter().map(|file| unpacked(file)).collect();
    let others: Vec<_> =
        of_a_bag(folder)?.into_iter().filter(|other| !read.contains(&unpacked(other))).collect();
    let remark = others.first().map(|first| {
        let (count, first) = (others.len(), first.display());
        format!(
            "metadata.yaml does not name all files beside it: {count} are skipped, the first is \
             `{first}`"
        )
    });
    Ok(Bag { files, messages: found.messages, is_one: true, remark })
}

/// Reads the text of the file `path`, which must be in the folder `root`.
fn text_of(path: &Path, root: &Path) -> io::Result<String> {
    let invalid = |what| Err(io::Error::new(io::ErrorKind::InvalidData, what));
    let real = path.canonicalize()?;
    if !real.starts_with(root) {
        return invalid("it is a link that leads out of its directory");
    }
    if !real.is_file() {
        return invalid("it is not a regular file");
    }
    let mut bytes = Vec::new();
    File::open(real)?.take(metadata::MAX_BYTES + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > metadata::MAX_BYTES {
        return invalid("it is larger than 16 MiB");
    }
    String::from_utf8(bytes).or_else(|_| invalid("it is not UTF-8"))
}

/// Returns the path of the file that `metadata` calls `file`; it must be in `folder`, whose real
/// path is `root`.
fn named(
    folder: &Path,
    root: &Path,
    metadata: &Path,
    file: String,
) -> Result<PathBuf, ReplayError> {
    let relative = Path::new(&file);
    let is_plain = |part| matches!(part, Component::Normal(_) | Component::CurDir);
    if file.is_empty() || !relative.components().all(is_plain) {
        return Err(ReplayError::Outside { metadata: metadata.to_owned(), file });
    }
    // Up to version 3, names begin with that of the directory, which may have been renamed since.
    let inside: PathBuf = relative.components().skip(1).collect();
    let found = [folder.join(relative), folder.join(inside)].into_iter().find_map(|path| {
        // A killed recorder may not have packed the file, or not have noted that.
        let packed = OsString::from_iter([path.as_os_str(), PACKED.as_ref()]);
        let unpacked = file.strip_suffix(PACKED).map(|_| path.with_extension(""));
        [Some(path), Some(packed.into()), unpacked]
            .into_iter()
            .flatten()
            .find(|path| path.is_file())
    });
    let Some(found) = found else {
        return Err(ReplayError::NoSuchFile { metadata: metadata.to_owned(), file });
    };
    match found.canonicalize() {
        Ok(real) if real.starts_with(root) => Ok(found),
        _ => Err(ReplayError::Outside { metadata: metadata.to_owned(), file }),
    }
}

fn by_name(folder: &Path) -> Result<Bag, ReplayError> {
    let files = of_a_bag(folder)?;
    if files.is_empty() {
        return Err(ReplayError::NoBag { path: folder.to_owned() });
    }
    let remark = Some(format!(
        "no metadata.yaml: whether its {} files are one drive depends on their numbers and times",
        files.len()
    ));
    Ok(Bag { files, remark, ..Bag::default() })
}

/// Returns the files in `folder` with names as in a bag, in the order of their names. Of a file
/// that exists both packed and unpacked, only the unpacked one is returned.
fn of_a_bag(folder: &Path) -> Result<Vec<PathBuf>, ReplayError> {
    let failed = |source| ReplayError::Open { path: folder.to_owned(), source };
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let name = entry.file_name();
        let is_one =
            name.to_str().is_some_and(|name| ENDINGS.iter().any(|ending| name.ends_with(ending)));
        // The type of the entry itself: links are not followed.
        if is_one && entry.file_type().map_err(failed)?.is_file() {
            names.push(name);
        }
    }
    names.sort();
    let is_twin = |name: &OsString| {
        let unpacked = unpacked(name.as_ref()).into_os_string();
        unpacked != *name && names.binary_search(&unpacked).is_ok()
    };
    Ok(names.iter().filter(|name| !is_twin(name)).map(|name| folder.join(name)).collect())
}

/// Returns the path without the suffix of packed files.
fn unpacked(path: &Path) -> PathBuf {
    if path.extension() == Some("zstd".as_ref()) {
        path.with_extension("")
    } else {
        path.to_owned()
    }
}
