//! DSSE envelopes: a payload, its type, and signatures over both.
//!
//! The signatures cover the exact bytes of the payload, which is never serialised again. It is
//! parsed only after a signature was checked, or to find the keys of a first trust root.
//!
//! Source: DSSE v1.0.2, <https://github.com/secure-systems-lab/dsse>.

use std::collections::BTreeSet;
use std::marker::PhantomData;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use gleaner_base::{ByteSize, excerpt};
use gleaner_lambda::manifest::Sha256;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::digest::sha256;
use crate::keys::{PublicKey, SecretKey};
use crate::{Refusal, bounded};

pub(crate) const SIGNATURES_MAX: usize = 16;

/// A type of signed data.
pub trait Payload: Serialize + DeserializeOwned {
    /// Its name in messages.
    const NAME: &'static str;
    /// Its type in envelopes, with the version of its format.
    const TYPE: &'static str;
    /// Maximum length of an envelope with it.
    const MAX: ByteSize;

    /// Checks the relations between its values, which a parser of single values cannot.
    ///
    /// # Errors
    ///
    /// The reason.
    fn check(&self) -> Result<(), String>;
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DsseEnvelope<'a> {
    #[serde(rename = "payloadType")]
    payload_type: &'a str,
    payload: &'a str,
    #[serde(borrow, deserialize_with = "bounded::list::<_, _, SIGNATURES_MAX>")]
    signatures: Vec<DsseSignature<'a>>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DsseSignature<'a> {
    keyid: &'a str,
    sig: &'a str,
}

/// Signs `payload` with `keys`. The envelope has no line end: each of its bytes counts.
///
/// # Errors
///
/// [`Refusal::Malformed`] or [`Refusal::TooLarge`] if a vehicle would refuse the result.
pub fn seal<P: Payload>(payload: &P, keys: &[&SecretKey]) -> Result<Vec<u8>, Refusal> {
    payload.check().map_err(|reason| Refusal::Malformed { what: P::NAME, reason })?;
    let bytes = serde_json::to_vec(payload).map_err(|error| malformed::<P>(&error))?;
    let message = pae(P::TYPE, &bytes);
    let signatures = keys.iter().map(|key| (key.public().id().to_string(), key.sign(&message)));
    let envelope = encode::<P>(&bytes, &signatures.collect::<Vec<_>>());
    // Everything else that a vehicle bounds, such as the number of items.
    Unverified::<P>::parse(&envelope)?.payload()?;
    Ok(envelope)
}

/// Returns the envelope of a payload with these signatures, each after the id of its key.
fn encode<P: Payload>(payload: &[u8], signatures: &[(String, [u8; 64])]) -> Vec<u8> {
    let encoded = signatures.iter().map(|(keyid, sig)| (keyid, STANDARD.encode(sig)));
    let encoded = encoded.collect::<Vec<_>>();
    let signatures = encoded.iter().map(|(keyid, sig)| DsseSignature { keyid, sig });
    let envelope = DsseEnvelope {
        payload_type: P::TYPE,
        payload: &STANDARD.encode(payload),
        signatures: signatures.collect(),
    };
    serde_json::to_vec(&envelope).expect("texts are valid JSON")
}

/// An envelope whose signatures were not checked.
pub(crate) struct Unverified<P> {
    payload: Vec<u8>,
    signatures: Vec<(String, [u8; 64])>,
    kind: PhantomData<P>,
}

impl<P: Payload> Unverified<P> {
    pub(crate) fn parse(bytes: &[u8]) -> Result<Self, Refusal> {
        let length = bytes.len() as u64;
        if length > P::MAX.bytes() {
            return Err(Refusal::TooLarge { what: P::NAME, bytes: length, most: P::MAX });
        }
        let envelope: DsseEnvelope<'_> =
            serde_json::from_slice(bytes).map_err(|error| malformed::<P>(&error))?;
        if envelope.payload_type != P::TYPE {
            let found = excerpt(envelope.payload_type);
            return Err(Refusal::WrongType { expected: P::TYPE, found });
        }
        let payload = STANDARD.decode(envelope.payload).map_err(|error| malformed::<P>(&error))?;
        let mut seen = BTreeSet::new();
        let mut signatures = Vec::with_capacity(envelope.signatures.len());
        for DsseSignature { keyid, sig } in envelope.signatures {
            let mut bytes = [0; 64];
            let length = STANDARD
                .decode_slice(sig, &mut bytes)
                .map_err(|_| malformed::<P>(&"a signature is not the base64 text of 64 bytes"))?;
            // Counted once, a key cannot reach a threshold alone.
            if length != bytes.len() || !seen.insert(keyid) {
                return Err(malformed::<P>(&"a signature is too short, or of a key that has two"));
            }
            signatures.push((keyid.to_owned(), bytes));
        }
        Ok(Self { payload, signatures, kind: PhantomData })
    }

    /// Returns the keys of `trusted` that signed. Signatures of other keys are skipped, so that an
    /// envelope can have those of an old and a new key.
    ///
    /// # Errors
    ///
    /// [`Refusal::WrongSignature`] if one of a trusted key is wrong, [`Refusal::UnknownKey`] if
    /// there is none of a trusted key.
    pub(crate) fn signers<'k>(
        &self,
        trusted: impl IntoIterator<Item = &'k PublicKey>,
    ) -> Result<BTreeSet<Sha256>, Refusal> {
        let message = pae(P::TYPE, &self.payload);
        let (mut signers, mut count) = (BTreeSet::new(), 0);
        for key in trusted {
            count += 1;
            let id = key.id();
            let Some((_, sig)) = self.signatures.iter().find(|(named, _)| id == **named) else {
                continue;
            };
            if !key.verifies(&message, sig) {
                return Err(Refusal::WrongSignature { what: P::NAME, key: id });
            }
            signers.insert(id);
        }
        if signers.is_empty() {
            let found = self.signatures.iter().map(|(id, _)| excerpt(id)).collect::<Vec<_>>();
            return Err(Refusal::UnknownKey { what: P::NAME, found, trusted: count });
        }
        Ok(signers)
    }

    pub(crate) fn is_single(&self) -> bool {
        self.signatures.len() == 1
    }

    /// Returns the envelope as [`seal`] writes it: other bytes can have the same meaning.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        encode::<P>(&self.payload, &self.signatures)
    }

    pub(crate) fn payload(&self) -> Result<P, Refusal> {
        let payload: P =
            serde_json::from_slice(&self.payload).map_err(|error| malformed::<P>(&error))?;
        payload.check().map_err(|reason| Refusal::Malformed { what: P::NAME, reason })?;
        Ok(payload)
    }

    /// Returns the digest of the payload, by which other payloads name it: signatures may be added
    /// without changing it.
    pub(crate) fn digest(&self) -> Sha256 {
        sha256(&self.payload)
    }
}

/// Returns the signed message: the pre-authentication encoding of DSSE.
fn pae(payload_type: &str, payload: &[u8]) -> Vec<u8> {
    let (type_length, length) = (payload_type.len(), payload.len());
    let mut message = format!("DSSEv1 {type_length} {payload_type} {length} ").into_bytes();
    message.extend(payload);
    message
}

fn malformed<P: Payload>(reason: &dyn ToString) -> Refusal {
    Refusal::Malformed { what: P::NAME, reason: excerpt(&reason.to_string()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_signed_message_is_that_of_the_specification() {
        // The example of the specification's section "Pre-Authentication Encoding".
        let message = pae("http://example.com/HelloWorld", b"hello world");
        assert_eq!(message, b"DSSEv1 29 http://example.com/HelloWorld 11 hello world");
    }
}
