//! What a lambda's process and a starter say to the recorder, and the recorder to a lambda's
//! process, over sockets.
//!
//! A starter sends one socket, with the first byte.
//!
//! An input is a byte for the mode, and then either bytes as they go over the socket, or frames:
//! tag, length in two bytes, payload.

use std::io::{IoSlice, Write};
use std::mem::MaybeUninit;
use std::net::Shutdown;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;

use gleaner_protocol::link::{Controlled, Heard, LambdaLink, Order, RecorderLink};

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};

use crate::budget;
use crate::input::Input;
use crate::journal;

/// Bits of the mode.
pub mod mode {
    /// To whom it is said; these two bits.
    pub const WHO: u8 = 3;
    /// By a lambda's process to the recorder.
    pub const LAMBDA: u8 = 0;
    /// By a starter to the recorder.
    pub const STARTER: u8 = 1;
    /// By the recorder to a lambda's process.
    pub const RECORDER: u8 = 2;
    /// Frames follow.
    pub const FRAMES: u8 = 4;
}

/// The longest that is said, so that a socket takes it at once.
const BYTES_MAX: usize = 64 << 10;

/// What one frame may take. JSON takes many times its text.
const MEMORY: usize = 8 << 20;

/// Has it said, and listens to the end. Whether anything of it made sense.
pub fn check(data: &[u8]) -> bool {
    let mut input = Input(data);
    let mode = input.u8();
    let mut bytes = if mode & mode::FRAMES == 0 { input.0.to_vec() } else { framed(input) };
    if bytes.len() > BYTES_MAX {
        return false;
    }
    let (mut theirs, ours) = UnixStream::pair().expect("the system has sockets");
    if mode & mode::WHO == mode::STARTER && !bytes.is_empty() {
        let (first, rest) = bytes.split_at(1);
        with_socket(&theirs, first);
        bytes = rest.to_vec();
    }
    theirs.write_all(&bytes).expect("a socket takes this much at once");
    theirs.shutdown(Shutdown::Write).expect("the socket is open");
    match mode & mode::WHO {
        mode::STARTER => orders(ours, bytes.len()),
        mode::RECORDER => answers(ours, bytes.len()),
        _ => wakes(ours, bytes.len()),
    }
}

/// Sends `bytes` and a socket, as a starter does with the first bytes of an order.
fn with_socket(to: &UnixStream, bytes: &[u8]) {
    let fds = [to.as_fd()];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut with = SendAncillaryBuffer::new(&mut space);
    with.push(SendAncillaryMessage::ScmRights(&fds));
    sendmsg(to, &[IoSlice::new(bytes)], &mut with, SendFlags::NOSIGNAL)
        .expect("a socket takes this much at once");
}

fn framed(mut input: Input) -> Vec<u8> {
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
    for heard in 0.. {
        assert!(heard <= bytes, "more frames than bytes");
        match budget::within(MEMORY, || link.hear()) {
            Ok(Some(Heard::Hello(header))) => {
                assert!(inputs.is_none(), "a second hello");
                inputs = Some(header.inputs.len());
            }
            Ok(Some(Heard::Wake { entry, .. })) => {
                let inputs = inputs.expect("a wake before hello");
                assert_eq!(entry.seen.len(), inputs);
                journal::again(inputs, &[*entry]);
            }
            Ok(Some(Heard::Bye)) => {}
            Ok(None) | Err(_) => break,
        }
    }
    answers.close();
    inputs.is_some()
}

fn orders(socket: UnixStream, bytes: usize) -> bool {
    let mut controlled = Controlled::new(socket.into());
    let (mut orders, mut sockets) = (0, 0);
    while let Ok(Some(order)) = budget::within(MEMORY, || controlled.order()) {
        sockets += usize::from(matches!(order, Order::Add(..)));
        assert!(sockets <= 1, "a lambda without a socket");
        orders += 1;
        assert!(orders <= bytes, "more orders than bytes");
    }
    orders > 0
}

fn answers(socket: UnixStream, bytes: usize) -> bool {
    let mut link = RecorderLink::new(socket.into());
    let mut sound = false;
    // Until it finds that the other side has closed, or that it makes no sense.
    for polls in 0.. {
        assert!(polls <= bytes + 1, "a closed connection is not found to be closed");
        match budget::within(MEMORY, || link.poll()) {
            Ok(said) => {
                assert!(said.len() <= bytes, "more answers than bytes");
                sound |= !said.is_empty();
            }
            Err(_) => break,
        }
    }
    sound
}
