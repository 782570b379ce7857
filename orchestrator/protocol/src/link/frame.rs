//! Frames: `u32` little-endian length of the payload, `u8` tag, payload.

use std::io::{self, Read};

use super::LinkError;

/// Longest payload, that of the longest block of a journal: the header of a build with thousands of
/// files fits, and the largest wake that a host allows.
pub const FRAME_MAX: usize = 2 << 20;

/// Length of the head, before the payload.
pub(crate) const HEAD: usize = 5;

/// Tags of frames.
pub(crate) mod tag {
    /// Starter to recorder: a lambda, as JSON, with its socket.
    pub(crate) const ADD: u8 = 1;
    /// Starter to recorder: complete open clips and exit. Starter to others: exit.
    pub(crate) const STOP: u8 = 2;
    /// Starter to ingress: a reader, as JSON, with its socket.
    pub(crate) const ADD_READER: u8 = 3;
    /// Starter to ingress: further topics for a reader, as JSON.
    pub(crate) const ADD_TOPICS: u8 = 4;
    /// Starter to ingress: play the drive.
    pub(crate) const BEGIN: u8 = 5;
    /// Starter to a program that it starts: names of connections as JSON, with their sockets.
    pub(crate) const HANDOVER: u8 = 6;
    /// Starter to gleaner-inference: a model, as JSON, with its file.
    pub(crate) const MODEL_FILE: u8 = 7;
    /// Starter to gleaner-inference: a lambda, as JSON, with its socket.
    pub(crate) const ADD_CLIENT: u8 = 8;
    /// Starter to recorder: as `STOP`, while the lambdas run on, with another recorder.
    pub(crate) const GIVE_WAY: u8 = 9;
    /// Lambda to recorder: the header of its journal, as JSON. Sent once, first.
    pub(crate) const HELLO: u8 = 16;
    /// Lambda to recorder: `i64` time of the decision, `u32` number of missing wakes before it, and
    /// the wake as in a journal.
    pub(crate) const WAKE: u8 = 17;
    /// Lambda to recorder: the end of the connection.
    pub(crate) const BYE: u8 = 18;
    /// Lambda to recorder: the engine, as text, in place of that in the header.
    pub(crate) const ENGINE: u8 = 19;
    /// Recorder to lambda: it is accepted.
    pub(crate) const READY: u8 = 32;
    /// Recorder to lambda: it is refused; the reason as text.
    pub(crate) const REFUSED: u8 = 33;
    /// Recorder to lambda: `u64` ns from a decision with triggers to the opening of its windows.
    pub(crate) const OPENED: u8 = 34;
    /// Ingress to reader: a message as JSON; some with a descriptor.
    pub(crate) const READER: u8 = 48;
    /// Reader to ingress: `u32` id of the topic whose definitions it needs.
    pub(crate) const DEFINITIONS: u8 = 64;
    /// Reader to ingress: `u32` index of the topic to publish, and a message.
    pub(crate) const PUBLISH: u8 = 65;
    /// Reader to ingress: `u32` id of the topic whose layout it needs.
    pub(crate) const LAYOUT: u8 = 66;
}

/// Returns the name of a tag for messages.
pub(crate) fn name(tag: u8) -> &'static str {
    match tag {
        tag::ADD => "add",
        tag::STOP => "stop",
        tag::GIVE_WAY => "give way",
        tag::HELLO => "hello",
        tag::WAKE => "wake",
        tag::BYE => "bye",
        tag::ENGINE => "engine",
        tag::READY => "ready",
        tag::REFUSED => "refused",
        tag::OPENED => "opened",
        tag::ADD_READER => "add reader",
        tag::ADD_TOPICS => "add topics",
        tag::BEGIN => "begin",
        tag::HANDOVER => "handover",
        tag::MODEL_FILE => "model file",
        tag::ADD_CLIENT => "add client",
        tag::READER => "message",
        tag::DEFINITIONS => "definitions",
        tag::PUBLISH => "publish",
        tag::LAYOUT => "layout",
        _ => "unknown",
    }
}

/// Begins a frame in `out`; [`close`] completes it.
pub(crate) fn open(tag: u8, out: &mut Vec<u8>) {
    out.clear();
    out.extend_from_slice(&[0, 0, 0, 0, tag]);
}

/// Completes the frame in `out` with its length. Returns `false` if it is too long.
pub(crate) fn close(out: &mut [u8]) -> bool {
    let len = out.len() - HEAD;
    if let (true, Ok(len)) = (len <= FRAME_MAX, u32::try_from(len)) {
        out[..4].copy_from_slice(&len.to_le_bytes());
        return true;
    }
    false
}

/// Returns a complete frame.
pub(crate) fn encode(tag: u8, payload: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(HEAD + payload.len());
    open(tag, &mut out);
    out.extend_from_slice(payload);
    close(&mut out);
    out
}

/// Parses a head: tag and length.
pub(crate) fn head(bytes: [u8; HEAD], peer: &'static str) -> Result<(u8, usize), LinkError> {
    let [a, b, c, d, tag] = bytes;
    let len = u32::from_le_bytes([a, b, c, d]);
    match usize::try_from(len) {
        Ok(len) if len <= FRAME_MAX => Ok((tag, len)),
        _ => Err(LinkError::TooLong { peer, frame: name(tag), bytes: len.into(), max: FRAME_MAX }),
    }
}

/// Reads the next frame from `peer` into `payload`; returns its tag, `None` at the end. Memory is
/// allocated as bytes arrive, not by the length in the head.
pub(crate) fn read(
    from: &mut impl Read,
    payload: &mut Vec<u8>,
    peer: &'static str,
) -> Result<Option<u8>, LinkError> {
    let failed = |source: io::Error| match source.kind() {
        io::ErrorKind::ConnectionReset | io::ErrorKind::BrokenPipe => LinkError::Gone { peer },
        _ => LinkError::Socket { peer, source },
    };
    payload.clear();
    from.by_ref().take(HEAD as u64).read_to_end(payload).map_err(failed)?;
    let Ok(bytes) = <[u8; HEAD]>::try_from(payload.as_slice()) else {
        return if payload.is_empty() { Ok(None) } else { Err(LinkError::Gone { peer }) };
    };
    let (tag, len) = head(bytes, peer)?;
    payload.clear();
    from.by_ref().take(len as u64).read_to_end(payload).map_err(failed)?;
    if payload.len() < len { Err(LinkError::Gone { peer }) } else { Ok(Some(tag)) }
}
