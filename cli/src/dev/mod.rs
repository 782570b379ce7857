//! `gleaner dev DIR DRIVE...`: builds and replays a lambda whenever one of its sources is saved,
//! and shows what that changed.
//!
//! Nothing here is a way of its own to build, to replay or to compare: it does what the three
//! commands do, one after the other.

mod watch;

use std::fs;
use std::io;
use std::path::Path;

use gleaner_base::{ByteSize, Exit, Failure, PlainFile, own_file, visible};
use gleaner_report::Diff;

use crate::args::{DevArgs, ReplayArgs};
use crate::say::say;
use crate::show::{self, Paint};
use crate::{build, replay};

use watch::Seen;

/// Where what a replay is compared with is kept, below its results: `gleaner diff` finds it there,
/// too.
const BEFORE: &str = ".before";

/// Files of a replay from which it is compared with the next.
const COMPARED: [&str; 4] = ["summary.json", "decisions.jsonl", "signals.json", "clips.jsonl"];

/// Longest file that is kept: it is there twice.
const KEPT_MAX: ByteSize = ByteSize::gib(1);

/// Goes on until somebody ends it.
pub(crate) fn run(args: DevArgs) -> Result<Exit, Failure> {
    let dir = args.asked.lambda.clone();
    let out = args.out.clone().unwrap_or_else(|| dir.join("out"));
    let before = out.join(BEFORE);
    let replay = replay_args(args);
    // Of the one before this started, if its results still lie there, too: somebody comes back from
    // lunch.
    let mut has_before = keep(&out, &before);
    let mut seen = Seen::of(&dir);
    loop {
        match once(&dir, &replay) {
            Ok(true) => {
                if has_before && let Err(failure) = compare(&before, &out) {
                    eprintln!("{failure}");
                }
                has_before = keep(&out, &before);
            }
            Ok(false) => {}
            Err(failure) => eprintln!("{failure}"),
        }
        say(&format!("\nwaiting for changes in {} (ctrl-C ends)\n", dir.display()))?;
        let (now, changed) = seen.wait_for_change(&dir);
        seen = now;
        let changed = changed
            .iter()
            .map(|path| visible(&path.to_string_lossy()))
            .collect::<Vec<_>>()
            .join(", ");
        say(&format!("\n── changed: {changed}\n"))?;
    }
}

/// Builds and replays; whether there are results, be they of a lambda with faults or of a damaged
/// drive.
fn once(dir: &Path, args: &ReplayArgs) -> Result<bool, Failure> {
    build::run(dir, false)?;
    replay::results(args).map(|(_, has_results)| has_results)
}

fn compare(before: &Path, out: &Path) -> Result<(), Failure> {
    let mut changes = Diff::between(before, out)?;
    changes.a.out = "before".to_owned();
    changes.b.out = "now".to_owned();
    say(&format!("\n{}", show::diff(&changes, Paint::of_stdout())))
}

/// Copies what a later replay is compared with; false if there is nothing whole.
fn keep(out: &Path, before: &Path) -> bool {
    let copied = || -> io::Result<()> {
        if !out.join(COMPARED[0]).is_file() {
            return Err(io::ErrorKind::NotFound.into());
        }
        own_file::folder(before)?;
        for name in COMPARED {
            match PlainFile::result(&out.join(name), KEPT_MAX) {
                Err(error) if error.kind() == io::ErrorKind::NotFound && name != COMPARED[0] => {
                    let _ = fs::remove_file(before.join(name));
                }
                file => file?.copy_to(&mut own_file::anew(&before.join(name))?)?,
            }
        }
        Ok(())
    };
    match copied() {
        Ok(()) => true,
        Err(error) if error.kind() == io::ErrorKind::NotFound => false,
        Err(error) => {
            eprintln!(
                "warning: these results are not compared with the next: cannot copy them from `{}`: {error}",
                out.display()
            );
            false
        }
    }
}

fn replay_args(args: DevArgs) -> ReplayArgs {
    let DevArgs { asked, drives, from, to, out, no_record } = args;
    ReplayArgs {
        asked,
        drives,
        from,
        to,
        out,
        all: false,
        no_record,
        topics: Vec::new(),
        journal: None,
        verify: None,
        no_report: false,
        json: false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_kept_of_results_is_written_to_files_of_ours_only() {
        let folder = tempfile::tempdir().unwrap();
        let (out, precious) = (folder.path().join("out"), folder.path().join("precious"));
        let before = out.join(BEFORE);
        fs::create_dir_all(&before).unwrap();
        fs::write(&precious, "precious").unwrap();
        fs::write(out.join("summary.json"), "{}").unwrap();
        std::os::unix::fs::symlink(&precious, before.join("summary.json")).unwrap();
        assert!(keep(&out, &before));
        assert_eq!(fs::read_to_string(before.join("summary.json")).unwrap(), "{}");
        assert_eq!(fs::read_to_string(&precious).unwrap(), "precious");
        // What is read is no link, either, and a folder that is one is not written to.
        fs::remove_file(out.join("summary.json")).unwrap();
        std::os::unix::fs::symlink(&precious, out.join("summary.json")).unwrap();
        assert!(!keep(&out, &before));
        assert_eq!(fs::read_to_string(before.join("summary.json")).unwrap(), "{}");
        fs::remove_file(out.join("summary.json")).unwrap();
        fs::write(out.join("summary.json"), "{\"new\": 1}").unwrap();
        fs::rename(&before, folder.path().join("elsewhere")).unwrap();
        std::os::unix::fs::symlink(folder.path().join("elsewhere"), &before).unwrap();
        assert!(!keep(&out, &before));
        assert_eq!(fs::read_to_string(folder.path().join("elsewhere/summary.json")).unwrap(), "{}");
    }
}
