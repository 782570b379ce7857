//! `cargo xtask bench compare BASE HEAD NAME`: measures two revisions in turns.
//!
//! Each has a checkout of its own below `target/revisions`, with its own build. It is kept, so that
//! only the first measurement of a revision takes the time of a build.

use std::env;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::steps::{self, Steps};

const USAGE: &str =
    "usage: cargo xtask bench compare BASE HEAD NAME [--rounds N] [options of NAME]";

/// Runs of each revision. Rows with fewer than five values get no verdict.
const ROUNDS: usize = 5;

const BENCHMARKS: &str =
    "rtt, scale, isolation, cold-start, replay, record, drives, kernels, inference, fleet";

/// Benchmarks that need gleaner-player, which is not built with the other programs.
const LIVE: [&str; 3] = ["rtt", "scale", "isolation"];

struct Revision {
    /// As it was named.
    name: String,
    commit: String,
    checkout: Checkout,
    runs: PathBuf,
}

/// Measures two revisions by the benchmark `name`, and returns the folders with their runs.
pub(crate) fn measure(
    checkout: &Checkout,
    names: [&OsStr; 2],
    name: &OsStr,
    rest: &[OsString],
) -> Result<[PathBuf; 2], Failure> {
    let (rounds, options) = rounds(rest)?;
    if !BENCHMARKS.split(", ").any(|known| name == known) {
        let message = format!("`{}` cannot be measured in two revisions", name.display());
        return Err(Failure::new(Exit::Usage, message)
            .with_help(format!("name one of these: {BENCHMARKS}")));
    }
    let folder = checkout.target().join("revisions");
    fs::create_dir_all(&folder).map_err(|error| cannot_use(&folder, &error))?;
    let lock = File::create(folder.join("lock")).map_err(|error| cannot_use(&folder, &error))?;
    if lock.try_lock().is_err() {
        let message = "another comparison of revisions runs in this checkout";
        return Err(Failure::new(Exit::Usage, message)
            .with_help("wait for its end: they would disturb each other"));
    }
    let runs = checkout.target().join("bench").join("compare");
    let revision = |revision: &OsStr, side: &str| -> Result<Revision, Failure> {
        let commit = commit(checkout, revision)?;
        let own = checkout.other(folder.join(&commit[..12]));
        let name = revision.to_string_lossy().into_owned();
        Ok(Revision { name, commit, checkout: own, runs: runs.join(side) })
    };
    let sides = [revision(names[0], "base")?, revision(names[1], "head")?];
    if sides[0].commit == sides[1].commit {
        let message = format!("`{}` and `{}` are one revision", sides[0].name, sides[1].name);
        return Err(Failure::new(Exit::Usage, message)
            .with_help("commit the change that is to be measured"));
    }
    warn_of_changes(checkout)?;
    let mut steps = Steps::of(2 + 2 * rounds);
    for side in &sides {
        steps.begin(&format!("{}, built in {}", side.name, side.checkout.path("").display()));
        side.prepare(checkout, name)?;
    }
    for round in 0..rounds {
        // Each begins in every second round.
        let order = if round % 2 == 0 { [0, 1] } else { [1, 0] };
        for index in order {
            let side = &sides[index];
            steps.begin(&format!("{}, run {} of {rounds}", side.name, round + 1));
            side.run(name, options, &side.runs.join(format!("{:03}", round + 1)))?;
        }
    }
    println!(
        "A is {} ({:.12}), B is {} ({:.12})",
        sides[0].name, sides[0].commit, sides[1].name, sides[1].commit
    );
    Ok(sides.map(|side| side.runs))
}

