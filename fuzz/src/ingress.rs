//! Fuzzes the sockets of the ingress and of programs that a starter starts: requests of a reader,
//! which is an untrusted peer, messages of the ingress to a reader, and requests and connections of
//! a starter.
//!
//! One socket comes with the first byte, from whichever side.
//!
//! An input is as that of `link`.

use std::os::unix::net::UnixStream;

use gleaner_protocol::Handover;
use gleaner_protocol::ingress::{
    IngressLink, IngressRequest, IngressServer, PUBLISH_MAX, ReaderLink, ReaderMessage,
    ReaderRequest,
};
use gleaner_protocol::link::{Incoming, LinkError};

use crate::budget;
use crate::input::FuzzInput;
use crate::link::{MEMORY, sent};

pub mod mode {
    /// Mask of the two bits that select sender and receiver.
    pub const PEERS: u8 = 3;
    /// From a reader to the ingress.
    pub const READER: u8 = 0;
    /// From a starter to the ingress.
    pub const STARTER: u8 = 1;
    /// From the ingress to a reader.
    pub const INGRESS: u8 = 2;
    /// From a starter to a program that it starts.
    pub const HANDOVER: u8 = 3;
    /// Frames follow.
    pub const FRAMES: u8 = 4;
}

/// Sends the input and receives it to the end. Returns whether any message was valid.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    let mode = input.u8();
    let Some((local, bytes)) = sent(input, mode & mode::FRAMES != 0, true) else { return false };
    let messages = match mode & mode::PEERS {
        mode::STARTER => orders(local),
        mode::INGRESS => messages(local),
        mode::HANDOVER => handovers(&local),
        _ => requests(local),
    };
    assert!(messages <= bytes, "more messages than bytes");
    messages > 0
}

/// Receives as the ingress. Each request, sent as a reader does, is received as the same.
fn requests(socket: UnixStream) -> usize {
    let mut link = ReaderLink::new(socket.into());
    let (near, far) = UnixStream::pair().expect("the system has sockets");
    let ((_, again), mut received) = (IngressLink::new(near.into()), ReaderLink::new(far.into()));
    let mut count = 0;
    while let Ok(Incoming::Message(request)) = budget::within(MEMORY, || link.poll()) {
        let sent = match &request {
            ReaderRequest::NeedDefinitions { id } => again.need_definitions(*id),
            ReaderRequest::NeedLayout { id } => again.need_layout(*id),
            ReaderRequest::Publish { index, cdr } => {
                assert!(cdr.len() <= PUBLISH_MAX, "a message that is too long");
                again.publish(*index, cdr)
            }
        };
        sent.expect("the other end reads");
        let same = received.poll().expect("the request was valid");
        assert_eq!(same, Incoming::Message(request), "sent again");
        count += 1;
    }
    count
}

/// Receives as the ingress. All grants are within bounds.
fn orders(socket: UnixStream) -> usize {
    let mut server = IngressServer::new(socket.into());
    let (mut count, mut sockets) = (0, 0);
    loop {
        match budget::within(MEMORY, || server.poll()) {
            Ok(Incoming::Message(IngressRequest::AddReader(add, _))) => {
                add.check().expect("the grant was checked");
                sockets += 1;
                assert!(sockets <= 1, "a reader without its own socket");
            }
            Ok(Incoming::Message(IngressRequest::AddTopics(add))) => {
                add.check().expect("the grant was checked");
            }
            Ok(Incoming::Message(IngressRequest::Begin | IngressRequest::Stop)) => {}
            // The next request can be read.
            Err(LinkError::Grant { .. }) => continue,
            Ok(Incoming::Nothing) => panic!("a closed connection is not reported"),
            Ok(Incoming::Ended) | Err(_) => return count,
        }
        count += 1;
    }
}

/// Receives as a reader. Exactly the messages that need a descriptor have one.
fn messages(socket: UnixStream) -> usize {
    let (mut link, _requests) = IngressLink::new(socket.into());
    let (mut count, mut descriptors) = (0, 0);
    while let Ok(Incoming::Message(delivery)) = budget::within(MEMORY, || link.poll()) {
        let message = delivery.message;
        let needs = matches!(message, ReaderMessage::Welcome | ReaderMessage::Attached(_));
        assert_eq!(delivery.descriptor.is_some(), needs);
        descriptors += usize::from(needs);
        assert!(descriptors <= 1, "a descriptor that was not sent");
        let text = serde_json::to_vec(&message).expect("a message is JSON");
        let again: ReaderMessage = serde_json::from_slice(&text).expect("it was just written");
        assert_eq!(again, message);
        count += 1;
    }
    count
}

/// Receives as a started program. No connection arrives that was not sent.
fn handovers(socket: &UnixStream) -> usize {
    let (mut count, mut connections) = (0, 0);
    while let Ok(handover) = budget::within(MEMORY, || Handover::receive(socket)) {
        let all = [handover.control, handover.ingress, handover.recorder];
        connections += all.iter().flatten().count();
        assert!(connections <= 1, "a connection that was not sent");
        count += 1;
    }
    count
}
