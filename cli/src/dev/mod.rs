//! `gleaner dev DIR DRIVE...`: builds and replays a lambda whenever one of its sources is saved,
//! and shows the changes.
//!
//! It runs the code of `gleaner build`, `replay` and `diff`, one after the other.

mod watch;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use gleaner_base::{ByteSize, Exit, Failure, PlainFile, safe_file, visible};
use gleaner_report::Diff;

use crate::args::{BuildArgs, ReplayArgs, ReplayedArgs};
use crate::output::{print, print_error};
use crate::render::{self, Paint};
use crate::{build, replay, separate};

use watch::SourceSnapshot;

/// Folder below the results with the results of the previous replay. `gleaner diff` can read it,
/// too.
const BEFORE: &str = ".before";

/// Result files that are compared with the next replay.
const COMPARED: [&str; 4] = ["summary.json", "decisions.jsonl", "signals.json", "clips.jsonl"];

/// Maximum size of a file that is kept, since it takes disk space twice.
const KEPT_MAX: ByteSize = ByteSize::gib(1);

/// Runs until the user ends it.
pub(crate) fn run(replayed: ReplayedArgs) -> Result<Exit, Failure> {
    let dir = replayed.target.lambda.clone();
    let out = replayed.out();
    let replay = ReplayArgs {
        replayed,
        all: false,
        topics: Vec::new(),
        journal: None,
        verify: None,
        no_report: false,
        json: false,
    };
    // The first comparison is with the results of an earlier session, if there are any.
    let mut kept = separate::result_folders(&out);
    kept.retain(|out| keep(out));
    let mut sources = SourceSnapshot::of(&dir);
    loop {
        match once(&dir, &replay) {
            Ok(folders) => {
                let is_set = folders.len() > 1;
                for out in folders {
                    let has_before = kept.contains(&out);
                    if has_before && let Err(failure) = compare(&out, is_set) {
                        eprintln!("{failure}");
                    }
                    kept.retain(|folder| *folder != out);
                    if keep(&out) {
                        kept.push(out);
                    }
                }
            }
            Err(failure) => eprintln!("{failure}"),
        }
        print(&format!("\nwaiting for changes in {} (Ctrl-C ends)\n", dir.display()))?;
        let (now, changed) = sources.wait_for_change(&dir);
        sources = now;
        let changed = changed
            .iter()
            .map(|path| visible(&path.to_string_lossy()))
            .collect::<Vec<_>>()
            .join(", ");
        print(&format!("\n── changed: {changed}\n"))?;
    }
}

/// Builds and replays. Returns the folders with new results, also those of a lambda with faults and
/// of a damaged drive.
fn once(dir: &Path, args: &ReplayArgs) -> Result<Vec<PathBuf>, Failure> {
    build::run(&BuildArgs { lambda: dir.to_owned(), ..BuildArgs::default() })?;
    replay::results(args).map(|(_, folders)| folders)
}

/// Compares results with those before. Those of one of several drives are named.
fn compare(out: &Path, is_set: bool) -> Result<(), Failure> {
    let mut changes = Diff::between(&out.join(BEFORE), out)?;
    if let Some(drive) = out.file_name().filter(|_| is_set) {
        print(&format!("\ndrive {}\n", visible(&drive.to_string_lossy())))?;
    }
    changes.a.out = "before".to_owned();
    changes.b.out = "now".to_owned();
    print(&format!("\n{}", render::diff(&changes, Paint::of_stdout())))
}

/// Copies the results for the next comparison; returns false if they are incomplete.
fn keep(out: &Path) -> bool {
    let before = &out.join(BEFORE);
    let copied = || -> io::Result<()> {
        if !out.join(COMPARED[0]).is_file() {
            return Err(io::ErrorKind::NotFound.into());
        }
        safe_file::folder(before)?;
        for name in COMPARED {
            match PlainFile::result(&out.join(name), KEPT_MAX) {
                Err(error) if error.kind() == io::ErrorKind::NotFound && name != COMPARED[0] => {
                    let _ = fs::remove_file(before.join(name));
                }
                file => file?.copy_to(&mut safe_file::create(&before.join(name))?)?,
            }
        }
        Ok(())
    };
    match copied() {
        Ok(()) => true,
        Err(error) if error.kind() == io::ErrorKind::NotFound => false,
        Err(error) => {
            print_error(&format!(
                "warning: cannot copy `{}` for the next comparison: {error}\n",
                out.display()
            ));
            false
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_do_not_follow_links() {
        let folder = tempfile::tempdir().unwrap();
        let (out, precious) = (folder.path().join("out"), folder.path().join("precious"));
        let before = out.join(BEFORE);
        fs::create_dir_all(&before).unwrap();
        fs::write(&precious, "precious").unwrap();
        fs::write(out.join("summary.json"), "{}").unwrap();
        std::os::unix::fs::symlink(&precious, before.join("summary.json")).unwrap();
        assert!(keep(&out));
        assert_eq!(fs::read_to_string(before.join("summary.json")).unwrap(), "{}");
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
        // Links are not read either, and a linked folder is not written to.
        fs::remove_file(out.join("summary.json")).unwrap();
        std::os::unix::fs::symlink(&precious, out.join("summary.json")).unwrap();
        assert!(!keep(&out));
        assert_eq!(fs::read_to_string(before.join("summary.json")).unwrap(), "{}");
        fs::remove_file(out.join("summary.json")).unwrap();
        fs::write(out.join("summary.json"), "{\"new\": 1}").unwrap();
        fs::rename(&before, folder.path().join("elsewhere")).unwrap();
        std::os::unix::fs::symlink(folder.path().join("elsewhere"), &before).unwrap();
        assert!(!keep(&out));
        assert_eq!(fs::read_to_string(folder.path().join("elsewhere/summary.json")).unwrap(), "{}");
    }
}
