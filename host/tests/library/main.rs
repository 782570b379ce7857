//! Tests of the host's library with guests and inputs that a test feeds directly, as one program
//! with a file for each subject. Tests that start programs are in the workspace's `tests/`.

mod calls;
mod faults;
mod fed_inputs;
mod greedy;
mod host_calls;
mod host_time;
mod limits;
mod live;
mod live_clips;
mod live_layouts;
mod misbehaving;
mod own_process;
mod recorded_run;
mod schedule;
mod small_limits;
mod unrecorded;

use gleaner_messages::transport::{Guid, SampleMeta};

/// Returns the metadata of a little-endian sample, which was published when it was received.
fn meta(at_ns: i64, seq: u64) -> SampleMeta {
    SampleMeta::new(at_ns, Guid::default(), seq)
}
