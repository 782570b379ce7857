//! Limits of open files: a soft one, which counts, and a hard one, up to which it may be raised.

use std::sync::OnceLock;

use rustix::process::{Pid, Resource, Rlimit, getrlimit, prlimit, setrlimit};

/// Usual soft limit of a system. A program whose starter has raised its own limit does not find
/// the former one.
const USUAL: u64 = 1024;

/// The soft limit before it was raised.
static FORMER: OnceLock<u64> = OnceLock::new();

/// Allows this process as many open files as its hard limit.
pub fn raise_open_files() {
    let limits = getrlimit(Resource::Nofile);
    FORMER.get_or_init(|| limits.current.unwrap_or(USUAL));
    // Raising it to the maximum is never refused.
    let _ = setrlimit(Resource::Nofile, Rlimit { current: limits.maximum, ..limits });
}

/// Lowers the soft limit of the child process `pid`, which has inherited it, to that before
/// [`raise_open_files`], and to the usual one at most. Without such a call it does nothing.
pub fn restore_open_files(pid: u32) {
    let Some(former) = FORMER.get() else { return };
    let limits = Rlimit { current: Some(*former.min(&USUAL)), ..getrlimit(Resource::Nofile) };
    if let Some(pid) = i32::try_from(pid).ok().and_then(Pid::from_raw) {
        // Refused if it has lowered its own hard limit already: then it has chosen both.
        let _ = prlimit(Some(pid), Resource::Nofile, limits);
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::process::{Command, Stdio};

    use super::*;

    #[test]
    fn the_limit_is_raised_for_this_process_and_not_for_its_child() {
        let limits = getrlimit(Resource::Nofile);
        setrlimit(Resource::Nofile, Rlimit { current: Some(300), ..limits }).unwrap();
        raise_open_files();
        assert_eq!(getrlimit(Resource::Nofile).current, limits.maximum);
        let mut shell = Command::new("sh");
        shell.args(["-c", "read line; ulimit -Sn"]).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = shell.spawn().unwrap();
        restore_open_files(child.id());
        child.stdin.take().unwrap().write_all(b"go\n").unwrap();
        let output = child.wait_with_output().unwrap();
        assert_eq!(String::from_utf8_lossy(&output.stdout), "300\n");
    }
}
