//! Signed data as a vehicle meets it: published, changed, forged, rolled back, expired.

mod hostile;
mod publish;
mod vehicle;

use std::collections::BTreeMap;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ed25519_dalek::{Signer, SigningKey};
use gleaner_lambda::manifest::LambdaKind;
use gleaner_trust::{
    Deployment, Floors, Grants, Labels, PublicKey, Revision, RevisionFile, RootKeys, ScopedKey,
    SecretKey, TrustRoot, Verifier, seal,
};

const REVISION: &str = "application/vnd.gleaner.revision.v1+json";
const DEPLOYMENT: &str = "application/vnd.gleaner.deployment.v1+json";

/// The time at which everything is signed, in seconds since 1970, and a day.
const SIGNED: u64 = 1_800_000_000;
const DAY: u64 = 86_400;

const ROOT: u8 = 1;
const PUBLISHER: u8 = 2;
const DEPLOYER: u8 = 3;

fn key(seed: u8) -> SecretKey {
    SecretKey::from_bytes(&[seed; 32])
}

fn scoped(seed: u8, lambdas: &str, labels: &[(&str, &str)]) -> ScopedKey {
    let lambdas = vec![lambdas.parse().unwrap()];
    ScopedKey { key: key(seed).public(), lambdas, labels: labelled(labels) }
}

fn labelled(labels: &[(&str, &str)]) -> Labels {
    labels.iter().map(|(name, value)| (name.parse().unwrap(), (*value).to_owned())).collect()
}

fn root() -> TrustRoot {
    TrustRoot {
        version: 1,
        created: SIGNED,
        expires: SIGNED + 365 * DAY,
        root: RootKeys { threshold: 1, keys: vec![key(ROOT).public()] },
        publishers: vec![scoped(PUBLISHER, "brake-*", &[])],
        deployers: vec![scoped(DEPLOYER, "*", &[])],
    }
}

fn revision(release: u64) -> Revision {
    Revision {
        name: "brake-dark".parse().unwrap(),
        version: "0.1.0".parse().unwrap(),
        kind: LambdaKind::Python,
        release,
        created: SIGNED,
        files: vec![RevisionFile {
            path: "models/größe-駅.onnx".parse().unwrap(),
            bytes: 3,
            sha256: "0".repeat(64).parse().unwrap(),
        }],
    }
}

fn deployment(release: u64, revision: &[u8]) -> Deployment {
    let (root, floors, labels) = (root(), Floors::default(), Labels::new());
    let verifier =
        Verifier { root: &root, floors: &floors, labels: &labels, now: SIGNED, known: &[] };
    Deployment {
        id: "front".parse().unwrap(),
        release,
        selector: Labels::new(),
        revision: verifier.revision(revision).unwrap().digest().clone(),
        fallback: None,
        config: BTreeMap::new(),
        grants: Grants::default(),
        created: SIGNED,
        expires: SIGNED + 30 * DAY,
    }
}

fn signed_revision(release: u64) -> Vec<u8> {
    seal(&revision(release), &[&key(PUBLISHER)]).unwrap()
}

/// An envelope made without the library, with any payload.
fn forged(payload_type: &str, payload: &[u8], seed: u8) -> Vec<u8> {
    let mut message =
        format!("DSSEv1 {} {payload_type} {} ", payload_type.len(), payload.len()).into_bytes();
    message.extend(payload);
    let signature = SigningKey::from_bytes(&[seed; 32]).sign(&message).to_bytes();
    let (payload, sig) = (STANDARD.encode(payload), STANDARD.encode(signature));
    let keyid = key(seed).public().id();
    format!(
        r#"{{"payloadType":"{payload_type}","payload":"{payload}","signatures":[{{"keyid":"{keyid}","sig":"{sig}"}}]}}"#
    )
    .into_bytes()
}

/// Calls `check` with a vehicle that trusts [`root`] and has accepted nothing.
fn on_vehicle<T>(check: impl FnOnce(&Verifier<'_>) -> T) -> T {
    let (root, floors, labels) = (root(), Floors::default(), Labels::new());
    check(&Verifier { root: &root, floors: &floors, labels: &labels, now: SIGNED, known: &[] })
}

#[test]
fn an_envelope_is_the_one_that_the_specification_describes() {
    let revision = revision(7);
    let payload = serde_json::to_vec(&revision).unwrap();
    assert_eq!(signed_revision(7), forged(REVISION, &payload, PUBLISHER));
    let verified = on_vehicle(|vehicle| vehicle.revision(&signed_revision(7))).unwrap();
    assert_eq!(*verified.payload(), revision);
    assert_eq!(verified.signers().collect::<Vec<_>>(), [&key(PUBLISHER).public().id()]);
}

#[test]
fn a_public_key_reads_back_from_its_text() {
    let public = key(9).public();
    assert_eq!(public.to_string().parse::<PublicKey>(), Ok(public));
}
