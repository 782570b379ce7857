//! Reads the content of a file besides messages: metadata records and attachments.

use std::collections::BTreeMap;
use std::path::Path;

use tracing::warn;

use crate::damage::Damage;
use crate::error::ReplayError;
use crate::indexes::{INDEX_BYTES, Indexes};
use crate::records::{self, HEAD, MAGIC, Statistics, head, op};
use crate::source::SourceFile;
use crate::summary::footer;

/// Approximate size of a text, a pair or a list entry, besides its bytes. Without it, a file of
/// tiny entries would take many times its size.
const ENTRY_BYTES: u64 = 128;
/// Statistics with a count for each of the 65536 channels that a file can have are shorter.
const MAX_STATISTICS: u64 = 1 << 20;
/// Length limit of an attachment's name in an error.
const NAME_CHARS: usize = 100;

/// The content of a file besides messages.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Extras {
    /// The metadata records in the order of the file, each with its name. Names may repeat. They
    /// have no checksum.
    pub metadata: Vec<(String, BTreeMap<String, String>)>,
    /// The attachments in the order of the file. Names may repeat.
    pub attachments: Vec<Attachment>,
    /// Set if the file was finished and read to its end. Otherwise the rest is missing here.
    pub is_whole: bool,
    /// The first difference between its indexes and its records: a reader that relies on the index
    /// would see other content.
    pub misfit: Option<String>,
}

/// A file within a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attachment {
    /// Name of the attachment. It is not a safe path: check it before writing to a disk.
    pub name: String,
    /// Media type of the data, for example `image/jpeg`; empty if unknown.
    pub media_type: String,
    pub data: Vec<u8>,
}

/// Reads the metadata records and attachments of an MCAP file; chunks are skipped unread.
///
/// Names, texts and data may take `limit_bytes` in all, plus 128 bytes for each record and pair.
///
/// A file without a footer, which was truncated or is still being written, returns the content
/// before its end, or before the first damage: with a torn end, the two cases look alike.
/// Attachments without a checksum are not trusted there. A finished file returns everything or an
/// error.
///
/// # Errors
///
/// [`ReplayError`] if the file cannot be opened or read, is a directory or not an MCAP file.
/// [`ReplayError::Damaged`] if there is more than `limit_bytes`, or if a finished file is damaged:
/// a malformed record, an attachment with a wrong checksum (a writer may leave it out), fewer of
/// either than in the summary, or a data section that does not match its checksum.
///
/// Source: the MCAP specification, version 0.
pub fn read_extras(path: &Path, limit_bytes: u64) -> Result<Extras, ReplayError> {
    let mut source = SourceFile::open(path)?;
    if source.peek(0, MAGIC.len())? != MAGIC {
        return Err(ReplayError::NotMcap { path: path.to_owned() });
    }
    let footer_at = footer(&mut source)?.map(|footer| footer.at);
    let len = source.len();
    let mut reader = ExtrasReader {
        source,
        end: footer_at.unwrap_or(len),
        is_cut_off: footer_at.is_none(),
        allowed: limit_bytes,
        left: limit_bytes,
        extras: Extras::default(),
        indexes: Indexes::default(),
        claimed: None,
    };
    match reader.all() {
        Ok(()) => reader.extras.is_whole = !reader.is_cut_off,
        Err(error @ ReplayError::Damaged { what: Damage::ExtrasTooLarge { .. }, .. }) => {
            return Err(error);
        }
        Err(ReplayError::Damaged { at, what, .. }) if reader.is_cut_off => {
            warn!(
                path = %path.display(),
                %at,
                %what,
                "file is truncated; its further metadata and attachments are lost"
            );
        }
        Err(error) => return Err(error),
    }
    reader.extras.misfit = reader.indexes.misfit().filter(|_| reader.extras.is_whole);
    Ok(reader.extras)
}

struct ExtrasReader {
    source: SourceFile,
    /// Start of the footer, or end of a file without one.
    end: u64,
    is_cut_off: bool,
    allowed: u64,
    left: u64,
    extras: Extras,
    indexes: Indexes,
    /// Counts from the summary.
    claimed: Option<Statistics>,
}

impl ExtrasReader {
    fn all(&mut self) -> Result<(), ReplayError> {
        let mut at = MAGIC.len() as u64;
        while at != self.end {
            at = self.record(at)?;
        }
        let Some(claimed) = &self.claimed else {
            return Ok(());
        };
        for (what, expected, found) in [
            ("metadata records", claimed.metadata, self.extras.metadata.len()),
            ("attachments", claimed.attachments, self.extras.attachments.len()),
        ] {
            if (found as u64) < u64::from(expected) {
                return Err(self
                    .source
                    .damaged(self.end, Damage::MissingExtras { what, expected, found }));
            }
        }
        Ok(())
    }

