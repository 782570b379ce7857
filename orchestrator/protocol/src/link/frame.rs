//! Frames: `u32` little-endian length of the payload, `u8` tag, payload.

use std::io::{self, Read};

use super::LinkError;

/// Longest payload: as long as the longest block of a journal, which holds the header of a build
/// with thousands of files, and the largest wake that a host allows.
pub const FRAME_MAX: usize = 2 << 20;

/// Bytes before a payload.
pub(super) const HEAD: usize = 5;

/// What a frame is.
pub(super) mod tag {
    /// Starter to recorder: a lambda, as JSON; its socket comes with it.
    pub(crate) const ADD: u8 = 1;
    /// Starter to recorder: complete what is open, and end.
    pub(crate) const STOP: u8 = 2;
    /// Lambda to recorder: the header of its journal, as JSON. First, once.
    pub(crate) const HELLO: u8 = 16;
    /// Lambda to recorder: `i64` time of the decision, `u32` wakes that are missing before it, and
    /// the wake as in a journal.
    pub(crate) const WAKE: u8 = 17;
    /// Lambda to recorder: nothing more comes.
    pub(crate) const BYE: u8 = 18;
    /// Recorder to lambda: it is heard from now on.
    pub(crate) const READY: u8 = 32;
    /// Recorder to lambda: it is not, and why, as text.
    pub(crate) const REFUSED: u8 = 33;
    /// Recorder to lambda: `u64` ns from a decision with triggers to the opening of its windows.
    pub(crate) const OPENED: u8 = 34;
}

/// The name of a tag in messages.
pub(super) fn name(tag: u8) -> &'static str {
    match tag {
        tag::ADD => "add",
        tag::STOP => "stop",
        tag::HELLO => "hello",
        tag::WAKE => "wake",
        tag::BYE => "bye",
        tag::READY => "ready",
        tag::REFUSED => "refused",
        tag::OPENED => "opened",
        _ => "unknown",
    }
}

/// Begins a frame in `out`; [`close`] completes it.
pub(super) fn open(tag: u8, out: &mut Vec<u8>) {
    out.clear();
    out.extend_from_slice(&[0, 0, 0, 0, tag]);
}

/// Completes the frame in `out`: its length is known now. `false` if it is longer than any may be.
pub(super) fn close(out: &mut [u8]) -> bool {
    let len = out.len() - HEAD;
    if let (true, Ok(len)) = (len <= FRAME_MAX, u32::try_from(len)) {
        out[..4].copy_from_slice(&len.to_le_bytes());
        return true;
    }
    false
}

/// A whole frame.
pub(super) fn whole(tag: u8, payload: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(HEAD + payload.len());
    open(tag, &mut out);
    out.extend_from_slice(payload);
    close(&mut out);
    out
}

/// What a head says: tag and length.
pub(super) fn head(bytes: [u8; HEAD], who: &'static str) -> Result<(u8, usize), LinkError> {
    let [a, b, c, d, tag] = bytes;
    let len = u32::from_le_bytes([a, b, c, d]);
    match usize::try_from(len) {
        Ok(len) if len <= FRAME_MAX => Ok((tag, len)),
        _ => Err(LinkError::TooLong { who, frame: name(tag), bytes: len.into() }),
    }
}

/// The next frame from `who`, into `payload`; `None` at the end. Memory is taken as bytes come, not
/// as a head claims.
pub(super) fn read(
    from: &mut impl Read,
    payload: &mut Vec<u8>,
    who: &'static str,
) -> Result<Option<u8>, LinkError> {
    let failed = |source: io::Error| match source.kind() {
        io::ErrorKind::ConnectionReset | io::ErrorKind::BrokenPipe => LinkError::Gone { who },
        _ => LinkError::Socket { who, source },
    };
    payload.clear();
    from.by_ref().take(HEAD as u64).read_to_end(payload).map_err(failed)?;
    let Ok(bytes) = <[u8; HEAD]>::try_from(payload.as_slice()) else {
        return if payload.is_empty() { Ok(None) } else { Err(LinkError::Gone { who }) };
    };
    let (tag, len) = head(bytes, who)?;
    payload.clear();
    from.by_ref().take(len as u64).read_to_end(payload).map_err(failed)?;
    if payload.len() < len { Err(LinkError::Gone { who }) } else { Ok(Some(tag)) }
}
