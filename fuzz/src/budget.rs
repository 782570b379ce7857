//! Memory budget of a parser. Every allocation of the fuzz programs is counted. An allocation
//! beyond the budget fails and ends the program, so that even a short peak is a finding.

use std::alloc::System;
use std::panic;
use std::sync::Once;

use cap::Cap;

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

/// Calls `read` and returns its result. Allocations may exceed those at the start by `bytes`, at
/// any time, counted over all threads.
pub fn within<T>(bytes: usize, read: impl FnOnce() -> T) -> T {
    static HOOK: Once = Once::new();
    HOOK.call_once(lift_limit_on_panic);
    limit(ALLOCATOR.allocated().saturating_add(bytes));
    let value = read();
    limit(usize::MAX);
    value
}

/// Lifts the limit in a panic: printing the message allocates, and would deadlock at the limit.
fn lift_limit_on_panic() {
    let hook = panic::take_hook();
    panic::set_hook(Box::new(move |info| {
        limit(usize::MAX);
        hook(info);
    }));
}

fn limit(bytes: usize) {
    ALLOCATOR.set_limit(bytes).expect("the limit is above the current allocation");
}
