//! Several processes that put the same entry, and some that are killed meanwhile.

use std::env;
use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use gleaner_artifacts::{DerivedEntry, DerivedKey, DerivedKind, StoreLookup, make_store};

/// The variable with the store of a child of this program.
const STORE: &str = "GLEANER_TEST_STORE";

/// The variable with the byte that a child puts.
const BYTE: &str = "GLEANER_TEST_BYTE";

const CONTENT_BYTES: usize = 1 << 20;

const TIMEOUT: Duration = Duration::from_secs(60);

fn entry(store: &Path) -> DerivedEntry {
    DerivedEntry::of(store, DerivedKey::of(DerivedKind::NativeCode, "test", b"input"))
}

/// Returns the byte that the entry consists of; `None` if there is no entry.
fn byte_in(entry: &DerivedEntry) -> Option<u8> {
    match entry.read().unwrap() {
        StoreLookup::Content(content) => {
            assert_eq!(content.len(), CONTENT_BYTES);
            assert!(content.iter().all(|byte| *byte == content[0]), "it is mixed");
            Some(content[0])
        }
        StoreLookup::Nothing => None,
        StoreLookup::Damaged(why) => panic!("{why}"),
    }
}

/// The work of a child: puts its entry until it is killed. It is no test otherwise.
#[test]
fn child_that_puts() {
    let (Some(store), Ok(byte)) = (env::var_os(STORE), env::var(BYTE)) else { return };
    let entry = entry(Path::new(&store));
    let content = vec![byte.parse().unwrap(); CONTENT_BYTES];
    loop {
        entry.put(&[&content]).unwrap();
    }
}

fn putting(store: &Path, byte: u8) -> Child {
    let mut child = Command::new(env::current_exe().unwrap());
    child.args(["--exact", "child_that_puts"]).env(STORE, store).env(BYTE, byte.to_string());
    child.stdout(Stdio::null()).spawn().unwrap()
}

#[test]
fn an_entry_is_whole_while_processes_replace_it_and_after_each_is_killed() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    make_store(&store).unwrap();
    let entry = entry(&store);
    for _ in 0..10 {
        let children = [1, 2].map(|byte| putting(&store, byte));
        let (mut seen, until) = ([false; 2], Instant::now() + TIMEOUT);
        while seen != [true; 2] {
            assert!(Instant::now() < until, "only {seen:?} put the entry");
            if let Some(byte) = byte_in(&entry) {
                seen[usize::from(byte) - 1] = true;
            }
        }
        for mut child in children {
            child.kill().unwrap();
            child.wait().unwrap();
            assert!(byte_in(&entry).is_some(), "the entry is gone");
        }
    }
    entry.put(&[&[3; CONTENT_BYTES]]).unwrap();
    assert_eq!(byte_in(&entry), Some(3));
    let left = fs::read_dir(&store).unwrap().count();
    assert_eq!(left, 1, "partial files of killed processes are removed");
}
