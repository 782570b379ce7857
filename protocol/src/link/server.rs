//! The recorder's end of a lambda's connection.

use std::io::{self, BufReader};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;

use super::frame::{self, tag};
use super::{FrameQueue, LinkError};
use gleaner_journal::{Decoder, INPUTS_MAX, JournalEntry, JournalHeader};

const LAMBDA: &str = "the lambda";

/// Longest reason for a refusal, in bytes.
const REASON_MAX: usize = 2 << 10;

/// A message from a lambda's process.
#[derive(Debug)]
pub enum LambdaMessage {
    /// Identity of the lambda. Sent once, first.
    Hello(Box<JournalHeader>),
    /// A wake.
    Wake {
        /// The wake.
        entry: Box<JournalEntry>,
        /// Time of the decision, in ns of `CLOCK_MONOTONIC`.
        decided_ns: i64,
        /// Number of missing wakes before it.
        missing: u32,
        /// The same wake as it was received, encoded without reference to another one. It decodes
        /// to `entry`, and nothing follows it.
        encoded: Vec<u8>,
    },
    /// The engine, in place of that in the header.
    Engine(String),
    /// The end of the connection.
    Bye,
}

/// Parses untrusted messages from one lambda's process.
pub struct LambdaLink {
    from: BufReader<UnixStream>,
    payload: Vec<u8>,
    /// Set after `Hello`.
    decoder: Option<Decoder>,
}

/// Sends replies to one lambda's process, without blocking.
#[derive(Debug)]
pub struct LambdaReplies {
    socket: UnixStream,
    /// A frame that is not sent completely.
    pending: FrameQueue,
}

impl LambdaLink {
    /// Creates both ends from the socket that the starter sent.
    ///
    /// # Errors
    ///
    /// Errors of the system, such as too many open files.
    pub fn new(socket: OwnedFd) -> io::Result<(LambdaLink, LambdaReplies)> {
        let socket = UnixStream::from(socket);
        let replies = LambdaReplies { socket: socket.try_clone()?, pending: FrameQueue::default() };
        Ok((
            LambdaLink { from: BufReader::new(socket), payload: Vec::new(), decoder: None },
            replies,
        ))
    }

    /// Waits for the next message. `None` when the lambda's process has ended.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the invalid frame; nothing can be read after it.
    pub fn receive(&mut self) -> Result<Option<LambdaMessage>, LinkError> {
        let Some(tag) = frame::read(&mut self.from, &mut self.payload, LAMBDA)? else {
            return Ok(None);
        };
        let malformed = |frame, reason| LinkError::Malformed { peer: LAMBDA, frame, reason };
        match (tag, &mut self.decoder) {
            (tag::HELLO, None) => {
                let header: JournalHeader = serde_json::from_slice(&self.payload)
                    .map_err(|error| malformed("hello", error.to_string()))?;
                let inputs = header.inputs.len();
                if inputs > INPUTS_MAX || header.event_input.is_some_and(|event| event >= inputs) {
                    return Err(malformed(
                        "hello",
                        "it has too many inputs, or lacks the one that wakes the lambda".to_owned(),
                    ));
                }
                self.decoder = Some(Decoder::new(inputs));
                Ok(Some(LambdaMessage::Hello(Box::new(header))))
            }
            (tag::WAKE, Some(decoder)) => {
                let bytes = self.payload.len();
                let parts = self.payload.split_first_chunk::<8>().and_then(|(decided, rest)| {
                    rest.split_first_chunk::<4>().map(|(missing, rest)| (decided, missing, rest))
                });
                let Some((decided, missing, encoded)) = parts else {
                    return Err(malformed("wake", format!("it has {bytes} bytes")));
                };
                let mut rest = encoded;
                decoder.reset();
                let entry = decoder
                    .decode(&mut rest)
                    .map_err(|source| LinkError::Wake { peer: LAMBDA, source })?;
                if !rest.is_empty() {
                    return Err(malformed("wake", format!("{} bytes follow the wake", rest.len())));
                }
                Ok(Some(LambdaMessage::Wake {
                    entry: Box::new(entry),
                    decided_ns: i64::from_le_bytes(*decided),
                    missing: u32::from_le_bytes(*missing),
                    encoded: encoded.to_vec(),
                }))
            }
            (tag::ENGINE, Some(_)) => match std::str::from_utf8(&self.payload) {
                Ok(engine) => Ok(Some(LambdaMessage::Engine(engine.to_owned()))),
                Err(error) => Err(malformed("engine", error.to_string())),
            },
            (tag::BYE, Some(_)) => Ok(Some(LambdaMessage::Bye)),
            (tag::HELLO, Some(_)) => {
                Err(LinkError::Unexpected { peer: LAMBDA, frame: "hello", expected: "wake" })
            }
            (tag::WAKE | tag::ENGINE | tag::BYE, None) => Err(LinkError::Unexpected {
                peer: LAMBDA,
                frame: frame::name(tag),
                expected: "hello",
            }),
            (tag, _) => Err(LinkError::Unknown { peer: LAMBDA, tag }),
        }
    }
}

impl LambdaReplies {
    /// Accepts the lambda.
    pub fn ready(&mut self) {
        self.send(tag::READY, &[]);
    }

    /// Refuses the lambda for this `reason`, which is cut if it is too long.
    pub fn refused(&mut self, reason: &str) {
        let end = reason.floor_char_boundary(REASON_MAX);
        self.send(tag::REFUSED, &reason.as_bytes()[..end]);
    }

    /// Reports that the windows of a decision are open, `wait_ns` after it.
    pub fn opened(&mut self, wait_ns: u64) {
        self.send(tag::OPENED, &wait_ns.to_le_bytes());
    }

    /// Accepts no further messages: the lambda keeps them for another recorder. Its reader gets
    /// those that were sent before, and then the end.
    pub fn accept_no_more(&self) {
        // It fails only if the other side closed it first.
        let _ = self.socket.shutdown(std::net::Shutdown::Read);
    }

    /// Closes the connection, so that its reader reaches the end.
    pub fn close(&self) {
        // It fails only if the other side closed it first.
        let _ = self.socket.shutdown(std::net::Shutdown::Both);
    }

    /// Sends a frame, or drops it if the other side does not read. Only times can be lost, as the
    /// first replies always fit.
    fn send(&mut self, tag: u8, payload: &[u8]) {
        // The reader of the connection will notice an error.
        if self.pending.flush(&self.socket, LAMBDA).is_err() {
            self.pending = FrameQueue::default();
        }
        if self.pending.is_empty() {
            self.pending.push(frame::encode(tag, payload), None);
            let _ = self.pending.flush(&self.socket, LAMBDA);
        }
    }
}
