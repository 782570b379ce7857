//! A private network for one test: only `lo`, with multicast, and nobody else on it.
//!
//! Linux gives a process a network of its own, with which what it starts is alone. A DDS peer that
//! is started any other way could talk to whatever runs on this machine or next to it.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use libtest_mimic::Failed;

/// What makes a network usable for DDS, then the program in `$0` with its arguments.
const SET_UP: &str = "ip link set lo up && ip link set lo multicast on && ip route add 224.0.0.0/4 dev lo && exec \"$0\" \"$@\"";

/// Why there can be no private network here; `None` where there can.
pub fn unavailable() -> Option<&'static str> {
    if way().is_some() {
        None
    } else {
        Some("no private network can be made here: unshare -n and ip are needed")
    }
}

/// `program`, to be run in a private network that ends with it.
///
/// # Panics
///
/// If there can be none; see [`unavailable`].
pub fn command(program: &Path) -> Command {
    let mut command =
        shell(way().expect("asked before whether there can be a private network"), SET_UP);
    command.arg(program);
    command
}

/// This program once more, in a private network, with the variable `name` set to `value`, so that
/// it knows what it is to do.
///
/// # Panics
///
/// As [`command`].
pub fn again(name: &str, value: &str) -> Command {
    let mut command = command(&std::env::current_exe().expect("a program has a path"));
    command.env(name, value);
    command
}

/// Runs one case of a suite in a private network: this program once more, with the variable `name`
/// set to the `case`. What it prints is shown.
///
/// # Errors
///
/// How it ended, and what it said, if it did not succeed.
///
/// # Panics
///
/// As [`command`].
pub fn case(name: &str, case: &str) -> Result<(), Failed> {
    let output = again(name, case).stdin(Stdio::null()).output()?;
    print!("{}", String::from_utf8_lossy(&output.stdout));
    if output.status.success() {
        return Ok(());
    }
    Err(format!("{}; it said:\n{}", output.status, String::from_utf8_lossy(&output.stderr)).into())
}

/// The options of `unshare` that work here: root needs no more than `-n`, others become root of a
/// user namespace, where that is allowed.
fn way() -> Option<&'static [&'static str]> {
    static WAY: OnceLock<Option<&[&str]>> = OnceLock::new();
    *WAY.get_or_init(|| {
        let ways: [&[&str]; 2] = [&["-n"], &["-r", "-n"]];
        ways.into_iter().find(|way| {
            let mut probe = shell(way, SET_UP);
            let probe =
                probe.arg("true").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            probe.status().is_ok_and(|status| status.success())
        })
    })
}

fn shell(way: &[&str], script: &str) -> Command {
    let mut command = Command::new("unshare");
    command.args(way).args(["--", "sh", "-c", script]);
    command
}
