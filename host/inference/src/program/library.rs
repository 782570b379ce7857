//! Finds the library of ONNX Runtime.

use std::ffi::OsString;
use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::process::geteuid;
use tracing::warn;

/// Prefix of the name of its file; the version follows in most packages.
const NAME: &str = "libonnxruntime.so";

/// The environment variable with its path.
const VARIABLE: &str = "ORT_DYLIB_PATH";

/// The environment variable with the active environment of Python, and the folders of the system
/// that have packages of Python.
const PYTHON: &str = "VIRTUAL_ENV";
const PYTHON_FOLDERS: [&str; 2] = ["/usr/local/lib", "/usr/lib"];

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
/// package `onnxruntime` of the active environment of Python, in folders of the system, in its
/// packages of Python, and in the folder of this program, where our packages have one for the CPU.
pub(super) fn find(given: Option<&Path>) -> Option<PathBuf> {
    let program = std::env::current_exe().ok();
    let beside = program.as_deref().and_then(Path::parent).map(Path::to_owned);
    let active = std::env::var_os(PYTHON).filter(|path| !path.is_empty()).map(PathBuf::from);
    let active = active.into_iter().flat_map(|folder| packages(&folder.join("lib")));
    let of_python = PYTHON_FOLDERS.iter().flat_map(|folder| packages(Path::new(folder)));
    // Last, as the library that the user has installed may be for a GPU.
    let folders = active.chain(FOLDERS.map(PathBuf::from)).chain(of_python).chain(beside);
    find_in(given, std::env::var_os(VARIABLE), folders)
}

/// Returns the folders of the package `onnxruntime`, whose wheel has the library, in those of each
/// version of Python.
fn packages(lib: &Path) -> Vec<PathBuf> {
    let versions = std::fs::read_dir(lib).into_iter().flatten().filter_map(Result::ok);
    let versions = versions.filter(|it| it.file_name().to_string_lossy().starts_with("python3"));
    let folders = versions.flat_map(|version| {
        ["site-packages", "dist-packages"].map(|name| version.path().join(name))
    });
    let mut folders: Vec<PathBuf> = folders.map(|it| it.join("onnxruntime/capi")).collect();
    folders.sort();
    folders
}

/// Returns whether only root, this user and the owner of this program can replace a file, whose
/// path has no link: a library runs as code.
fn is_private(file: &Path) -> bool {
    let program = std::env::current_exe().and_then(|program| program.metadata());
    let user = geteuid().as_raw();
    let users = [0, user, program.map_or(user, |program| program.uid())];
    let is_private = |metadata: &Metadata| {
        let mode = metadata.mode();
        // Many systems give each user a group of the same number, without other members.
        let by_group = mode & 0o020 != 0 && metadata.gid() != metadata.uid();
        let by_others = mode & 0o002 != 0;
        let is_sticky = metadata.is_dir() && mode & 0o1000 != 0;
        users.contains(&metadata.uid()) && (is_sticky || !by_group && !by_others)
    };
    file.ancestors().all(|path| path.metadata().is_ok_and(|metadata| is_private(&metadata)))
}

/// Names the places that were searched, for the reason why there is no library.
pub(super) fn searched() -> String {
    format!(
        "no {NAME} in {VARIABLE}, in the package `onnxruntime` of {PYTHON}, in /usr/local/lib, in \
         /usr/lib or beside this program; `pip install onnxruntime` brings it"
    )
}

fn find_in(
    given: Option<&Path>,
    variable: Option<OsString>,
    folders: impl Iterator<Item = PathBuf>,
) -> Option<PathBuf> {
    let variable = variable.filter(|path| !path.is_empty()).map(PathBuf::from);
    let explicit = given.map(Path::to_owned).or(variable);
    // A path that is named is used or is an error; another library would be a surprise.
    explicit.or_else(|| {
        let mut found = folders.filter_map(|folder| newest_in(&folder)?.canonicalize().ok());
        found.find(|library| {
            let is_used = is_private(library);
            if !is_used {
                let path = library.display();
                warn!(%path, "library of ONNX Runtime is not used: another user can replace it");
            }
            is_used
        })
    })
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
    use std::os::unix::fs::PermissionsExt;

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

    #[test]
    fn the_wheel_in_an_environment_of_python_is_found_unless_others_can_replace_it() {
        let folder = tempfile::tempdir().unwrap();
        let capi = folder.path().join("lib/python3.11/site-packages/onnxruntime/capi");
        fs::create_dir_all(&capi).unwrap();
        let library = capi.join("libonnxruntime.so.1.32.0");
        fs::write(&library, "").unwrap();
        let found = || find_in(None, None, packages(&folder.path().join("lib")).into_iter());
        assert_eq!(found(), Some(library.clone()));
        let allow = |path: &Path, mode| {
            fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
        };
        for path in [&library, &capi, &folder.path().join("lib")] {
            allow(path, 0o757);
            assert_eq!(found(), None, "{path:?}");
            allow(path, 0o755);
        }
        assert_eq!(found(), Some(library));
    }
}
