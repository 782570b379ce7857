//! A bound of the memory that a process takes from now on.

use std::io;

use gleaner_protocol::Layer;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

use crate::JailError;

/// The name of this layer.
pub const NAME: &str = "memory";

/// Most stack of the thread that a process begins with.
const STACK_BYTES: u64 = 8 << 20;

/// From now on this process can take `more` bytes of memory of its own beyond what it has.
///
/// It is a limit of data (RLIMIT_DATA), not of addresses: wasmtime and CUDA reserve many of these and use few. What is mapped
/// but not yet used counts. Whoever asks for more is refused, as `malloc` is, and may go on. An earlier limit stays: before a
/// process becomes another program, one bounds what that can have at all. The stack, which is no data, gets no larger than is usual.
pub fn limit(more: u64) -> Layer {
    match set(more) {
        Ok(()) => Layer::yes(NAME, format!("a limit of data: {} MiB more than at the start", more >> 20)),
        Err(error) => Layer::no(NAME, error.told()),
    }
}

fn set(more: u64) -> Result<(), JailError> {
    let failed = |source| JailError::Limit { what: "memory", source };
    let now = data().ok_or_else(|| failed(io::Error::other("/proc/self/status does not tell VmData")))?;
    let bound = now.saturating_add(more).min(getrlimit(Resource::Data).maximum.unwrap_or(u64::MAX));
    let stack = getrlimit(Resource::Stack);
    let at_most = |limit: Option<u64>| Some(limit.map_or(STACK_BYTES, |limit| limit.min(STACK_BYTES)));
    let stack = Rlimit { current: at_most(stack.current), maximum: at_most(stack.maximum) };
    setrlimit(Resource::Stack, stack).map_err(|error| failed(io::Error::from(error)))?;
    setrlimit(Resource::Data, Rlimit { current: Some(bound), maximum: Some(bound) })
        .map_err(|error| failed(io::Error::from(error)))
}

/// Private writable memory of this process, in bytes.
fn data() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmData:"))?;
    line.trim().strip_suffix(" kB")?.parse::<u64>().ok().map(|kib| kib * 1024)
}