impl Revision {
    /// Checks the revision out, and builds all that the benchmark needs: a short run does that, and
    /// shows that this revision can be measured.
    fn prepare(&self, checkout: &Checkout, name: &OsStr) -> Result<(), Failure> {
        let folder = self.checkout.path("");
        let mut restore = self.checkout.command("git");
        restore.args(["checkout", "--quiet", "--force", "--detach", &self.commit]);
        if !folder.join(".git").is_file() || !steps::succeeds(&mut restore) {
            // There is none yet, or git was interrupted in it.
            steps::remove_folder(&folder)?;
            let mut add = checkout.command("git");
            add.args(["worktree", "add", "--force", "--detach"]).arg(&folder).arg(&self.commit);
            steps::run(&mut add, "see the message of git above")?;
        }
        let trial = self.checkout.target().join("bench/trial");
        for old in [&self.runs, &trial] {
            steps::remove_folder(old)?;
        }
        if LIVE.iter().any(|live| name == *live) {
            let mut player = self.cargo();
            steps::run(player.args(["xtask", "player"]), "see the message above")?;
        }
        self.run(name, &["--quick".into()], &trial)
    }

    /// Cargo with the Python of the user: that of the checkout may not be made yet.
    fn cargo(&self) -> Command {
        let mut cargo = self.checkout.cargo();
        match env::var_os("GLEANER_PYTHON") {
            Some(python) => cargo.env("GLEANER_PYTHON", python),
            None => cargo.env_remove("GLEANER_PYTHON"),
        };
        cargo
    }

    /// Runs the benchmark; its results are in `out` afterwards.
    fn run(&self, name: &OsStr, options: &[OsString], out: &Path) -> Result<(), Failure> {
        let results = out.join("results.json");
        let mut bench = self.cargo();
        bench.args(["xtask", "bench"]).arg(name).args(options).arg("--out").arg(out);
        let ended = steps::run(&mut bench, "see the messages above");
        // A goal that is not met is no error here.
        if results.is_file() {
            return Ok(());
        }
        let message = format!("`{}` has no results of {}", self.name, name.display());
        let failure = Failure::new(Exit::Internal, message).with_help(
            "see its messages above; revisions before `cargo xtask bench NAME --out DIR` cannot be \
             compared",
        );
        Err(match ended {
            Err(cause) => Failure { causes: cause.causes, ..failure },
            Ok(()) => failure,
        })
    }
}

/// Splits off `--rounds N`.
fn rounds(rest: &[OsString]) -> Result<(usize, &[OsString]), Failure> {
    match rest {
        [flag, number, options @ ..] if flag == "--rounds" => {
            let number = number.to_str().and_then(|number| number.parse().ok());
            let number = number.filter(|number| (1..=1000).contains(number));
            let refused = || {
                Failure::new(Exit::Usage, "`--rounds` takes a number from 1 to 1000")
                    .with_help(USAGE)
            };
            Ok((number.ok_or_else(refused)?, options))
        }
        _ => Ok((ROUNDS, rest)),
    }
}

/// The whole name of a commit.
fn commit(checkout: &Checkout, revision: &OsStr) -> Result<String, Failure> {
    let mut text = revision.to_owned();
    text.push("^{commit}");
    let mut parse = checkout.command("git");
    parse.args(["rev-parse", "--verify", "--quiet", "--end-of-options"]).arg(text);
    let commit =
        steps::output(&mut parse, "name a commit, a branch or a tag").map_err(|failure| {
            let message = format!("`{}` is no revision of this repository", revision.display());
            Failure { message, ..failure }.with_help(USAGE)
        })?;
    Ok(commit.trim().to_owned())
}

fn warn_of_changes(checkout: &Checkout) -> Result<(), Failure> {
    let mut status = checkout.command("git");
    status.args(["status", "--porcelain", "--untracked-files=no"]);
    if !steps::output(&mut status, "see the message of git above")?.is_empty() {
        println!("changes that are not committed are not measured");
    }
    Ok(())
}

