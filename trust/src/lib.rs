//! Signed revisions, deployments and trust roots, from the author's key to the checks on a vehicle.
//!
//! `keys` has ed25519 keys and their files, `envelope` signs payloads and opens signed ones,
//! `payload` has their types and bounds, and `files` compares a build folder with its revision.
//! `verify` decides what a vehicle accepts, by a trust root, a time and the `floors` below which
//! nothing is accepted again. `publish` signs the build of a lambda. `clip` signs the clips of a
//! vehicle, and verifies them.
//!
//! Nothing here reads a clock, starts a program or reaches a network. What is verified is a byte
//! string, or read once from its start to its end; only `keys`, `files`, `publish` and the list of
//! vehicles of `clip` open files.

mod bounded;
mod clip;
mod digest;
mod envelope;
mod files;
mod floors;
mod keys;
mod payload;
mod publish;
mod refusal;
mod verify;

pub use clip::{
    ClipLosses, ClipRefusal, ClipSigner, ClipStatement, ContentDigest, MEDIA_TYPE, SIGNATURE,
    SignedClip, SignedFile, SignedLambda, TrustedVehicles, VehicleName, VehiclesError, verify_clip,
};
pub use digest::sha256;
pub use envelope::{Payload, seal};
pub use files::{FileDigestError, check_files};
pub use floors::{Accepted, Floors};
pub use keys::{KeyError, PublicKey, SecretKey};
pub use payload::{
    COUNTER_MAX, Deployment, Grants, Labels, LambdaPattern, Revision, RevisionFile, RootKeys,
    ScopedKey, TrustRoot,
};
pub use publish::{Published, Release, ReleaseError, publish};
pub use refusal::Refusal;
pub use verify::{
    Trusted, Verdict, Verifier, deployment_of_keys, first_root, next_root, revision_of_digest,
    unverified_deployment, unverified_revision,
};
