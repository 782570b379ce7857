//! The lambda's end of the connection to the recorder.

use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::net::sockopt::socket_domain;
use rustix::net::{AddressFamily, RecvFlags, SendFlags, recv, send};

use super::LinkError;
use super::frame::{self, HEAD, tag};
use super::outgoing::FrameQueue;
use super::queue::Queue;
use crate::counts::LinkLosses;
use gleaner_journal::{Encoder, JournalEntry, JournalHeader};

const RECORDER: &str = "the recorder";

/// Maximum length of the queue, in bytes.
const QUEUE_BYTES: usize = 4 << 20;

/// Number of queued bytes at which wakes without a trigger are sent: far less than [`QUEUE_BYTES`];
/// usually much more than arrives between two calls of [`RecorderLink::poll`].
const SEND_BYTES: usize = 16 << 10;

/// Number of bytes read at a time: frames of the recorder are small.
const READ: usize = 4 << 10;

/// A message from the recorder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RecorderMessage {
    /// The recorder accepts the lambda.
    Ready,
    /// The recorder refuses the lambda, from the start or later.
    Refused(String),
    /// The windows of a decision with triggers are open: data that they cover is no longer dropped
    /// for its age.
    Opened {
        /// Time from the decision until then, in ns.
        wait_ns: u64,
    },
}

/// A lambda's connection to the recorder, and after a restart of the recorder to the next one. Only
/// [`hello`](Self::hello) and [`bye`](Self::bye) block.
#[derive(Debug)]
pub struct RecorderLink {
    socket: UnixStream,
    state: LinkState,
    /// The identity of the lambda, while it is sent again.
    hello: FrameQueue,
    encoder: OpaqueEncoder,
    frame: Vec<u8>,
    queue: Queue,
    /// Engines that are not sent yet.
    engines: FrameQueue,
    /// Frames sent together. They are copied, as sending slices needs `sendmsg`, which can also
    /// send files and is forbidden to a lambda's process.
    batch: Vec<u8>,
    received: Vec<u8>,
    /// Number of recorders that have ended.
    ends: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum LinkState {
    /// The recorder accepts wakes.
    Joined,
    /// It was sent the identity of the lambda, and has not replied.
    Joining,
    /// It has ended: wakes are queued for the next one.
    Gone,
}

/// Implements `Debug` without the state of the encoder.
struct OpaqueEncoder(Encoder);

impl std::fmt::Debug for OpaqueEncoder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Encoder")
    }
}

impl RecorderLink {
    /// Creates the link from the socket that the starter passed.
    pub fn new(socket: OwnedFd) -> RecorderLink {
        RecorderLink {
            socket: socket.into(),
            state: LinkState::Joined,
            hello: FrameQueue::default(),
            encoder: OpaqueEncoder(Encoder::new(0)),
            frame: Vec::new(),
            queue: Queue::new(QUEUE_BYTES),
            engines: FrameQueue::default(),
            batch: Vec::new(),
            received: Vec::new(),
            ends: 0,
        }
    }

    /// Sends the identity of the lambda, and waits for the reply up to `timeout`.
    ///
    /// # Errors
    ///
    /// [`LinkError::Refused`] if the recorder expects another lambda, [`LinkError::Silent`] if it
    /// does not respond, and [`LinkError::Gone`] if it has ended. After an error, wakes are queued
    /// until [`rejoin`](Self::rejoin).
    pub fn hello(&mut self, header: &JournalHeader, timeout: Duration) -> Result<(), LinkError> {
        let joined = self.join(header, timeout);
        if joined.is_err() {
            self.state = LinkState::Gone;
        }
        joined
    }

