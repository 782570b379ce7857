//! Clips that their vehicle signs.
//!
//! The signature of a clip is an attachment of its MCAP file, the last record of the data section:
//! an envelope with a [`ClipStatement`], which has the SHA-256 of the file.
//!
//! ```text
//! magic, header, chunks, metadata, attachments    digest
//! attachment: head, times, name, type, length     digest
//!             envelope                            equals its own canonical form
//!             checksum                            computed again
//! end of data: head                               digest
//!              checksum of all above              computed again
//! summary, footer, magic                          digest
//! ```
//!
//! `digest` means that the SHA-256 covers these bytes. The three others depend on the signature,
//! and each has exactly one valid value. So no byte of a clip can be changed, added or removed.
//!
//! - `statement`: the signed data.
//! - `sign`: completes the end of a file, by the vehicle.
//! - `verify`: reads a file of any length once, in a bounded part of memory.
//! - `vehicles`: the vehicles that a reader trusts, with their keys.

mod sign;
mod statement;
mod vehicles;
mod verify;

pub use sign::{ClipSigner, ContentDigest, MEDIA_TYPE, SIGNATURE};
pub use statement::{ClipLosses, ClipStatement, SignedFile, SignedLambda};
pub use vehicles::{TrustedVehicles, VehicleName, VehiclesError};
pub use verify::{ClipRefusal, SignedClip, verify_clip};