    /// Checks everything before `end` against the checksum at that position: nothing else covers
    /// metadata and indexes.
    fn whole_until(&mut self, end: u64, expected: u32) -> Result<(), ReplayError> {
        let found = if expected == 0 { 0 } else { self.source.checksum(end)? };
        if found == expected {
            Ok(())
        } else {
            Err(self.source.damaged(end, Damage::DataCrc { expected, found }))
        }
    }

    /// Reads the record at `at`, and returns the position of the next one.
    fn record(&mut self, at: u64) -> Result<u64, ReplayError> {
        let Some((opcode, len)) = head(self.source.peek(at, HEAD as usize)?) else {
            return Err(self.source.damaged(at, Damage::Truncated("the head of a record")));
        };
        let next = at.saturating_add(HEAD).saturating_add(len);
        if next > self.end {
            return Err(self.source.damaged(at, Damage::Truncated("a record")));
        }
        let begins = match opcode {
            op::CHUNK_INDEX | op::ATTACHMENT_INDEX | op::METADATA_INDEX => {
                self.source.peek(at + HEAD, INDEX_BYTES.min(len as usize))?
            }
            _ => &[],
        };
        self.indexes.add(opcode, at, HEAD + len, begins);
        let looked = match opcode {
            0 => Err(Damage::Malformed("a record has kind 0, which does not exist")),
            op::FOOTER => Err(Damage::Malformed("a footer is in the middle of the file")),
            op::DATA_END => {
                let crc = self
                    .source
                    .peek(at + HEAD, 4)?
                    .first_chunk()
                    .map_or(0, |crc| u32::from_le_bytes(*crc));
                return self.whole_until(at, crc).map(|()| next);
            }
            op::STATISTICS if len > MAX_STATISTICS => {
                Err(Damage::Summary("its statistics are too long"))
            }
            op::STATISTICS => {
                self.claimed = Statistics::parse(&self.body(at, len)?);
                self.claimed
                    .as_ref()
                    .map(drop)
                    .ok_or(Damage::Summary("its statistics are malformed"))
            }
            op::METADATA | op::ATTACHMENT => match self.charge(len.saturating_add(ENTRY_BYTES)) {
                Ok(()) => {
                    let body = self.body(at, len)?;
                    if opcode == op::METADATA {
                        self.metadata(&body)
                    } else {
                        self.attachment(body)
                    }
                }
                Err(too_large) => Err(too_large),
            },
            _ => Ok(()),
        };
        looked.map_err(|what| self.source.damaged(at, what))?;
        Ok(next)
    }

    /// Reads the body of the record at `at`, which is in the file and within the limits.
    fn body(&mut self, at: u64, len: u64) -> Result<Vec<u8>, ReplayError> {
        let mut body = vec![0; len as usize];
        self.source.read(at + HEAD, &mut body)?;
        Ok(body)
    }

    fn charge(&mut self, bytes: u64) -> Result<(), Damage> {
        self.left =
            self.left.checked_sub(bytes).ok_or(Damage::ExtrasTooLarge { allowed: self.allowed })?;
        Ok(())
    }

    fn metadata(&mut self, body: &[u8]) -> Result<(), Damage> {
        let malformed = || Damage::Malformed("a metadata record is malformed");
        let record = records::McapMetadata::parse(body).ok_or_else(malformed)?;
        let text = |bytes| str::from_utf8(bytes).map(str::to_owned).map_err(|_| malformed());
        let mut pairs = BTreeMap::new();
        for (key, value) in record.map.pairs() {
            self.charge(ENTRY_BYTES)?;
            if pairs.insert(text(key)?, text(value)?).is_some() {
                return Err(Damage::Malformed("a metadata record has a key twice"));
            }
        }
        self.extras.metadata.push((record.name.to_owned(), pairs));
        Ok(())
    }

    fn attachment(&mut self, mut body: Vec<u8>) -> Result<(), Damage> {
        let malformed = Damage::Malformed("an attachment record is malformed");
        let records::McapAttachment { name, media_type, data, crc, len } =
            records::McapAttachment::parse(&body).ok_or(malformed)?;
        let found = crc32fast::hash(&body[..len]);
        if crc == 0 && self.is_cut_off {
            // Pages that never reached the disk read as zeros, including this checksum.
            return Err(Damage::Malformed(
                "an attachment in a file without a footer has no checksum",
            ));
        }
        if crc != 0 && crc != found {
            let name = name.chars().take(NAME_CHARS).collect();
            return Err(Damage::AttachmentCrc { name, expected: crc, found });
        }
        let (name, media_type, start) = (name.to_owned(), media_type.to_owned(), len - data.len());
        // The data stay in this buffer: a copy would double the memory that the caller allowed.
        body.truncate(len);
        body.drain(..start);
        self.extras.attachments.push(Attachment { name, media_type, data: body });
        Ok(())
    }
}
