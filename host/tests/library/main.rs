//! What the host's library does with guests and inputs that a test feeds by hand, as one program:
//! each file is a subject. Tests that start programs lie in the workspace's `tests/`.

mod alone;
mod calls;
mod faults;
mod greedy;
mod guest_room;
mod host_calls;
mod host_time;
mod limits;
mod live;
mod schedule;
mod tight;
