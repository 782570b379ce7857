//! Starts programs, and writes scripts that take the place of programs.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::{Mutex, PoisonError};

use gleaner_trust::{Labels, RootKeys, ScopedKey, TrustRoot};
use serde_json::Value;

/// Linux refuses to start a file that is open for writing anywhere, such as in a child that another
/// test is about to start. The lock serialises writing and starting programs.
static EXEC_LOCK: Mutex<()> = Mutex::new(());

pub fn script(path: &Path, text: &str) {
    let _lock = EXEC_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
    fs::write(path, text).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
}

pub fn start(command: &mut Command) -> Child {
    let _lock = EXEC_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
    command.spawn().unwrap()
}

pub fn output(command: &mut Command) -> Output {
    start(command.stdout(Stdio::piped()).stderr(Stdio::piped())).wait_with_output().unwrap()
}

/// Runs a program that must succeed, and returns its standard output.
#[track_caller]
pub fn done(command: &mut Command) -> String {
    let Output { status, stdout, stderr } = output(command);
    assert!(status.success(), "{}", String::from_utf8_lossy(&stderr));
    String::from_utf8(stdout).unwrap()
}

pub fn gleaner(folder: &Path, arguments: &[&str]) -> Command {
    let mut gleaner = Command::new(env!("CARGO_BIN_EXE_gleaner"));
    gleaner.current_dir(folder).args(arguments).stdin(Stdio::null());
    gleaner
}

/// Runs a program that must fail with `code`, and returns its message.
#[track_caller]
pub fn fails(mut command: Command, code: i32) -> String {
    failed(output(&mut command), code)
}

/// Returns the message of a program that must have failed with `code`.
#[track_caller]
pub fn failed(Output { status, stderr, .. }: Output, code: i32) -> String {
    let text = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(code), "{text}");
    assert!(text.starts_with("error: ") && text.contains("  help:  "), "{text}");
    text
}

/// Returns a root that trusts a key, as `gleaner keys show --json` prints it, for all lambdas.
pub fn trusting(shown: &str) -> TrustRoot {
    let shown: Value = serde_json::from_str(shown).unwrap();
    let key = shown["public"].as_str().unwrap().parse().unwrap();
    let lambdas = vec!["*".parse().unwrap()];
    let scoped = vec![ScopedKey { key, lambdas, labels: Labels::new() }];
    TrustRoot {
        version: 1,
        created: 0,
        expires: 1,
        root: RootKeys { threshold: 1, keys: vec![scoped[0].key.clone()] },
        publishers: scoped.clone(),
        deployers: scoped,
    }
}
