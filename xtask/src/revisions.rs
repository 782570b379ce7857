//! `cargo xtask bench compare BASE HEAD NAME`: measures two revisions in turns, by `revisions.sh`.

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::Command;

use crate::checkout::Checkout;

/// Returns the command that measures: `arguments` are BASE, HEAD, NAME and options.
pub(crate) fn script(checkout: &Checkout, arguments: &[OsString]) -> Command {
    let mut script = checkout.script("bash");
    script.args(["-c", include_str!("revisions.sh"), "revisions"]).args(arguments);
    script.env("CARGO", checkout.cargo().get_program());
    script.env("CARGO_TARGET_DIR", checkout.target());
    script
}

/// The folders with the runs of both revisions.
pub(crate) fn runs(checkout: &Checkout) -> [PathBuf; 2] {
    ["base", "head"].map(|side| checkout.target().join("bench/compare").join(side))
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};
    use std::process::Output;

    use super::*;
    use gleaner_test_support::TestFolder;

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

        fn measure(&self, arguments: &[&str]) -> Output {
            let arguments: Vec<_> = arguments.iter().map(OsString::from).collect();
            script(&self.checkout(), &arguments).output().unwrap()
        }

        /// The exit code, and the error.
        fn failed(&self, arguments: &[&str]) -> (Option<i32>, String) {
            let Output { status, stderr, .. } = self.measure(arguments);
            (status.code(), String::from_utf8(stderr).unwrap())
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
        for rounds in [3, 2] {
            let rounds_text = rounds.to_string();
            let arguments = ["one", "two", "replay", "--rounds", &rounds_text, "--long"];
            let measured = repository.measure(&arguments);
            assert!(measured.status.success(), "{measured:?}");
            for (runs, value) in runs(&repository.checkout()).iter().zip(["one", "two"]) {
                let runs = fs::read_dir(runs).unwrap().map(|run| run.unwrap().path());
                let runs: Vec<_> = runs.collect();
                // Those of an earlier comparison are gone.
                assert_eq!(runs.len(), rounds);
                for run in runs {
                    assert_eq!(fs::read_to_string(run.join("results.json")).unwrap(), value);
                }
            }
        }
        let calls = &repository.calls()[..8];
        assert_eq!(calls[..2], ["one", "two"].map(|it| format!("{it} xtask bench replay --quick")));
        let order: Vec<&str> = calls[2..].iter().map(|call| &call[..3]).collect();
        assert_eq!(order, ["one", "two", "two", "one", "one", "two"]);
        assert!(calls[2].ends_with("xtask bench replay --long"), "{calls:?}");
    }

    #[test]
    fn what_cannot_be_compared_is_an_error_with_its_cause() {
        let repository = Repository::new();
        let once = ["one", "two", "replay", "--rounds", "1"];
        assert!(repository.measure(&once).status.success());
        // As after a kill.
        for worktree in fs::read_dir(repository.0.path(".git/worktrees")).unwrap() {
            fs::write(worktree.unwrap().path().join("index.lock"), "").unwrap();
        }
        assert!(repository.measure(&once).status.success());
        for (arguments, code, error) in [
            (&["one", "HEAD~2", "replay"][..], 2, "one revision"),
            (&["one", "never", "replay"], 2, "`never` is no revision"),
            (&["one", "--help", "replay"], 2, "`--help` is no revision"),
            (&["one", "two", "parts"], 2, "`parts` cannot be measured"),
            (&["one", "two", "replay", "--rounds", "0"], 2, "from 1 to 1000"),
            (&["one", "broken", "replay"], 1, "`broken` has no results of replay"),
        ] {
            let failed = repository.failed(arguments);
            assert!(failed.0 == Some(code) && failed.1.contains(error), "{failed:?}");
        }
        let lock = File::create(repository.0.path("target/revisions/lock")).unwrap();
        lock.lock().unwrap();
        assert!(repository.failed(&once).1.contains("another comparison"));
    }
}
