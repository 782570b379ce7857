//! Makes a child process join its control group before its program begins.
#![allow(unsafe_code)]

use std::fs::File;
use std::os::unix::process::CommandExt;
use std::process::Command;

/// Makes the child of `command` write itself into `processes`, the list of a group, before `exec`.
pub(crate) fn before_exec(command: &mut Command, processes: File) {
    let join = move || {
        rustix::io::write(&processes, b"0")?;
        Ok(())
    };
    // SAFETY: between `fork` and `exec` only this closure runs: it writes to an open file, and
    // neither allocates nor locks.
    unsafe {
        command.pre_exec(join);
    }
}
