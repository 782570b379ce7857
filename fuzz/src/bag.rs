//! Fuzzes rosbag2 directories: an input that begins like an SQLite database is the database, every
//! other is `metadata.yaml`.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::PathBuf;
use std::sync::OnceLock;

use gleaner_drives::{ReplayError, files_of};

use crate::budget;
use crate::drive::{MEMORY, replay};

/// Reads a directory with the input in it. Returns whether the input was valid: metadata that name
/// files, or a database with messages.
pub fn check(data: &[u8]) -> bool {
    if data.starts_with(b"SQLite format 3\0") { database(data) } else { metadata(data) }
}

fn metadata(text: &[u8]) -> bool {
    let folder = folder();
    fs::write(folder.join("metadata.yaml"), text).expect("the folder is writable");
    let found = budget::within(MEMORY, || files_of(std::slice::from_ref(folder)));
    fs::remove_file(folder.join("metadata.yaml")).expect("it was written");
    match found {
        Ok(files) => {
            let root = folder.canonicalize().expect("the folder is there");
            for file in &files {
                let real = file.canonicalize().expect("a listed file exists");
                assert!(real.starts_with(&root), "{} is elsewhere", file.display());
            }
            !files.is_empty()
        }
        Err(
            error @ (ReplayError::Metadata { .. }
            | ReplayError::NoSuchFile { .. }
            | ReplayError::Outside { .. }),
        ) => {
            assert!(error.help().is_some(), "{error} has no way out");
            false
        }
        Err(error) => panic!("{error}"),
    }
}

fn database(bytes: &[u8]) -> bool {
    let path = folder().with_file_name("input.db3");
    fs::write(&path, bytes).expect("the folder is writable");
    let paths = [path];
    let with_peek = budget::within(MEMORY, || replay(&paths, true));
    let without_peek = budget::within(MEMORY, || replay(&paths, false));
    assert_eq!(with_peek, without_peek, "peeking changes the delivered samples");
    with_peek.0 > 0 && with_peek.2.is_empty()
}

/// A directory with files that metadata may name, and some around it that they may not.
fn folder() -> &'static PathBuf {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let around = std::env::temp_dir().join(format!("gleaner-fuzz-{}", std::process::id()));
        let folder = around.join("bag");
        fs::create_dir_all(folder.join("a")).expect("the temporary folder is writable");
        for name in ["b.mcap", "bag/a.mcap", "bag/b.db3.zstd", "bag/a/c.mcap"] {
            fs::write(around.join(name), []).expect("the temporary folder is writable");
        }
        // A previous process with the same id may have left it.
        let _ = fs::remove_file(folder.join("link.mcap"));
        symlink("../b.mcap", folder.join("link.mcap")).expect("the temporary folder is writable");
        folder
    })
}
