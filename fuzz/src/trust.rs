//! Fuzzes signed data: envelopes, the payloads in them, and signed clips.
//!
//! An input is a byte for the mode, then data that depends on the mode. Signatures would stop a
//! fuzzer early, so most modes sign the payload.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ed25519_dalek::{Signer, SigningKey};
use gleaner_trust::{
    Deployment, Floors, Labels, Payload, Refusal, Revision, RootKeys, ScopedKey, SecretKey,
    TrustRoot, TrustedVehicles, Verifier, first_root, next_root, seal, verify_clip,
};

use crate::budget;
use crate::input::FuzzInput;

pub mod mode {
    /// An envelope follows.
    pub const ENVELOPE: u8 = 0;
    /// A revision follows.
    pub const REVISION: u8 = 1;
    /// A deployment follows.
    pub const DEPLOYMENT: u8 = 2;
    /// A trust root follows.
    pub const ROOT: u8 = 3;
    /// Floors follow.
    pub const FLOORS: u8 = 4;
    /// A clip follows.
    pub const CLIP: u8 = 5;
}

/// The key that signs everything.
pub(crate) const KEY: [u8; 32] = [7; 32];

/// The vehicle whose clips are accepted.
pub(crate) const VEHICLE: &str = "car-7";

/// Memory budget: the largest envelope of a clip, its payload, and what is read at once.
const CLIP_MEMORY: usize = 32 << 20;
/// Memory budget: an envelope of 5 KiB, its payload, and what is parsed from it.
const MEMORY: usize = 4 << 20;

/// Longest message of a refusal: a few texts that are cut to 80 characters, or names and digests.
const MESSAGE_MAX: usize = 4 << 10;

/// Verifies the input. What is accepted is sealed and verified again.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    let (mode, bytes) = (input.u8(), input.0);
    match mode {
        mode::REVISION => again(bytes, revision),
        mode::DEPLOYMENT => again(bytes, deployment),
        mode::ROOT => again(bytes, |envelope| first_root(envelope, &Floors::default())),
        mode::FLOORS => {
            let Ok(floors) = accepted(|| Floors::parse(bytes)) else { return false };
            assert_eq!(Floors::parse(&floors.to_json()).as_ref(), Ok(&floors));
            true
        }
        mode::CLIP => clip(bytes),
        _ => {
            let results = [
                accepted(|| revision(bytes)).is_ok(),
                accepted(|| deployment(bytes)).is_ok(),
                accepted(|| first_root(bytes, &Floors::default())).is_ok(),
                accepted(|| next_root(&root(), bytes)).is_ok(),
            ];
            results.contains(&true)
        }
    }
}

/// Verifies a clip. Of one that is accepted, no byte may be changed.
fn clip(bytes: &[u8]) -> bool {
    let text = format!("{VEHICLE} {}", SecretKey::from_bytes(&KEY).public());
    let vehicles = TrustedVehicles::parse(text.as_bytes()).expect("a name and a key");
    let verified = budget::within(CLIP_MEMORY, || verify_clip(bytes, &vehicles));
    if let Err(refusal) = verified {
        let text = refusal.to_string();
        assert!(text.len() <= MESSAGE_MAX, "a message of {} bytes", text.len());
        return false;
    }
    for at in 0..bytes.len() {
        let mut changed = bytes.to_vec();
        changed[at] ^= 1 << (at % 8);
        assert!(verify_clip(&changed[..], &vehicles).is_err(), "byte {at} was changed");
    }
    true
}

fn again<P>(payload: &[u8], verify: impl Fn(&[u8]) -> Result<P, Refusal>) -> bool
where
    P: Payload + PartialEq + std::fmt::Debug,
{
    let envelope = signed(P::TYPE, payload);
    let Ok(first) = accepted(|| verify(&envelope)) else { return false };
    let sealed = seal(&first, &[&SecretKey::from_bytes(&KEY)]).expect("it was accepted");
    assert_eq!(verify(&sealed).as_ref(), Ok(&first), "sealed again");
    true
}

/// Calls `verify` within the memory budget, and checks the message of a refusal.
fn accepted<T>(verify: impl FnOnce() -> Result<T, Refusal>) -> Result<T, ()> {
    budget::within(MEMORY, verify).map_err(|refusal| {
        let text = refusal.to_string();
        assert!(text.len() <= MESSAGE_MAX, "a message of {} bytes", text.len());
    })
}

fn revision(envelope: &[u8]) -> Result<Revision, Refusal> {
    on_vehicle(|vehicle| vehicle.revision(envelope).map(|it| it.payload().clone()))
}

fn deployment(envelope: &[u8]) -> Result<Deployment, Refusal> {
    on_vehicle(|vehicle| vehicle.deployment(envelope).map(|it| it.payload().clone()))
}

fn on_vehicle<T>(verify: impl FnOnce(&Verifier<'_>) -> T) -> T {
    let (root, floors, labels) = (root(), Floors::default(), Labels::new());
    verify(&Verifier { root: &root, floors: &floors, labels: &labels, now: 0, known: &[] })
}

/// A root with [`KEY`] for all purposes.
pub(crate) fn root() -> TrustRoot {
    let key = SecretKey::from_bytes(&KEY).public();
    let lambdas = vec!["*".parse().expect("a pattern")];
    let scoped = vec![ScopedKey { key: key.clone(), lambdas, labels: Labels::new() }];
    TrustRoot {
        version: 1,
        created: 0,
        expires: 1,
        root: RootKeys { threshold: 1, keys: vec![key] },
        publishers: scoped.clone(),
        deployers: scoped,
    }
}

pub(crate) fn signed(payload_type: &str, payload: &[u8]) -> Vec<u8> {
    let mut message =
        format!("DSSEv1 {} {payload_type} {} ", payload_type.len(), payload.len()).into_bytes();
    message.extend(payload);
    let sig = STANDARD.encode(SigningKey::from_bytes(&KEY).sign(&message).to_bytes());
    let (payload, keyid) = (STANDARD.encode(payload), SecretKey::from_bytes(&KEY).public().id());
    format!(
        r#"{{"payloadType":"{payload_type}","payload":"{payload}","signatures":[{{"keyid":"{keyid}","sig":"{sig}"}}]}}"#
    )
    .into_bytes()
}
