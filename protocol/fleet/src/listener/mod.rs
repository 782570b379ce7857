//! Accepts connections for HTTP, with TLS or without, from a network or a socket of this machine.
//!
//! An untrusted peer is bounded before anything is known of it: in connections, in bytes, in time,
//! and in turns for handshakes. `accept` serves connections, `clients` has the open ones by their
//! networks and ends some at a bound, and `turns` shares work between networks. What is asked and
//! answered is up to the router.

mod accept;
mod bounds;
mod clients;
mod network;
mod turns;

pub use accept::{BoundedListener, PeerConnection};
pub use bounds::BoundCounts;
pub use network::ClientNetwork;
pub use turns::FairTurns;
