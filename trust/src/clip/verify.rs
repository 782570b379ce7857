//! Verifies the signature of a clip, which is untrusted and may have any length.

use std::io::{self, Read};

use gleaner_base::{Exit, Explain};
use gleaner_lambda::manifest::Sha256;

use super::sign::{ATTACHMENT, CRC, DATA_END, HEAD, MEDIA_TYPE, TIMES, data_end};
use super::{ClipStatement, ContentDigest, SIGNATURE, TrustedVehicles, VehicleName};
use crate::envelope::Unverified;
use crate::{Payload, Refusal};

/// The bytes with which an MCAP file begins.
const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Bytes that are read at once.
const PIECE: usize = 256 << 10;

/// A clip whose signature is that of a trusted vehicle, over exactly these bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignedClip {
    pub statement: ClipStatement,
    /// Id of the key that signed it.
    pub key: Sha256,
}

/// Verifies that one of `vehicles` signed exactly the bytes of `clip`, which is read once.
///
/// # Errors
///
/// [`ClipRefusal`].
pub fn verify_clip(clip: impl Read, vehicles: &TrustedVehicles) -> Result<SignedClip, ClipRefusal> {
    let mut reader = ClipReader { clip, content: ContentDigest::default(), piece: Vec::new() };
    let attachment = reader.signature()?;
    let envelope = Unverified::<ClipStatement>::parse(&attachment.envelope)?;
    let key = envelope.signers(vehicles.keys())?.into_iter().next();
    let statement = envelope.payload()?;
    // Each meaning has one form: a signature of another key is not skipped here.
    let key = key.filter(|_| envelope.to_bytes() == attachment.envelope && envelope.is_single());
    let key = key.ok_or(ClipRefusal::Form("its envelope has not the form of a recorder"))?;
    if !vehicles.named(key.as_str()).any(|name| *name == statement.vehicle) {
        let listed = vehicles.named(key.as_str()).map(VehicleName::to_string);
        let listed = listed.collect::<Vec<_>>().join("`, `");
        return Err(ClipRefusal::Vehicle { key, stated: statement.vehicle, listed });
    }
    let found = reader.rest()?;
    if found != statement.sha256 {
        return Err(ClipRefusal::Content { signed: statement.sha256, found });
    }
    match attachment.wrong_checksum {
        Some(what) => Err(ClipRefusal::Checksum(what)),
        None => Ok(SignedClip { statement, key }),
    }
}

struct SignatureAttachment {
    envelope: Vec<u8>,
    wrong_checksum: Option<&'static str>,
}

struct ClipReader<R> {
    clip: R,
    content: ContentDigest,
    piece: Vec<u8>,
}

impl<R: Read> ClipReader<R> {
    /// Reads up to the end of the data, before which the signature is.
    fn signature(&mut self) -> Result<SignatureAttachment, ClipRefusal> {
        if self.covered(MAGIC.len())? != MAGIC {
            return Err(ClipRefusal::NotMcap);
        }
        loop {
            let (kind, length) = self.head()?;
            let mut left = length;
            if kind == DATA_END {
                return Err(ClipRefusal::Unsigned);
            }
            if kind == ATTACHMENT && length >= (TIMES + SIGNATURE.len()) as u64 {
                let times = self.covered(TIMES)?;
                let name = u32::from_le_bytes(times[TIMES - 4..].try_into().expect("4 bytes"));
                left -= TIMES as u64;
                if name as usize == SIGNATURE.len() {
                    let start = times.to_vec();
                    let name = self.covered(SIGNATURE.len())?;
                    left -= SIGNATURE.len() as u64;
                    if name == SIGNATURE.as_bytes() {
                        return self.attachment(start, left);
                    }
                }
            }
            self.skip(left)?;
        }
    }

    /// Reads the rest of the attachment, which has `length` bytes, and the end of the data. The
    /// attachment begins with `start`, before its name.
    fn attachment(
        &mut self,
        mut start: Vec<u8>,
        length: u64,
    ) -> Result<SignatureAttachment, ClipRefusal> {
        let before = 4 + MEDIA_TYPE.len() + 8;
        let form = ClipRefusal::Form("its attachment has not the form of a recorder");
        let Some(data) = length.checked_sub((before + CRC) as u64) else { return Err(form) };
        if data > ClipStatement::MAX.bytes() {
            let (what, bytes, most) = (ClipStatement::NAME, data, ClipStatement::MAX);
            return Err(Refusal::TooLarge { what, bytes, most }.into());
        }
        let kind = self.covered(before)?;
        let expected = [
            &(MEDIA_TYPE.len() as u32).to_le_bytes()[..],
            MEDIA_TYPE.as_bytes(),
            &data.to_le_bytes(),
        ];
        if kind != expected.concat() {
            return Err(form);
        }
        start.extend([SIGNATURE.as_bytes(), kind].concat());
        let envelope = self.dependent(data as usize)?.to_vec();
        let crc = self.crc()?;
        start.extend(&envelope);
        let mut wrong_checksum = (crc != crc32fast::hash(&start)).then_some("the signature");
        let all = self.content.crc();
        if self.covered(HEAD)? != data_end() {
            return Err(ClipRefusal::Form("it is not the last record before the summary"));
        }
        if self.crc()? != all {
            wrong_checksum.get_or_insert("the data");
        }
        Ok(SignatureAttachment { envelope, wrong_checksum })
    }