    fn join(&mut self, header: &JournalHeader, timeout: Duration) -> Result<(), LinkError> {
        let until = Instant::now() + timeout;
        let failed = |source: io::Error| LinkError::Socket { peer: RECORDER, source };
        let family = socket_domain(&self.socket).map_err(|error| failed(error.into()))?;
        if family != AddressFamily::UNIX {
            return Err(failed(io::Error::other("it is not a Unix socket")));
        }
        let hello = encode_hello(header)?;
        self.encoder = OpaqueEncoder(Encoder::new(header.inputs.len()));
        if let Err(error) = self.send_until(&hello, until, timeout) {
            return Err(self.refusal().unwrap_or(error));
        }
        loop {
            let remaining = until.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return Err(LinkError::Silent { seconds: timeout.as_secs() });
            }
            self.socket.set_read_timeout(Some(remaining)).map_err(failed)?;
            self.read(RecvFlags::empty())?;
            match self.next_message()? {
                Some(RecorderMessage::Ready) => return Ok(()),
                Some(RecorderMessage::Refused(reason)) => {
                    return Err(LinkError::Refused { reason });
                }
                Some(RecorderMessage::Opened { .. }) | None => {}
            }
        }
    }

    /// Continues with the next recorder, over `socket`: sends the identity of the lambda, and after
    /// the reply the queued wakes. Never waits: [`poll`](Self::poll) returns the reply.
    ///
    /// # Errors
    ///
    /// [`LinkError::TooLong`] for a header that is too long.
    pub fn rejoin(&mut self, socket: OwnedFd, header: &JournalHeader) -> Result<(), LinkError> {
        let hello = encode_hello(header)?;
        self.socket = socket.into();
        self.state = LinkState::Joining;
        self.hello = FrameQueue::default();
        self.hello.push(hello, None);
        // It is in the header.
        self.engines = FrameQueue::default();
        self.received.clear();
        self.queue.send_again();
        Ok(())
    }

    /// Returns false while the recorder has ended, and no other one has accepted the lambda.
    pub fn is_joined(&self) -> bool {
        self.state == LinkState::Joined
    }

    /// Returns the refusal that the recorder may have sent before it closed the connection.
    fn refusal(&mut self) -> Option<LinkError> {
        let _ = self.read(RecvFlags::DONTWAIT);
        while let Ok(Some(message)) = self.next_message() {
            if let RecorderMessage::Refused(reason) = message {
                return Some(LinkError::Refused { reason });
            }
        }
        None
    }

    /// Queues a wake, which was decided at `decided_monotonic_ns` of `CLOCK_MONOTONIC`.
    ///
    /// A wake with triggers or a fault is sent at once, after those queued before. Other wakes are
    /// sent with the next of these, at 16 KiB, by [`poll`](Self::poll) or by [`bye`](Self::bye):
    /// each call of `send` wakes a thread of the recorder, which costs more than many a wake of a
    /// lambda. Call `poll` about every 50 ms: the recorder keeps a clip open for wakes that are up
    /// to 200 ms late. The queue has at most 4 MiB; beyond that, wakes are dropped and counted,
    /// those without triggers first.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if it had to send, and the recorder has ended; [`LinkError::Refused`] if
    /// it has refused the lambda. The wake stays in the queue, as do further ones, without an
    /// error, until [`rejoin`](Self::rejoin).
    pub fn wake(
        &mut self,
        entry: &JournalEntry,
        decided_monotonic_ns: i64,
    ) -> Result<(), LinkError> {
        let mut bytes = std::mem::take(&mut self.frame);
        frame::open(tag::WAKE, &mut bytes);
        bytes.extend_from_slice(&decided_monotonic_ns.to_le_bytes());
        bytes.extend_from_slice(&0_u32.to_le_bytes());
        // Each wake is encoded alone, as others may be dropped.
        self.encoder.0.reset();
        self.encoder.0.encode(entry, &mut bytes);
        let triggers = entry.triggers.len();
        if frame::close(&mut bytes) {
            self.queue.push(&bytes, triggers);
        } else {
            self.queue.count_dropped(triggers);
        }
        self.frame = bytes;
        let is_urgent = triggers > 0 || entry.fault.is_some() || self.queue.bytes() > SEND_BYTES;
        let sent = if is_urgent { self.flush() } else { Ok(()) };
        sent.map_err(|error| self.ended(error))
    }

    /// Queues a new engine, in place of that in the header. Wakes may overtake it.
    pub fn engine(&mut self, engine: &str) {
        self.engines.push(frame::encode(tag::ENGINE, engine.as_bytes()), None);
    }

    /// Sends queued wakes, and returns received messages.
    ///
    /// # Errors
    ///
    /// Those of [`wake`](Self::wake); [`LinkError`] for an invalid message.
    pub fn poll(&mut self) -> Result<Vec<RecorderMessage>, LinkError> {
        let mut all = Vec::new();
        if self.state == LinkState::Gone {
            return Ok(all);
        }
        let received = self.flush().and_then(|()| self.read(RecvFlags::DONTWAIT));
        received.map_err(|error| self.ended(error))?;
        while let Some(message) = self.next_message()? {
            if message == RecorderMessage::Ready {
                self.state = LinkState::Joined;
            }
            all.push(message);
        }
        Ok(all)
    }

    /// Notes that the recorder has ended; returns the error to report.
    fn ended(&mut self, error: LinkError) -> LinkError {
        self.state = LinkState::Gone;
        self.ends += 1;
        self.refusal().unwrap_or(error)
    }

    /// Drops the queued wakes, and counts them as lost: there is no recorder for them.
    pub fn drop_queued(&mut self) {
        self.queue.drop_all();
    }

    /// Returns the wakes and triggers that could not be sent, and the number of recorders that
    /// ended.
    pub fn dropped(&self) -> LinkLosses {
        LinkLosses {
            wakes_dropped: self.queue.wakes_dropped,
            triggers_lost: self.queue.triggers_lost,
            recorders_ended: self.ends,
            absent_s: 0,
        }
    }

    /// Sends queued wakes and the end of the connection, up to `timeout`. Returns the losses.
    pub fn bye(mut self, timeout: Duration) -> LinkLosses {
        if self.state != LinkState::Joined {
            self.queue.drop_all();
            return self.dropped();
        }
        let until = Instant::now() + timeout;
        let (is_begun, engines) = (self.engines.is_begun(), self.engines.take_rest());
        if is_begun && self.send_until(&engines, until, timeout).is_err() {
            self.queue.drop_all();
            return self.dropped();
        }
        while let Some(next) = self.queue.next().map(<[u8]>::to_vec) {
            if self.send_until(&next, until, timeout).is_err() {
                self.queue.drop_all();
                return self.dropped();
            }
            self.queue.sent(next.len());
        }
        let mut last = if is_begun { Vec::new() } else { engines };
        last.extend(frame::encode(tag::BYE, &[]));
        let _ = self.send_until(&last, until, timeout);
        self.dropped()
    }

    fn flush(&mut self) -> Result<(), LinkError> {
        match self.state {
            LinkState::Joined => {}
            LinkState::Joining => return self.hello.flush(&self.socket, RECORDER),
            LinkState::Gone => return Ok(()),
        }
        if self.engines.is_begun() {
            self.engines.flush(&self.socket, RECORDER)?;
            if self.engines.is_begun() {
                return Ok(());
            }
        }
        while self.queue.bytes() > 0 {
            self.queue.next_batch(&mut self.batch);
            match send(&self.socket, &self.batch, SendFlags::DONTWAIT | SendFlags::NOSIGNAL) {
                Ok(sent) => self.queue.sent(sent),
                Err(Errno::AGAIN) => return Ok(()),
                Err(Errno::INTR) => {}
                Err(error) => return Err(LinkError::of(RECORDER, error)),
            }
        }
        self.engines.flush(&self.socket, RECORDER)
    }

    fn send_until(
        &self,
        mut bytes: &[u8],
        until: Instant,
        timeout: Duration,
    ) -> Result<(), LinkError> {
        while !bytes.is_empty() {
            let remaining = until.saturating_duration_since(Instant::now());
            if remaining.is_zero() {
                return Err(LinkError::Silent { seconds: timeout.as_secs() });
            }
            self.socket
                .set_write_timeout(Some(remaining))
                .map_err(|source| LinkError::Socket { peer: RECORDER, source })?;
            match send(&self.socket, bytes, SendFlags::NOSIGNAL) {
                Ok(sent) => bytes = &bytes[sent..],
                Err(Errno::INTR | Errno::AGAIN) => {}
                Err(error) => return Err(LinkError::of(RECORDER, error)),
            }
        }
        Ok(())
    }

    fn read(&mut self, flags: RecvFlags) -> Result<(), LinkError> {
        let mut buffer = [0; READ];
        match recv(&self.socket, &mut buffer, flags) {
            Ok((_, 0)) => Err(LinkError::Gone { peer: RECORDER }),
            Ok((_, read)) => {
                self.received.extend_from_slice(&buffer[..read]);
                Ok(())
            }
            Err(Errno::AGAIN | Errno::INTR) => Ok(()),
            Err(error) => Err(LinkError::of(RECORDER, error)),
        }
    }

    fn next_message(&mut self) -> Result<Option<RecorderMessage>, LinkError> {
        let Some(bytes) = self.received.first_chunk::<HEAD>() else { return Ok(None) };
        let (tag, len) = frame::head(*bytes, RECORDER)?;
        if len > READ {
            let reason = format!("it has {len} bytes, above the maximum of {READ}");
            return Err(LinkError::Malformed { peer: RECORDER, frame: frame::name(tag), reason });
        }
        let Some(payload) = self.received.get(HEAD..HEAD + len) else { return Ok(None) };
        let message = match tag {
            tag::READY => RecorderMessage::Ready,
            tag::REFUSED => {
                RecorderMessage::Refused(gleaner_base::visible(&String::from_utf8_lossy(payload)))
            }
            tag::OPENED => {
                let wait = payload.try_into().map_err(|_| LinkError::Malformed {
                    peer: RECORDER,
                    frame: "opened",
                    reason: format!("it has {len} bytes instead of 8"),
                })?;
                RecorderMessage::Opened { wait_ns: u64::from_le_bytes(wait) }
            }
            tag => return Err(LinkError::Unknown { peer: RECORDER, tag }),
        };
        self.received.drain(..HEAD + len);
        Ok(Some(message))
    }
}

fn encode_hello(header: &JournalHeader) -> Result<Vec<u8>, LinkError> {
    frame::encode_json(tag::HELLO, header, "the lambda", RECORDER)
}
