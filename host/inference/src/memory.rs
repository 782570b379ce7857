//! Memory of this process, as its limit counts it. A failed allocation of a library ends it, and is
//! charged to what alone was in use: so a part of the memory is left to each load and run.

use std::fs::read_to_string;
use std::sync::OnceLock;

use gleaner_protocol::Layer;
use gleaner_protocol::inference::ModelMemory;
use gleaner_protocol::process_stats::usage;
use rustix::process::{Resource, getrlimit};

/// The divisor of the part of the limit that is left to each run.
pub(crate) const RUN_PART: u64 = 4;

static LIMIT: OnceLock<u64> = OnceLock::new();

/// Memory of the libraries of GPUs, which all models share.
static LIBRARIES: OnceLock<u64> = OnceLock::new();

/// Limits the memory that this process takes from now on.
pub(crate) fn limit(bytes: u64) -> Layer {
    LIMIT.get_or_init(|| bytes);
    gleaner_sandbox::memory::limit(bytes)
}

/// Returns private writable memory, in bytes; 0 if unknown.
fn used() -> u64 {
    let pages = read_to_string("/proc/self/statm").unwrap_or_default();
    let pages = pages.split_ascii_whitespace().nth(5).and_then(|it| it.parse::<u64>().ok());
    pages.unwrap_or(0) * rustix::param::page_size() as u64
}

pub(crate) fn now() -> [u64; 2] {
    [used(), usage::resident()]
}

/// Returns the memory that was taken since [`now`].
pub(crate) fn taken_since(before: [u64; 2]) -> ModelMemory {
    let held = used().saturating_sub(before[0]);
    // The kernel has no peak of what counts. Memory that was never written is not in this one.
    let peak = usage::peak_resident().saturating_sub(before[1]).max(held);
    ModelMemory { held, peak }
}

/// Returns the memory of a model whose load on a GPU `took` this. The first such load also takes
/// that of the libraries, up to half of the limit.
pub(crate) fn without_libraries(took: u64) -> ModelMemory {
    let libraries = took.min(LIMIT.get().map_or(u64::MAX, |limit| limit / 2));
    let held = LIBRARIES.set(libraries).map_or(took, |()| took - libraries);
    ModelMemory { held, peak: held }
}

/// Returns the limit and the memory that may still be taken; `None` without a limit.
fn free() -> Option<(u64, u64)> {
    let limit = *LIMIT.get()?;
    Some((limit, getrlimit(Resource::Data).current?.saturating_sub(used())))
}

/// Returns whether, with the `own` memory of a model, less than a part of what is left beside the
/// libraries is free.
pub(crate) fn is_short(part: u64, own: u64) -> bool {
    let libraries = LIBRARIES.get().unwrap_or(&0);
    free().is_some_and(|(limit, free)| free.saturating_add(own) < (limit - libraries) / part)
}

/// Returns why a model must not be loaded that takes `asked`: with it, runs of it or of `loaded`
/// models, each with its path, could fail. The only one may take all.
pub(crate) fn refusal(asked: ModelMemory, loaded: &[(&str, ModelMemory)]) -> Option<String> {
    let (limit, free) = free()?;
    let (holder, most) = loaded.iter().max_by_key(|(_, memory)| memory.held)?;
    let runs = loaded.iter().map(|(_, memory)| memory).chain([&asked]);
    let run = runs.map(|it| it.peak.saturating_sub(it.held)).max()?.max(limit / RUN_PART);
    if asked.peak == 0 || free >= asked.held.saturating_add(run) {
        return None;
    }
    let [limit, taken, most, asked, run] =
        [limit, limit.saturating_sub(free), most.held, asked.held, run].map(|it| it >> 20);
    Some(format!(
        "gleaner-inference may take {limit} MiB; {taken} MiB are taken, {most} MiB of them by \
         `{holder}`; this model takes {asked} MiB, and {run} MiB are left to runs: raise `memory` \
         in [inference] of the vehicle, or stop a lambda with models"
    ))
}
