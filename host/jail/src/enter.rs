//! A process that is in its control group before its program begins.
#![allow(unsafe_code)]

use std::fs::File;
use std::os::unix::process::CommandExt;
use std::process::Command;

/// Has what `command` starts write itself into `processes`, the list of a group, before it becomes
/// its program.
pub(crate) fn before_program(command: &mut Command, processes: File) {
    let enter = move || {
        rustix::io::write(&processes, b"0")?;
        Ok(())
    };
    // SAFETY: between `fork` and `exec` only this runs: a write to a file that is open, which
    // neither allocates nor locks.
    unsafe {
        command.pre_exec(enter);
    }
}
