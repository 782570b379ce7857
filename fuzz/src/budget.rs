//! Memory that a reading may take. Every allocation of these programs is counted; one beyond the
//! budget fails, which ends the program, and so is a finding, however short the memory would have
//! been used.

use std::alloc::System;
use std::panic;
use std::sync::Once;

use cap::Cap;

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

/// What `read` returns. It may hold `bytes` more than before, at any time.
///
/// Where several threads allocate, it is all of them together.
pub fn within<T>(bytes: usize, read: impl FnOnce() -> T) -> T {
    static TELLS: Once = Once::new();
    TELLS.call_once(no_limit_for_panics);
    limit(ALLOCATOR.allocated().saturating_add(bytes));
    let value = read();
    limit(usize::MAX);
    value
}

/// Saying where a panic comes from takes memory, too; without it the program would wait for itself
/// instead.
fn no_limit_for_panics() {
    let tell = panic::take_hook();
    panic::set_hook(Box::new(move |what| {
        limit(usize::MAX);
        tell(what);
    }));
}

fn limit(bytes: usize) {
    ALLOCATOR.set_limit(bytes).expect("a limit is set above what is allocated");
}
