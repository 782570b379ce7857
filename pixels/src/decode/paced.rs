//! A reader of JPEG bytes for the decoder, which fails when the caller wants to stop.

use std::cell::Cell;

use gleaner_rules::pixels::StopCheck;
use zune_core::bytestream::{ZByteIoError, ZByteReaderTrait, ZCursor, ZSeekFrom};

/// Cost of a byte of a JPEG, in bytes of other work: it becomes a dozen bytes of pixels or more,
/// each of which takes some time.
const WEIGHT: usize = 64;

/// Reads `data`, and fails once `pace` requests the decoder to stop; `stopped` records that.
pub(super) struct PacedReader<'a> {
    data: ZCursor<&'a [u8]>,
    pace: &'a StopCheck<'a>,
    stopped: &'a Cell<bool>,
}

impl<'a> PacedReader<'a> {
    pub(super) fn new(data: &'a [u8], pace: &'a StopCheck<'a>, stopped: &'a Cell<bool>) -> Self {
        Self { data: ZCursor::new(data), pace, stopped }
    }

    fn go_on(&self, bytes: usize) -> Result<(), ZByteIoError> {
        if self.stopped.get() || self.pace.check(bytes.saturating_mul(WEIGHT)).is_err() {
            self.stopped.set(true);
            return Err(ZByteIoError::Generic("stopped"));
        }
        Ok(())
    }
}

impl ZByteReaderTrait for PacedReader<'_> {
    fn read_byte_no_error(&mut self) -> u8 {
        self.data.read_byte_no_error()
    }

    fn read_exact_bytes(&mut self, buf: &mut [u8]) -> Result<(), ZByteIoError> {
        self.go_on(buf.len())?;
        self.data.read_exact_bytes(buf)
    }

    fn read_bytes(&mut self, buf: &mut [u8]) -> Result<usize, ZByteIoError> {
        self.go_on(buf.len())?;
        self.data.read_bytes(buf)
    }

    fn peek_bytes(&mut self, buf: &mut [u8]) -> Result<usize, ZByteIoError> {
        self.data.peek_bytes(buf)
    }

    fn peek_exact_bytes(&mut self, buf: &mut [u8]) -> Result<(), ZByteIoError> {
        self.data.peek_exact_bytes(buf)
    }

    fn z_seek(&mut self, from: ZSeekFrom) -> Result<u64, ZByteIoError> {
        self.data.z_seek(from)
    }

    /// The decoder checks for the end after each byte that it reads by itself.
    fn is_eof(&mut self) -> Result<bool, ZByteIoError> {
        self.go_on(1)?;
        self.data.is_eof()
    }

    fn z_position(&mut self) -> Result<u64, ZByteIoError> {
        self.data.z_position()
    }

    fn read_remaining(&mut self, sink: &mut Vec<u8>) -> Result<usize, ZByteIoError> {
        self.data.read_remaining(sink)
    }
}
