//! Counts the memory that Rust code allocates in the interpreter, because the rest is the lambda's.
//! Rust aborts the process when an allocation fails; the shim can then report the reason.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};

use gleaner_protocol::process_stats::{Heartbeat, own};

struct CountingAllocator;

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

// SAFETY: every call is passed to the system's allocator with the same arguments, and its result is
// returned; counting allocates nothing.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller has kept the contract of `System`, which is the same.
        counted(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as above.
        counted(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, bytes: usize) -> *mut u8 {
        // SAFETY: as above.
        let moved = counted(unsafe { System.realloc(pointer, layout, bytes) }, bytes);
        if !moved.is_null() {
            own::freed(layout.size());
        }
        moved
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) };
        own::freed(layout.size());
    }
}

/// Counts `memory`, or reports to the shim that none is left; returns `memory`.
fn counted(memory: *mut u8, bytes: usize) -> *mut u8 {
    if memory.is_null() {
        Heartbeat::report_refused_memory();
    } else {
        own::allocated(bytes);
    }
    memory
}
