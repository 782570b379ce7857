//! pip gets what `gleaner build` has read of a requirements.txt, and settings of the user.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::Command;

use gleaner_tests::{TempFolder, program};

/// A Python whose pip writes down what it gets, and fails.
const PYTHON: &str = r#"#!/bin/sh
here=$(dirname "$0")
case "$*" in
*"-m pip"*) { env; ls -A; while [ "$1" != --requirement ]; do shift; done; cat "$2"; } >"$here/got"
    exit 1 ;;
*) echo "3 11"; echo "$0" ;;
esac
"#;

#[test]
fn pip_gets_what_was_read_and_no_secrets() {
    let folder = TempFolder::new();
    let python = folder.write("fake/python3", PYTHON);
    fs::set_permissions(&python, fs::Permissions::from_mode(0o700)).expect("our file");
    let lambda = "{ name = 'x', version = '0.1.0', kind = 'python', entry = 'main.py' }";
    folder.write("lambda/lambda.toml", format!("lambda = {lambda}\nschedule.period = '1s'\n"));
    folder.write("lambda/main.py", "");
    let hash = "0".repeat(64);
    let build = |line: &str| {
        folder
            .write("lambda/requirements.txt", format!("# -e .\n{line} \\\n --hash=sha256:{hash}"));
        let mut build = Command::new(program("gleaner"));
        build.args(["build", "."]).current_dir(folder.path().join("lambda"));
        build.env("GLEANER_PYTHON", &python).env("PIP_INDEX_URL", "https://index/simple");
        build.env("GLEANER_CLOUD_TOKEN", "secret").env("PIP_REQUIREMENT", "secret");
        let built = build.output().expect("gleaner starts");
        assert_eq!(built.status.code(), Some(2));
        let got = fs::read_to_string(folder.path().join("fake/got")).unwrap_or_default();
        (String::from_utf8_lossy(&built.stderr).into_owned(), got)
    };
    let (stderr, got) = build("x @ http://host/${HOME}");
    let message = "`./requirements.txt`, line 2: `x @ http://host/${HOME}` is not NAME==VERSION";
    assert!(stderr.contains(message) && stderr.contains("uv pip compile"), "{stderr}");
    assert_eq!(got, "", "pip was started");
    let (stderr, got) = build("x==1");
    assert!(stderr.contains("pip did not fetch the wheels"), "{stderr}");
    assert!(got.contains("PIP_INDEX_URL=https://index/simple\n"), "{got}");
    let list = format!("\nrequirements.txt\nx==1 --hash=sha256:{hash}\n");
    assert!(got.ends_with(&list) && !got.contains("secret"), "{got}");
}
