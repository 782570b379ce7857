//! Reruns the tests in a network namespace of their own.

use std::env;
use std::process::{Command, ExitCode, Stdio};

const INSIDE: &str = "GLEANER_DDS_TESTS_INSIDE";
/// Brings up `lo`, the only interface, with multicast; then runs `"$@"`.
const SCRIPT: &str = "ip link set lo up && ip link set lo multicast on && \
                      ip route add 224.0.0.0/4 dev lo && exec \"$@\"";

/// Returns whether this process is in a network namespace of its own.
pub fn inside() -> bool {
    env::var_os(INSIDE).is_some()
}

fn unshared() -> Command {
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-root-user", "--net", "sh", "-c", SCRIPT, "sh"]).env(INSIDE, "1");
    command
}

/// Runs this program again in a network namespace of its own.
pub fn rerun() -> Result<ExitCode, String> {
    let may = unshared().arg("true").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if !may.is_ok_and(|status| status.success()) {
        return Err("a network namespace cannot be created here".to_owned());
    }
    let program = env::current_exe().map_err(|error| error.to_string())?;
    let status = unshared()
        .arg(program)
        .args(env::args_os().skip(1))
        .status()
        .map_err(|error| error.to_string())?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
