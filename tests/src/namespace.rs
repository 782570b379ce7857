//! A private network for a test: a network namespace for one process and its children, with only
//! `lo` and multicast. In the network of the machine, a DDS participant of a test would discover
//! those of other programs.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use libtest_mimic::Failed;

/// Shell script that prepares the network for DDS, then becomes the program in `$0` with its
/// arguments.
const SET_UP: &str = "ip link set lo up && ip link set lo multicast on && \
                      ip route add 224.0.0.0/4 dev lo && exec \"$0\" \"$@\"";

/// Returns the reason why no private network can be created; `None` if one can.
pub fn unavailable() -> Option<&'static str> {
    let reason =
        "cannot create a private network: `unshare -n` or `ip` is missing or not permitted";
    unshare_options().is_none().then_some(reason)
}

/// Returns a command that runs `program` in a new private network, which ends with it.
pub fn command(program: &Path) -> Command {
    let mut command =
        shell(unshare_options().expect("the caller has checked `unavailable`"), SET_UP);
    command.arg(program);
    command
}

/// Returns a command that runs this program again in a private network, with the environment
/// variable `name` set to `value` to select its work.
pub fn rerun(name: &str, value: &str) -> Command {
    let mut command = command(&std::env::current_exe().expect("a program has a path"));
    command.env(name, value);
    command
}

/// Runs a case of a test suite in a private network: runs this program again with the environment
/// variable `name` set to `case`, and prints its output.
pub fn case(name: &str, case: &str) -> Result<(), Failed> {
    let output = rerun(name, case).stdin(Stdio::null()).output()?;
    print!("{}", String::from_utf8_lossy(&output.stdout));
    if output.status.success() {
        return Ok(());
    }
    Err(format!("{}; stderr:\n{}", output.status, String::from_utf8_lossy(&output.stderr)).into())
}

/// Returns the options of `unshare` that work here: root needs only `-n`; other users become root
/// of a user namespace, where that is permitted.
fn unshare_options() -> Option<&'static [&'static str]> {
    static OPTIONS: OnceLock<Option<&[&str]>> = OnceLock::new();
    *OPTIONS.get_or_init(|| {
        let candidates: [&[&str]; 2] = [&["-n"], &["-r", "-n"]];
        candidates.into_iter().find(|options| {
            let mut probe = shell(options, SET_UP);
            let probe =
                probe.arg("true").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
            probe.status().is_ok_and(|status| status.success())
        })
    })
}

fn shell(options: &[&str], script: &str) -> Command {
    let mut command = Command::new("unshare");
    command.args(options).args(["--", "sh", "-c", script]);
    command
}
