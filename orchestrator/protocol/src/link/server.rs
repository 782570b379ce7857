//! The recorder's end of a lambda's connection.

use std::io::{self, BufReader};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;

use rustix::io::Errno;
use rustix::net::{SendFlags, send};

use super::LinkError;
use super::frame::{self, tag};
use gleaner_journal::{Decoder, INPUTS_MAX, JournalEntry, JournalHeader};

const LAMBDA: &str = "the lambda";

/// Most bytes of a refusal.
const WHY_MAX: usize = 2 << 10;

/// What a lambda's process says.
#[derive(Debug)]
pub enum LambdaMessage {
    /// What it is. First, once.
    Hello(Box<JournalHeader>),
    /// It was woken.
    Wake {
        /// The wake.
        entry: Box<JournalEntry>,
        /// When it was decided, in ns of `CLOCK_MONOTONIC`.
        decided_ns: i64,
        /// Wakes that are missing before it.
        missing: u32,
        /// How long the frame was.
        bytes: usize,
    },
    /// Nothing more comes.
    Bye,
}

/// Reads what one lambda's process says; nothing of it is believed.
pub struct LambdaLink {
    from: BufReader<UnixStream>,
    payload: Vec<u8>,
    /// Once it has said what it is.
    decoder: Option<Decoder>,
}

/// Answers to one lambda's process, without ever waiting for it.
#[derive(Debug)]
pub struct LambdaReplies {
    socket: UnixStream,
    /// The rest of a frame that is partly sent.
    rest: Vec<u8>,
}

impl LambdaLink {
    /// Over this socket, which the starter gave.
    ///
    /// # Errors
    ///
    /// What the system says: too many open files.
    pub fn new(socket: OwnedFd) -> io::Result<(LambdaLink, LambdaReplies)> {
        let socket = UnixStream::from(socket);
        let answers = LambdaReplies { socket: socket.try_clone()?, rest: Vec::new() };
        Ok((
            LambdaLink { from: BufReader::new(socket), payload: Vec::new(), decoder: None },
            answers,
        ))
    }

    /// What it says next; waits for it. `None` when its process has ended.
    ///
    /// # Errors
    ///
    /// [`LinkError`] names the frame that makes no sense; nothing can be read after it.
    pub fn hear(&mut self) -> Result<Option<LambdaMessage>, LinkError> {
        let Some(tag) = frame::read(&mut self.from, &mut self.payload, LAMBDA)? else {
            return Ok(None);
        };
        let malformed = |frame, why| LinkError::Malformed { who: LAMBDA, frame, why };
        match (tag, &mut self.decoder) {
            (tag::HELLO, None) => {
                let header: JournalHeader = serde_json::from_slice(&self.payload)
                    .map_err(|error| malformed("hello", error.to_string()))?;
                let inputs = header.inputs.len();
                if inputs > INPUTS_MAX || header.event_input.is_some_and(|event| event >= inputs) {
                    return Err(malformed(
                        "hello",
                        "its inputs are more than there may be, or not there".to_owned(),
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
                let Some((decided, missing, mut rest)) = parts else {
                    return Err(malformed("wake", format!("it has {bytes} bytes")));
                };
                decoder.reset();
                let entry = decoder
                    .decode(&mut rest)
                    .map_err(|source| LinkError::Wake { who: LAMBDA, source })?;
                if !rest.is_empty() {
                    return Err(malformed("wake", format!("{} bytes follow the wake", rest.len())));
                }
                Ok(Some(LambdaMessage::Wake {
                    entry: Box::new(entry),
                    decided_ns: i64::from_le_bytes(*decided),
                    missing: u32::from_le_bytes(*missing),
                    bytes,
                }))
            }
            (tag::BYE, Some(_)) => Ok(Some(LambdaMessage::Bye)),
            (tag::HELLO, Some(_)) => {
                Err(LinkError::Unexpected { who: LAMBDA, frame: "hello", due: "wake" })
            }
            (tag::WAKE | tag::BYE, None) => {
                Err(LinkError::Unexpected { who: LAMBDA, frame: frame::name(tag), due: "hello" })
            }
            (tag, _) => Err(LinkError::Unknown { who: LAMBDA, tag }),
        }
    }
}

impl LambdaReplies {
    /// The lambda is heard from now on.
    pub fn ready(&mut self) {
        self.send(tag::READY, &[]);
    }

    /// The lambda is not heard. Whoever reads it needs not wait for its end.
    pub fn refused(&mut self, why: &str) {
        let end =
            (0..=WHY_MAX.min(why.len())).rev().find(|end| why.is_char_boundary(*end)).unwrap_or(0);
        self.send(tag::REFUSED, &why.as_bytes()[..end]);
    }

    /// The windows of a decision are open, so long after it.
    pub fn opened(&mut self, wait_ns: u64) {
        self.send(tag::OPENED, &wait_ns.to_le_bytes());
    }

    /// Closes the connection from this side, so that its reader comes to the end.
    pub fn close(&self) {
        // It fails only where the other side was faster.
        let _ = self.socket.shutdown(std::net::Shutdown::Both);
    }

    /// Sends a frame, unless the other side does not read: then it is left out. Nothing but times
    /// is lost by that, as the first answers fit in any case.
    fn send(&mut self, tag: u8, payload: &[u8]) {
        let pending = std::mem::take(&mut self.rest);
        self.rest = self.try_send(pending);
        if self.rest.is_empty() {
            self.rest = self.try_send(frame::whole(tag, payload));
        }
    }

    /// What of `bytes` could not be sent.
    fn try_send(&self, mut bytes: Vec<u8>) -> Vec<u8> {
        while !bytes.is_empty() {
            match send(&self.socket, &bytes, SendFlags::DONTWAIT | SendFlags::NOSIGNAL) {
                Ok(sent) => drop(bytes.drain(..sent)),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => break,
                // Its reader will notice.
                Err(_) => bytes.clear(),
            }
        }
        bytes
    }
}