    /// Reads the head of a record: its kind and its length.
    fn head(&mut self) -> Result<(u8, u64), ClipRefusal> {
        let head = self.covered(HEAD)?;
        Ok((head[0], u64::from_le_bytes(head[1..].try_into().expect("8 bytes"))))
    }

    fn crc(&mut self) -> Result<u32, ClipRefusal> {
        let crc = self.dependent(CRC)?;
        Ok(u32::from_le_bytes(crc.try_into().expect("4 bytes")))
    }

    /// Reads some bytes that the signature covers.
    fn covered(&mut self, length: usize) -> Result<&[u8], ClipRefusal> {
        self.read(length)?;
        self.content.update(&self.piece);
        Ok(&self.piece)
    }

    /// Reads some bytes that depend on the signature.
    fn dependent(&mut self, length: usize) -> Result<&[u8], ClipRefusal> {
        self.read(length)?;
        self.content.skip(&self.piece);
        Ok(&self.piece)
    }

    fn read(&mut self, length: usize) -> Result<(), ClipRefusal> {
        self.piece.resize(length, 0);
        self.clip.read_exact(&mut self.piece).map_err(|source| match source.kind() {
            io::ErrorKind::UnexpectedEof => ClipRefusal::Truncated,
            _ => ClipRefusal::Read { source },
        })
    }

    /// Reads many bytes that the signature covers.
    fn skip(&mut self, mut length: u64) -> Result<(), ClipRefusal> {
        while length > 0 {
            let piece = length.min(PIECE as u64);
            self.covered(piece as usize)?;
            length -= piece;
        }
        Ok(())
    }

    /// Reads up to the end of the file; returns the digest.
    fn rest(mut self) -> Result<Sha256, ClipRefusal> {
        self.piece.resize(PIECE, 0);
        loop {
            match self.clip.read(&mut self.piece) {
                Ok(0) => return Ok(self.content.sha256()),
                Ok(read) => self.content.update(&self.piece[..read]),
                Err(source) if source.kind() == io::ErrorKind::Interrupted => {}
                Err(source) => return Err(ClipRefusal::Read { source }),
            }
        }
    }
}

/// The reason why a clip is not accepted as that of a trusted vehicle.
#[derive(Debug, thiserror::Error)]
pub enum ClipRefusal {
    #[error("it cannot be read")]
    Read { source: io::Error },
    #[error("it is not an MCAP file")]
    NotMcap,
    #[error("it is truncated")]
    Truncated,
    #[error("it is not signed")]
    Unsigned,
    #[error("its signature is malformed: {0}")]
    Form(&'static str),
    #[error(transparent)]
    Statement(#[from] Refusal),
    #[error("key {key} is that of `{listed}`, and the clip names vehicle `{stated}`")]
    Vehicle { key: Sha256, stated: VehicleName, listed: String },
    #[error("its content has the digest {found}; {signed} is signed")]
    Content { signed: Sha256, found: Sha256 },
    #[error("the checksum of {0} in it is wrong")]
    Checksum(&'static str),
}

impl Explain for ClipRefusal {
    fn help(&self) -> Option<String> {
        let help = match self {
            Self::Read { .. } | Self::NotMcap => "name a clip that you can read",
            Self::Unsigned => {
                "record with `gleaner run --sign KEY`, or verify without --trust; a clip that was \
                 signed has been changed"
            }
            Self::Statement(Refusal::UnknownKey { .. }) => {
                "if the vehicle is yours, add its line to the list: NAME PUBLICKEY, as `gleaner \
                 keys show KEY` prints the key"
            }
            Self::Vehicle { .. } => {
                "if both names are of one vehicle, add a line with this name and the key"
            }
            _ => "the clip was changed after it was signed: copy it from the vehicle again",
        };
        Some(help.to_owned())
    }

    fn exit(&self) -> Exit {
        match self {
            Self::Read { .. } | Self::NotMcap => Exit::Usage,
            _ => Exit::Denied,
        }
    }
}
