//! Finds the valid records of one segment, also behind damage.

use std::io;

use crate::format::{HEAD_LEN, HEADER_LEN, RecordHead, SEGMENT_MAX, SegmentHeader};
use crate::{SegmentFile, SpoolError};

/// Bytes that are read at once.
const WINDOW: usize = 16 << 10;

/// Bytes that a disk cannot read if it cannot read one of them: a page of the kernel's cache.
const BLOCK: u64 = 4096;

/// A position in a segment.
pub(crate) struct SegmentScan<F> {
    file: F,
    stream: String,
    first: u64,
    /// `None` if the header is not that of the expected segment, or not yet: no record can be
    /// trusted then.
    pub(crate) header: Option<SegmentHeader>,
    /// Offset of the record that [`peek`](Self::peek) found.
    at: u64,
    /// Length of that record with its head.
    len: usize,
    /// Smallest number that the next record can have.
    least: u64,
    /// Set if invalid bytes lie before that record.
    pub(crate) damaged: bool,
    /// Number of bytes behind the last valid record, once the end was reached.
    pub(crate) torn: u64,
    window: Vec<u8>,
    window_at: u64,
    /// Length of the file when it was last looked at.
    length: u64,
}

impl<F: SegmentFile> SegmentScan<F> {
    /// Reads the segment `file` of `stream` that begins with number `first`.
    pub(crate) fn new(file: F, stream: &str, first: u64) -> Self {
        SegmentScan {
            file,
            stream: stream.to_owned(),
            first,
            header: None,
            at: HEADER_LEN as u64,
            len: 0,
            least: first,
            damaged: false,
            torn: 0,
            window: Vec::new(),
            window_at: 0,
            length: 0,
        }
    }

    /// Returns whether the segment still has a name: it was neither removed nor replaced.
    pub(crate) fn is_linked(&self) -> Result<bool, SpoolError> {
        self.file.is_linked().map_err(|source| self.failed(source))
    }

    /// Makes the content durable.
    pub(crate) fn sync(&self) -> io::Result<()> {
        self.file.sync()
    }

    /// Finds the next valid record without consuming it; `None` at the end. The segment may grow
    /// meanwhile.
    pub(crate) fn peek(&mut self) -> Result<Option<RecordHead>, SpoolError> {
        self.length = self.file.length().map_err(|source| self.failed(source))?;
        // A writer of an earlier version may not have written the header yet.
        if self.header.is_none() && self.length >= HEADER_LEN as u64 {
            self.find_header()?;
        }
        self.find_record().map_err(|source| self.failed(source))
    }

    fn find_header(&mut self) -> Result<(), SpoolError> {
        let header = self.bytes(0, HEADER_LEN).map(SegmentHeader::parse);
        match header.map_err(|source| self.failed(source))? {
            Ok(Some(header)) if header.stream == self.stream && header.first == self.first => {
                self.header = Some(header);
            }
            Ok(_) => self.window.clear(),
            Err(found) => {
                let (stream, first) = (self.stream.clone(), self.first);
                return Err(SpoolError::Version { stream, first, found });
            }
        }
        Ok(())
    }

    fn find_record(&mut self) -> io::Result<Option<RecordHead>> {
        let end = self.length.min(SEGMENT_MAX);
        let Some(salt) = self.header.as_ref().map(|header| header.salt) else {
            self.torn = self.length;
            return Ok(None);
        };
        let mut at = self.at;
        while at + HEAD_LEN as u64 <= end {
            let least = self.least;
            let head = RecordHead::parse(self.bytes(at, HEAD_LEN)?, salt)
                .filter(|head| head.seq >= least && at + (HEAD_LEN + head.len) as u64 <= end);
            let Some(head) = head else {
                at += 1;
                continue;
            };
            let len = HEAD_LEN + head.len;
            if crc32fast::hash(&self.bytes(at, len)?[HEAD_LEN..]) == head.payload_crc {
                self.damaged |= at != self.at;
                (self.at, self.len) = (at, len);
                return Ok(Some(head));
            }
            at += len as u64;
        }
        self.torn = self.length.saturating_sub(self.at);
        // What is there now may be a part of what will be there.
        self.window.clear();
        Ok(None)
    }

    /// Payload of the record that [`peek`](Self::peek) found.
    pub(crate) fn payload(&mut self) -> Result<Vec<u8>, SpoolError> {
        let (at, len) = (self.at, self.len);
        let payload = self.bytes(at, len).map(|bytes| bytes[HEAD_LEN..].to_vec());
        payload.map_err(|source| self.failed(source))
    }

    /// Consumes the record `head` that [`peek`](Self::peek) found.
    pub(crate) fn skip(&mut self, head: &RecordHead) {
        self.at += self.len as u64;
        self.least = head.seq + 1;
        self.damaged = false;
    }

    fn failed(&self, source: io::Error) -> SpoolError {
        SpoolError::Read { stream: self.stream.clone(), segment: Some(self.first), source }
    }

    /// Fills the rest of a block that cannot be read, from `filled` on in the window, with bytes
    /// that are no record: an unreadable sector costs its records, and blocks nothing.
    fn fill_unreadable(&mut self, filled: usize) -> usize {
        let at = self.window_at + filled as u64;
        let end = (at + 1).next_multiple_of(BLOCK).min(self.length.max(at + 1));
        let rest = &mut self.window[filled..];
        let count = rest.len().min((end - at) as usize);
        rest[..count].fill(0xff);
        count
    }

    fn bytes(&mut self, at: u64, len: usize) -> io::Result<&[u8]> {
        let window_end = self.window_at + self.window.len() as u64;
        if at < self.window_at || at + len as u64 > window_end {
            self.window.resize(len.max(WINDOW), 0);
            self.window_at = at;
            let mut filled = 0;
            while filled < len {
                match self.file.read_at(&mut self.window[filled..], at + filled as u64) {
                    Ok(0) => break,
                    Ok(read) => filled += read,
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(error) if is_unreadable(&error) => {
                        filled += self.fill_unreadable(filled);
                    }
                    Err(error) => {
                        self.window.clear();
                        return Err(error);
                    }
                }
            }
            self.window.truncate(filled);
        }
        let from = (at - self.window_at) as usize;
        self.window.get(from..from + len).ok_or_else(|| io::ErrorKind::UnexpectedEof.into())
    }
}

fn is_unreadable(error: &io::Error) -> bool {
    error.raw_os_error() == Some(rustix::io::Errno::IO.raw_os_error())
}
