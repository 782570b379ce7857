//! Memory of our part of an interpreter: it is counted, since the rest is the lambda's. Rust ends a
//! process to which it is refused; then the shim can say why.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};

use gleaner_vitals::{Pulse, own};

struct Counted;

#[global_allocator]
static ALLOCATOR: Counted = Counted;

// SAFETY: all is left to the system's allocator, with the same arguments, and what it gives is
// given on; counting takes no memory.
unsafe impl GlobalAlloc for Counted {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: whoever called us has kept what `System` asks for, which is the same.
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

/// `memory`, after it was counted, or the shim was told that there is none.
fn counted(memory: *mut u8, bytes: usize) -> *mut u8 {
    if memory.is_null() {
        Pulse::say_full();
    } else {
        own::allocated(bytes);
    }
    memory
}
