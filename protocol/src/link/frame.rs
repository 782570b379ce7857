//! Frames: `u32` little-endian length of the payload, `u8` tag, payload.

use std::io::{self, Read};

use serde::Serialize;

use super::LinkError;

/// Longest payload, that of the longest block of a journal: the header of a build with thousands of
/// files fits, and the largest wake that a host allows.
pub const FRAME_MAX: usize = 2 << 20;

/// Length of the head, before the payload.
pub(crate) const HEAD: usize = 5;

/// Defines the tags of frames, and their names for messages.
macro_rules! tags {
    ($($(#[$doc:meta])+ $tag:ident = $number:literal, $name:literal;)+) => {
        /// Tags of frames.
        pub(crate) mod tag {
            $($(#[$doc])+ pub(crate) const $tag: u8 = $number;)+
        }

        /// Returns the name of a tag for messages.
        pub(crate) fn name(tag: u8) -> &'static str {
            match tag {
                $(tag::$tag => $name,)+
                _ => "unknown",
            }
        }
    };
}

tags! {
    /// Starter to recorder: a lambda, as JSON, with its socket.
    ADD = 1, "add";
    /// Starter to recorder: complete open clips and exit. Starter to others: exit.
    STOP = 2, "stop";
    /// Starter to ingress: a reader, as JSON, with its socket.
    ADD_READER = 3, "add reader";
    /// Starter to ingress: further topics for a reader, as JSON.
    ADD_TOPICS = 4, "add topics";
    /// Starter to ingress: play the drive.
    BEGIN = 5, "begin";
    /// Starter to a program that it starts: names of connections as JSON, with their sockets.
    HANDOVER = 6, "handover";
    /// Starter to gleaner-inference: a model, as JSON, with its file.
    MODEL_FILE = 7, "model file";
    /// Starter to gleaner-inference: a lambda, as JSON, with its socket.
    ADD_CLIENT = 8, "add client";
    /// Starter to recorder: as `STOP`, while the lambdas run on, with another recorder.
    GIVE_WAY = 9, "give way";
    /// Starter to gleaner-inference: the result of a trial, as JSON.
    TRIED_LOAD = 10, "tried load";
    /// Lambda to recorder: the header of its journal, as JSON. Sent once, first.
    HELLO = 16, "hello";
    /// Lambda to recorder: `i64` time of the decision, `u32` number of missing wakes before it, and
    /// the wake as in a journal.
    WAKE = 17, "wake";
    /// Lambda to recorder: the end of the connection.
    BYE = 18, "bye";
    /// Lambda to recorder: the engine, as text, in place of that in the header.
    ENGINE = 19, "engine";
    /// Recorder to lambda: it is accepted.
    READY = 32, "ready";
    /// Recorder to lambda: it is refused; the reason as text.
    REFUSED = 33, "refused";
    /// Recorder to lambda: `u64` ns from a decision with triggers to the opening of its windows.
    OPENED = 34, "opened";
    /// Ingress to reader: a message as JSON; some with a descriptor.
    READER = 48, "message";
    /// Reader to ingress: `u32` id of the topic whose definitions it needs.
    DEFINITIONS = 64, "definitions";
    /// Reader to ingress: `u32` index of the topic to publish, and a message.
    PUBLISH = 65, "publish";
    /// Reader to ingress: `u32` id of the topic whose layout it needs.
    LAYOUT = 66, "layout";
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

pub(crate) fn encode(tag: u8, payload: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(HEAD + payload.len());
    open(tag, &mut out);
    out.extend_from_slice(payload);
    close(&mut out);
    out
}

/// Returns a complete frame with a message of `from` as JSON, unless that is too long.
pub(crate) fn encode_json(
    tag: u8,
    message: &impl Serialize,
    from: &'static str,
    to: &'static str,
) -> Result<Vec<u8>, LinkError> {
    let payload = serde_json::to_vec(message)
        .map_err(|error| LinkError::Socket { peer: to, source: error.into() })?;
    if payload.len() > FRAME_MAX {
        let (frame, bytes) = (name(tag), payload.len() as u64);
        return Err(LinkError::TooLong { peer: from, frame, bytes, max: FRAME_MAX });
    }
    Ok(encode(tag, &payload))
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
