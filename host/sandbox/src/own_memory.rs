//! Hides the memory and descriptors of a process from other processes of its user.

use gleaner_protocol::Layer;
use rustix::process::{DumpableBehavior, set_dumpable_behavior};

pub const NAME: &str = "own memory";

/// Denies other processes of this user access to `/proc/PID/mem`, `/proc/PID/fd` and similar files
/// of this process, also where these processes are not restricted.
pub(crate) fn hide() -> Layer {
    let hidden = set_dumpable_behavior(DumpableBehavior::NotDumpable);
    crate::layer(NAME, "not dumpable: hidden from other processes of the user", hidden)
}
