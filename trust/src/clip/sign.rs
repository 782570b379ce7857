//! Completes the file of a clip with its signature.

use std::ops::Range;

use sha2::Digest;

use super::{ClipStatement, VehicleName};
use crate::digest::digest_text;
use crate::keys::SecretKey;
use crate::{Payload, Refusal, seal};
use gleaner_lambda::manifest::Sha256;

/// Name of the attachment with the signature.
pub const SIGNATURE: &str = "gleaner/signature.json";
pub const MEDIA_TYPE: &str = "application/json";

pub(super) const ATTACHMENT: u8 = 0x09;
pub(super) const DATA_END: u8 = 0x0f;
/// Length of the opcode and the length of a record.
pub(super) const HEAD: usize = 9;
/// Length of two times and of the length of a name, with which an attachment begins.
pub(super) const TIMES: usize = 8 + 8 + 4;
/// Length of a checksum, CRC-32 as in zip.
pub(super) const CRC: usize = 4;
/// Length of the attachment before its data: head, times, name, media type, length of the data.
const BEFORE: usize = HEAD + TIMES + SIGNATURE.len() + 4 + MEDIA_TYPE.len() + 8;

/// The running SHA-256 of the bytes that a signature covers, and the checksum of all bytes.
#[derive(Clone, Default)]
pub struct ContentDigest {
    sha256: sha2::Sha256,
    crc: crc32fast::Hasher,
}

impl ContentDigest {
    /// Adds the next bytes of the file.
    pub fn update(&mut self, bytes: &[u8]) {
        self.sha256.update(bytes);
        self.crc.update(bytes);
    }

    /// Adds bytes that depend on the signature.
    pub(super) fn skip(&mut self, bytes: &[u8]) {
        self.crc.update(bytes);
    }

    pub(super) fn crc(&self) -> u32 {
        self.crc.clone().finalize()
    }

    /// Returns the SHA-256 of the bytes so far that are covered.
    pub(super) fn sha256(self) -> Sha256 {
        digest_text(&self.sha256.finalize())
    }
}

/// The key with which a vehicle signs its clips, and its name.
#[derive(Debug)]
pub struct ClipSigner {
    key: SecretKey,
    vehicle: VehicleName,
}

impl ClipSigner {
    pub fn new(key: SecretKey, vehicle: VehicleName) -> Self {
        Self { key, vehicle }
    }

    pub fn vehicle(&self) -> &VehicleName {
        &self.vehicle
    }

    /// Returns the length of the envelope of a statement, whatever its digest of the file: the
    /// attachment has it before the digest is known.
    ///
    /// # Errors
    ///
    /// [`Refusal`] if a reader would refuse the statement.
    pub fn length(&self, statement: &ClipStatement) -> Result<usize, Refusal> {
        seal(statement, &[&self.key]).map(|envelope| envelope.len())
    }

    /// Completes a file: `before` are its bytes up to the attachment [`SIGNATURE`], and `rest` are
    /// the others, with any bytes of the [`length`](Self::length) of the envelope in its place. The
    /// end of the data follows the attachment.
    ///
    /// # Errors
    ///
    /// [`Refusal`]; then `rest` is unchanged.
    pub fn complete(
        &self,
        before: &ContentDigest,
        rest: &mut [u8],
        mut statement: ClipStatement,
    ) -> Result<(), Refusal> {
        let malformed = || Refusal::Malformed {
            what: ClipStatement::NAME,
            reason: "the attachment for it is not the last record of the data".to_owned(),
        };
        let Some(RestPlaces { envelope, crc, end, end_crc }) = RestPlaces::of(rest) else {
            return Err(malformed());
        };
        let mut content = before.clone();
        for covered in [&rest[..envelope.start], &rest[end.clone()], &rest[end_crc.end..]] {
            content.update(covered);
        }
        statement.sha256 = content.sha256();
        let sealed = seal(&statement, &[&self.key])?;
        if sealed.len() != envelope.len() {
            return Err(malformed());
        }
        rest[envelope.clone()].copy_from_slice(&sealed);
        let checksum = crc32fast::hash(&rest[HEAD..envelope.end]);
        rest[crc.clone()].copy_from_slice(&checksum.to_le_bytes());
        let mut all = before.crc.clone();
        all.update(&rest[..crc.end]);
        rest[end_crc].copy_from_slice(&all.finalize().to_le_bytes());
        Ok(())
    }
}

struct RestPlaces {
    envelope: Range<usize>,
    /// Checksum of the attachment.
    crc: Range<usize>,
    /// Head of the end of the data.
    end: Range<usize>,
    /// Checksum in the end of the data.
    end_crc: Range<usize>,
}

impl RestPlaces {
    fn of(rest: &[u8]) -> Option<Self> {
        let length: [u8; 8] = rest.get(BEFORE - 8..BEFORE)?.try_into().ok()?;
        let length = usize::try_from(u64::from_le_bytes(length)).ok()?;
        let envelope = BEFORE..BEFORE.checked_add(length)?;
        let crc = envelope.end..envelope.end.checked_add(CRC)?;
        let end = crc.end..crc.end.checked_add(HEAD)?;
        let end_crc = end.end..end.end.checked_add(CRC)?;
        let is_attachment = rest.first() == Some(&ATTACHMENT);
        let is_named = rest.get(HEAD + TIMES..)?.starts_with(SIGNATURE.as_bytes());
        let is_last = rest.get(end.clone())? == data_end();
        let is_whole = rest.len() >= end_crc.end;
        (is_attachment && is_named && is_last && is_whole).then_some(Self {
            envelope,
            crc,
            end,
            end_crc,
        })
    }
}

pub(super) fn data_end() -> [u8; HEAD] {
    let mut head = [0; HEAD];
    (head[0], head[1]) = (DATA_END, CRC as u8);
    head
}
