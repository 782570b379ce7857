//! Memory of our part of an interpreter. Rust ends a process to which it is refused; then the shim can say why.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};

use gleaner_vitals::Pulse;

struct Told;

#[global_allocator]
static ALLOCATOR: Told = Told;

// SAFETY: all is left to the system's allocator, with the same arguments, and what it gives is given on.
unsafe impl GlobalAlloc for Told {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: whoever called us has kept what `System` asks for, which is the same.
        told(unsafe { System.alloc(layout) })
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: as above.
        told(unsafe { System.alloc_zeroed(layout) })
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, bytes: usize) -> *mut u8 {
        // SAFETY: as above.
        told(unsafe { System.realloc(pointer, layout, bytes) })
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

fn told(memory: *mut u8) -> *mut u8 {
    if memory.is_null() {
        Pulse::say_full();
    }
    memory
}
