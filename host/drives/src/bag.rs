//! The directories that rosbag2 writes: which files belong to them.

use std::collections::HashSet;
use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Component, Path, PathBuf};

use super::error::ReplayError;
use super::metadata;
use super::storage::Bag;

/// What files without metadata are called.
const ENDINGS: [&str; 4] = [".mcap", ".db3", ".mcap.zstd", ".db3.zstd"];
const PACKED: &str = ".zstd";

/// The files of the directory `folder`.
pub(super) fn list(folder: &Path) -> Result<Bag, ReplayError> {
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
            "metadata.yaml does not name all files beside it: {count} are not read, `{first}` first"
        )
    });
    Ok(Bag { files, messages: found.messages, remark })
}

/// The text of the file `path`, which has to be in the folder `root`.
fn text_of(path: &Path, root: &Path) -> io::Result<String> {
    let invalid = |what| Err(io::Error::new(io::ErrorKind::InvalidData, what));
    let real = path.canonicalize()?;
    if !real.starts_with(root) {
        return invalid("it is a link that leads out of its directory");
    }
    if !real.is_file() {
        return invalid("it is no file");
    }
    let mut bytes = Vec::new();
    File::open(real)?.take(metadata::MAX_BYTES + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > metadata::MAX_BYTES {
        return invalid("it is larger than 16 MiB");
    }
    String::from_utf8(bytes).or_else(|_| invalid("it is not UTF-8"))
}

/// Where the file is that `metadata` name `file`; it has to be in `folder`, whose own path is
/// `root`.
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
    // Up to version 3, the directory's own name stands in front. It may have another by now.
    let inside: PathBuf = relative.components().skip(1).collect();
    let found = [folder.join(relative), folder.join(inside)].into_iter().find_map(|path| {
        // A recorder that was killed may not have come to packing, or to noting it.
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

/// All files in `folder`, where nothing says which belong together.
fn by_name(folder: &Path) -> Result<Bag, ReplayError> {
    let files = of_a_bag(folder)?;
    if files.is_empty() {
        return Err(ReplayError::NoBag { path: folder.to_owned() });
    }
    let remark = Some(format!(
        "no metadata.yaml: its {} files are read in the order of their names",
        files.len()
    ));
    Ok(Bag { files, remark, ..Bag::default() })
}

/// The files in `folder` that are called as those of a bag, in the order of their names; one that
/// lies there packed and not packed is the latter.
fn of_a_bag(folder: &Path) -> Result<Vec<PathBuf>, ReplayError> {
    let failed = |source| ReplayError::Open { path: folder.to_owned(), source };
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let name = entry.file_name();
        let is_one =
            name.to_str().is_some_and(|name| ENDINGS.iter().any(|ending| name.ends_with(ending)));
        // Of the entry itself: no link leads out.
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

/// The path without the ending of what is packed.
fn unpacked(path: &Path) -> PathBuf {
    if path.extension() == Some("zstd".as_ref()) {
        path.with_extension("")
    } else {
        path.to_owned()
    }
}
