//! Fuzzes the sockets of the recorder: messages from a lambda's process and from a starter to the
//! recorder, and from the recorder to a lambda's process.
//!
//! A starter sends one socket, with the first byte.
//!
//! An input is a byte for the mode, then either the raw bytes of the stream, or frames: tag, length
//! in two bytes, payload.

use std::io::{IoSlice, Write};
use std::mem::MaybeUninit;
use std::net::Shutdown;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;

use gleaner_protocol::link::{
    ControlMessage, ControlServer, LambdaLink, LambdaMessage, RecorderLink,
};

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};

use crate::budget;
use crate::input::FuzzInput;
use crate::journal;

pub mod mode {
    /// Mask of the two bits that select sender and receiver.
    pub const PEERS: u8 = 3;
    /// From a lambda's process to the recorder.
    pub const LAMBDA: u8 = 0;
    /// From a starter to the recorder.
    pub const STARTER: u8 = 1;
    /// From the recorder to a lambda's process.
    pub const RECORDER: u8 = 2;
    /// Frames follow.
    pub const FRAMES: u8 = 4;
}

/// Longest stream that is sent: a socket buffer takes it in one write.
const BYTES_MAX: usize = 64 << 10;

/// Memory budget of one frame. JSON takes a multiple of its text.
pub(crate) const MEMORY: usize = 8 << 20;

/// Sends the input and receives it to the end. Returns whether any message was valid.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    let mode = input.u8();
    let with_socket = mode & mode::PEERS == mode::STARTER;
    let Some((local, bytes)) = sent(input, mode & mode::FRAMES != 0, with_socket) else {
        return false;
    };
    match mode & mode::PEERS {
        mode::STARTER => orders(local, bytes),
        mode::RECORDER => answers(local, bytes),
        _ => wakes(local, bytes),
    }
}

/// Sends the rest of an input, as frames or raw, and then the end. A socket goes with the first
/// byte if `has_socket`. Returns the other end and the number of bytes; `None` if they are too
/// many.
pub(crate) fn sent(
    input: FuzzInput,
    is_framed: bool,
    has_socket: bool,
) -> Option<(UnixStream, usize)> {
    let bytes = if is_framed { framed(input) } else { input.0.to_vec() };
    if bytes.len() > BYTES_MAX {
        return None;
    }
    let (mut remote, local) = UnixStream::pair().expect("the system has sockets");
    let mut rest = bytes.as_slice();
    if has_socket && let Some((first, others)) = bytes.split_first_chunk::<1>() {
        with_socket(&remote, first);
        rest = others;
    }
    remote.write_all(rest).expect("a socket buffer takes this much in one write");
    remote.shutdown(Shutdown::Write).expect("the socket is open");
    Some((local, bytes.len()))
}

/// Sends `bytes` and a socket, as a starter does with the first bytes of a command.
fn with_socket(to: &UnixStream, bytes: &[u8]) {
    let fds = [to.as_fd()];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut with = SendAncillaryBuffer::new(&mut space);
    with.push(SendAncillaryMessage::ScmRights(&fds));
    sendmsg(to, &[IoSlice::new(bytes)], &mut with, SendFlags::NOSIGNAL)
        .expect("a socket buffer takes this much in one write");
}

fn framed(mut input: FuzzInput) -> Vec<u8> {
    let mut bytes = Vec::new();
    while !input.0.is_empty() {
        let (tag, len) = (input.u8(), input.u16());
        let payload = input.bytes(len.into());
        bytes.extend((payload.len() as u32).to_le_bytes());
        bytes.push(tag);
        bytes.extend(payload);
    }
    bytes
}

fn wakes(socket: UnixStream, bytes: usize) -> bool {
    let (mut link, answers) = LambdaLink::new(socket.into()).expect("the system has sockets");
    let mut inputs = None;
    for frames in 0.. {
        assert!(frames <= bytes, "more frames than bytes");
        match budget::within(MEMORY, || link.receive()) {
            Ok(Some(LambdaMessage::Hello(header))) => {
                assert!(inputs.is_none(), "a second hello");
                inputs = Some(header.inputs.len());
            }
            Ok(Some(LambdaMessage::Wake { entry, .. })) => {
                let inputs = inputs.expect("a wake before hello");
                assert_eq!(entry.seen.len(), inputs);
                journal::round_trip(inputs, &[*entry]);
            }
            Ok(Some(LambdaMessage::Engine(_))) => {
                assert!(inputs.is_some(), "an engine before hello");
            }
            Ok(Some(LambdaMessage::Bye)) => {}
            Ok(None) | Err(_) => break,
        }
    }
    answers.close();
    inputs.is_some()
}

fn orders(socket: UnixStream, bytes: usize) -> bool {
    let mut controlled = ControlServer::new(socket.into());
    let (mut orders, mut sockets) = (0, 0);
    while let Ok(Some(order)) = budget::within(MEMORY, || controlled.receive()) {
        sockets += usize::from(matches!(order, ControlMessage::Add(..)));
        assert!(sockets <= 1, "a lambda without its own socket");
        orders += 1;
        assert!(orders <= bytes, "more orders than bytes");
    }
    orders > 0
}

fn answers(socket: UnixStream, bytes: usize) -> bool {
    let mut link = RecorderLink::new(socket.into());
    let mut valid = false;
    // Until the link reports a closed connection or a protocol error.
    for polls in 0.. {
        assert!(polls <= bytes + 1, "a closed connection is not reported");
        match budget::within(MEMORY, || link.poll()) {
            Ok(answers) => {
                assert!(answers.len() <= bytes, "more answers than bytes");
                valid |= !answers.is_empty();
            }
            Err(_) => break,
        }
    }
    valid
}
