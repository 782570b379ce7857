//! Limits the memory that a process takes from now on.

use std::io;
use std::ops::Range;

use gleaner_protocol::Layer;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::{JailError, layer};

pub const NAME: &str = "memory";

/// Stack limit of the main thread.
const STACK_BYTES: u64 = 8 << 20;

/// Limits the memory that this process takes to `more` bytes beyond what it has.
///
/// It is a limit of data (RLIMIT_DATA), not of addresses: wasmtime and CUDA reserve many of these
/// and use few. Memory that is mapped but not yet used counts. Requests beyond the limit fail as in
/// `malloc`, and the process may go on. An earlier limit stays: set before an `exec`, it bounds the
/// new program as a whole. The stack, which is not data, is limited to its usual size.
pub fn limit(more: u64) -> Layer {
    limit_beyond(used(), more)
}

/// Limits the memory as [`limit`] does, beyond what [`used`] returned earlier.
pub fn limit_beyond(used: Option<u64>, more: u64) -> Layer {
    let note = format!("a data limit of {} MiB above the start", more >> 20);
    layer(NAME, note, set(used, more).map_err(|error| error.chain()))
}

fn set(used: Option<u64>, more: u64) -> Result<(), JailError> {
    let failed = |source| JailError::Limit { what: "memory", source };
    let used = used.ok_or_else(|| failed(io::Error::other("/proc/self/status has no VmData")))?;
    let bound =
        used.saturating_add(more).min(getrlimit(Resource::Data).maximum.unwrap_or(u64::MAX));
    let stack = getrlimit(Resource::Stack);
    let at_most =
        |limit: Option<u64>| Some(limit.map_or(STACK_BYTES, |limit| limit.min(STACK_BYTES)));
    let stack = Rlimit { current: at_most(stack.current), maximum: at_most(stack.maximum) };
    setrlimit(Resource::Stack, stack).map_err(|error| failed(io::Error::from(error)))?;
    setrlimit(Resource::Data, Rlimit { current: Some(bound), maximum: Some(bound) })
        .map_err(|error| failed(io::Error::from(error)))
}

/// Returns the address range of the main thread's stack, including the part that it may grow into
/// under its limit.
pub(crate) fn stack() -> Option<Range<u64>> {
    let maps = std::fs::read_to_string("/proc/self/maps").ok()?;
    let line = maps.lines().find(|line| line.ends_with("[stack]"))?;
    let (begin, end) = line.split_once(' ')?.0.split_once('-')?;
    let address = |text| u64::from_str_radix(text, 16).ok();
    let (begin, end) = (address(begin)?, address(end)?);
    // Arguments and environment, above the stack, do not count against its limit.
    Some(begin.min(end.checked_sub(2 * STACK_BYTES)?)..end)
}

/// Returns the private writable memory of this process, in bytes: the amount that [`limit`] counts.
pub fn used() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmData:"))?;
    line.trim().strip_suffix(" kB")?.parse::<u64>().ok().map(|kib| kib * 1024)
}
