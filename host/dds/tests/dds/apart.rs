//! A network of our own.

use std::env;
use std::process::{Command, ExitCode, Stdio};

const INSIDE: &str = "GLEANER_DDS_TESTS_INSIDE";
/// `lo` is all there is, and takes multicast, too. Then `"$@"`.
const SCRIPT: &str = "ip link set lo up && ip link set lo multicast on && ip route add 224.0.0.0/4 dev lo && exec \"$@\"";

/// Whether this process is in a network of its own.
pub fn inside() -> bool {
    env::var_os(INSIDE).is_some()
}

fn unshared() -> Command {
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-root-user", "--net", "sh", "-c", SCRIPT, "sh"]).env(INSIDE, "1");
    command
}

/// Runs this program again in a network of its own.
pub fn rerun() -> Result<ExitCode, String> {
    let may = unshared().arg("true").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if !may.is_ok_and(|status| status.success()) {
        return Err("no network of our own can be made here".to_owned());
    }
    let program = env::current_exe().map_err(|error| error.to_string())?;
    let status = unshared()
        .arg(program)
        .args(env::args_os().skip(1))
        .status()
        .map_err(|error| error.to_string())?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