fn cannot_use(path: &Path, error: &std::io::Error) -> Failure {
    steps::cannot("use", path, error).with_help("the target folder has to be writable")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_folder::TestFolder;

    /// Takes the place of cargo: the results are the content of `value` in the checkout. Each call
    /// is a line of `calls`, next to this file. A Python that is named has to exist.
    const CARGO: &str = r#"#!/bin/sh
test -x "${GLEANER_PYTHON:-/bin/sh}" || exit 1
echo "$(cat value) $*" >> "$(dirname "$0")/calls"
test "$(cat value)" != broken || exit 1
while [ "$1" != --out ]; do shift; done
mkdir -p "$2"
cp value "$2/results.json"
# As if a goal was not met.
exit 1
"#;

    struct Repository(TestFolder);

    impl Repository {
        fn new() -> Self {
            let repository = Self(TestFolder::new());
            repository.0.write_program("bin/cargo", CARGO);
            repository.0.write(".gitignore", "target\nbin\n");
            for value in ["one", "two", "broken"] {
                repository.0.write("value", value);
                repository.checkout().commit_all();
                repository.checkout().git(&["tag", value]);
            }
            repository
        }

        fn checkout(&self) -> Checkout {
            let (root, cargo) = (self.0.root().to_owned(), self.0.path("bin/cargo"));
            Checkout::with_cargo(root, cargo.into())
        }

        fn measure(&self, [base, head]: [&str; 2], rest: &[&str]) -> Result<[PathBuf; 2], Failure> {
            let checkout = self.checkout();
            let rest: Vec<OsString> = rest.iter().map(OsString::from).collect();
            measure(&checkout, [base.as_ref(), head.as_ref()], "replay".as_ref(), &rest)
        }

        /// The calls of cargo: the revision, and its arguments up to the folder.
        fn calls(&self) -> Vec<String> {
            let calls = fs::read_to_string(self.0.path("bin/calls")).unwrap();
            let call = |line: &str| line.split(" --out").next().unwrap().to_owned();
            calls.lines().map(call).collect()
        }
    }

    #[test]
    fn two_revisions_are_measured_in_turns() {
        let repository = Repository::new();
        let args = ["--rounds", "3", "--long"];
        for rounds in [&args[..], &["--rounds", "2"]] {
            let runs = repository.measure(["one", "two"], rounds).unwrap();
            for (runs, value) in runs.iter().zip(["one", "two"]) {
                let mut numbers: Vec<_> =
                    fs::read_dir(runs).unwrap().map(|run| run.unwrap().path()).collect();
                numbers.sort();
                // Those of an earlier comparison are gone.
                assert_eq!(numbers.len().to_string(), rounds[1]);
                for run in numbers {
                    assert_eq!(fs::read_to_string(run.join("results.json")).unwrap(), value);
                }
            }
            if rounds.len() == 3 {
                let calls = repository.calls();
                assert_eq!(
                    calls[..2],
                    ["one xtask bench replay --quick", "two xtask bench replay --quick"]
                );
                let order: Vec<&str> = calls[2..].iter().map(|call| &call[..3]).collect();
                assert_eq!(order, ["one", "two", "two", "one", "one", "two"]);
                assert!(calls[2].ends_with("xtask bench replay --long"), "{calls:?}");
            }
        }
    }

    #[test]
    fn what_cannot_be_compared_is_an_error_with_its_cause() {
        let repository = Repository::new();
        let failed =
            |names, rest: &[&str]| repository.measure(names, rest).unwrap_err().to_string();
        assert!(failed(["one", "HEAD~2"], &[]).contains("one revision"));
        assert!(failed(["one", "never"], &[]).contains("`never` is no revision"));
        // As after a kill.
        repository.measure(["one", "two"], &["--rounds", "1"]).unwrap();
        for worktree in fs::read_dir(repository.0.path(".git/worktrees")).unwrap() {
            fs::write(worktree.unwrap().path().join("index.lock"), "").unwrap();
        }
        repository.measure(["one", "two"], &["--rounds", "1"]).unwrap();
        assert!(failed(["one", "--help"], &[]).contains("`--help` is no revision"));
        assert!(failed(["one", "two"], &["--rounds", "0"]).contains("from 1 to 1000"));
        assert!(failed(["one", "broken"], &[]).contains("`broken` has no results of replay"));
        let lock = File::create(repository.0.path("target/revisions/lock")).unwrap();
        lock.lock().unwrap();
        assert!(failed(["one", "two"], &[]).contains("another comparison"));
    }
}
