//! A bound of the memory that a process takes from now on.

use std::io;
use std::ops::Range;

use gleaner_protocol::Layer;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::JailError;

/// The name of this layer.
pub const NAME: &str = "memory";

/// Most stack of the thread that a process begins with.
const STACK_BYTES: u64 = 8 << 20;

/// From now on this process can take `more` bytes of memory of its own beyond what it has.
///
/// It is a limit of data (RLIMIT_DATA), not of addresses: wasmtime and CUDA reserve many of these
/// and use few. What is mapped but not yet used counts. Whoever asks for more is refused, as
/// `malloc` is, and may go on. An earlier limit stays: before a process becomes another program,
/// one bounds what that can have at all. The stack, which is no data, gets no larger than is usual.
pub fn limit(more: u64) -> Layer {
    limit_beyond(taken(), more)
}

/// As [`limit`], beyond what [`taken`] told earlier.
pub fn limit_beyond(taken: Option<u64>, more: u64) -> Layer {
    match set(taken, more) {
        Ok(()) => {
            Layer::yes(NAME, format!("a limit of data: {} MiB more than at the start", more >> 20))
        }
        Err(error) => Layer::no(NAME, error.told()),
    }
}

fn set(taken: Option<u64>, more: u64) -> Result<(), JailError> {
    let failed = |source| JailError::Limit { what: "memory", source };
    let taken =
        taken.ok_or_else(|| failed(io::Error::other("/proc/self/status does not tell VmData")))?;
    let bound =
        taken.saturating_add(more).min(getrlimit(Resource::Data).maximum.unwrap_or(u64::MAX));
    let stack = getrlimit(Resource::Stack);
    let at_most =
        |limit: Option<u64>| Some(limit.map_or(STACK_BYTES, |limit| limit.min(STACK_BYTES)));
    let stack = Rlimit { current: at_most(stack.current), maximum: at_most(stack.maximum) };
    setrlimit(Resource::Stack, stack).map_err(|error| failed(io::Error::from(error)))?;
    setrlimit(Resource::Data, Rlimit { current: Some(bound), maximum: Some(bound) })
        .map_err(|error| failed(io::Error::from(error)))
}

/// Where the stack of the first thread of this process lies, and where it may grow to once it has a
/// limit.
pub(crate) fn stack() -> Option<Range<u64>> {
    let maps = std::fs::read_to_string("/proc/self/maps").ok()?;
    let line = maps.lines().find(|line| line.ends_with("[stack]"))?;
    let (begin, end) = line.split_once(' ')?.0.split_once('-')?;
    let address = |text| u64::from_str_radix(text, 16).ok();
    let (begin, end) = (address(begin)?, address(end)?);
    // What is above the stack, arguments and the like, is no part of its limit.
    Some(begin.min(end.checked_sub(2 * STACK_BYTES)?)..end)
}

/// Private writable memory of this process, in bytes: what [`limit`] counts.
pub fn taken() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmData:"))?;
    line.trim().strip_suffix(" kB")?.parse::<u64>().ok().map(|kib| kib * 1024)
}
