//! Tests pools, rings and topics in shared memory through the public interface, without loom.
#![cfg(not(loom))]

mod cases;
mod pool;
mod ring;
mod shared;
mod shared_ring;
mod stress;
