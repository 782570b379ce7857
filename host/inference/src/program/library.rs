//! Finds the library of ONNX Runtime.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Prefix of the name of its file; the version follows in most packages.
const NAME: &str = "libonnxruntime.so";

/// The environment variable with its path.
const VARIABLE: &str = "ORT_DYLIB_PATH";

/// Folders of the system that are searched, in this order.
pub(super) const FOLDERS: [&str; 6] = [
    "/usr/local/lib",
    "/usr/local/lib64",
    "/usr/lib",
    "/usr/lib64",
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
];

/// Returns the path of the library: `given`, or the environment variable, or the first file in the
/// folder of this program and in folders of the system.
pub(super) fn find(given: Option<&Path>) -> Option<PathBuf> {
    let program = std::env::current_exe().ok();
    let beside = program.as_deref().and_then(Path::parent).map(Path::to_owned);
    let folders = beside.into_iter().chain(FOLDERS.map(PathBuf::from));
    find_in(given, std::env::var_os(VARIABLE), folders)
}

/// Names the places that were searched, for the reason why there is no library.
pub(super) fn searched() -> String {
    format!("no {NAME} in {VARIABLE}, beside this program, in /usr/local/lib or in /usr/lib")
}

fn find_in(
    given: Option<&Path>,
    variable: Option<OsString>,
    folders: impl Iterator<Item = PathBuf>,
) -> Option<PathBuf> {
    let variable = variable.filter(|path| !path.is_empty()).map(PathBuf::from);
    let explicit = given.map(Path::to_owned).or(variable);
    // A path that is named is used or is an error; another library would be a surprise.
    explicit.or_else(|| folders.into_iter().find_map(|folder| newest_in(&folder)))
}

/// Returns the library with the newest version in a folder.
fn newest_in(folder: &Path) -> Option<PathBuf> {
    let files = std::fs::read_dir(folder).ok()?.filter_map(Result::ok).map(|entry| entry.path());
    let versions = files.filter_map(|path| Some((version_of(&path)?, path)));
    versions.max().map(|(_, path)| path)
}

/// Returns the version of a library by its name; `None` for other files.
fn version_of(path: &Path) -> Option<Vec<u32>> {
    let rest = path.file_name()?.to_str()?.strip_prefix(NAME)?;
    if rest.is_empty() {
        return Some(Vec::new());
    }
    rest.strip_prefix('.')?.split('.').map(|number| number.parse().ok()).collect()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_named_path_is_first_and_the_newest_file_of_a_folder_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let of = |name: &str| folder.path().join(name);
        let folders = || [of("none"), folder.path().to_owned()].into_iter();
        assert_eq!(find_in(None, None, folders()), None);
        for name in ["libonnxruntime.so.1.9.0", "libonnxruntime.so.1.23.2", "libonnxruntime.so.x"] {
            fs::write(of(name), "").unwrap();
        }
        fs::write(of("libonnxruntime_providers_cuda.so"), "").unwrap();
        assert_eq!(find_in(None, None, folders()), Some(of("libonnxruntime.so.1.23.2")));
        let variable = || Some(OsString::from("/from/variable"));
        assert_eq!(find_in(None, variable(), folders()), Some("/from/variable".into()));
        assert_eq!(
            find_in(None, Some(OsString::new()), folders()).map(|it| it.exists()),
            Some(true)
        );
        let given = Path::new("/given");
        assert_eq!(find_in(Some(given), variable(), folders()), Some(given.into()));
    }
}
