//! The lambda's end of the connection to the recorder.

use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::net::{RecvFlags, SendFlags, recv, send};

use super::LinkError;
use super::frame::{self, HEAD, tag};
use super::outgoing::FrameQueue;
use super::queue::Queue;
use crate::LinkLosses;
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

/// A lambda's connection to the recorder. Only [`hello`](Self::hello) and [`bye`](Self::bye) block.
#[derive(Debug)]
pub struct RecorderLink {
    socket: UnixStream,
    encoder: OpaqueEncoder,
    frame: Vec<u8>,
    queue: Queue,
    /// Engines that are not sent yet.
    engines: FrameQueue,
    /// Frames sent together. They are copied, as sending slices needs `sendmsg`, which can also
    /// send files and is forbidden to a lambda's process.
    batch: Vec<u8>,
    /// Received bytes of an incomplete frame.
    received: Vec<u8>,
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
            encoder: OpaqueEncoder(Encoder::new(0)),
            frame: Vec::new(),
            queue: Queue::new(QUEUE_BYTES),
            engines: FrameQueue::default(),
            batch: Vec::new(),
            received: Vec::new(),
        }
    }

    /// Sends the identity of the lambda, and waits for the reply up to `timeout`.
    ///
    /// # Errors
    ///
    /// [`LinkError::Refused`] if the recorder expects another lambda, [`LinkError::Silent`] if it
    /// does not respond, and [`LinkError::Gone`] if it has ended.
    pub fn hello(&mut self, header: &JournalHeader, timeout: Duration) -> Result<(), LinkError> {
        let until = Instant::now() + timeout;
        let failed = |source: io::Error| LinkError::Socket { peer: RECORDER, source };
        let payload = serde_json::to_vec(header).map_err(|error| failed(error.into()))?;
        if payload.len() > super::FRAME_MAX {
            return Err(LinkError::TooLong {
                peer: "the lambda",
                frame: "hello",
                bytes: payload.len() as u64,
                max: super::FRAME_MAX,
            });
        }
        self.encoder = OpaqueEncoder(Encoder::new(header.inputs.len()));
        let hello = frame::encode(tag::HELLO, &payload);
        if let Err(error) = self.send_until(&hello, until, timeout) {
            // It may have sent a reason before it closed the connection.
            let _ = self.read(RecvFlags::DONTWAIT);
            return match self.next_message() {
                Ok(Some(RecorderMessage::Refused(reason))) => Err(LinkError::Refused { reason }),
                _ => Err(error),
            };
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
    /// [`LinkError::Gone`] if it had to send, and the recorder has ended.
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
        if is_urgent { self.flush() } else { Ok(()) }
    }

    /// Queues a new engine, in place of that in the header. Wakes may overtake it.
    pub fn engine(&mut self, engine: &str) {
        self.engines.push(frame::encode(tag::ENGINE, engine.as_bytes()), None);
    }

    /// Sends queued wakes, and returns received messages.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if the recorder has ended; [`LinkError`] for an invalid message.
    pub fn poll(&mut self) -> Result<Vec<RecorderMessage>, LinkError> {
        self.flush()?;
        self.read(RecvFlags::DONTWAIT)?;
        let mut all = Vec::new();
        while let Some(message) = self.next_message()? {
            all.push(message);
        }
        Ok(all)
    }

    /// Returns the number of wakes and triggers that could not be sent.
    pub fn dropped(&self) -> LinkLosses {
        LinkLosses {
            wakes_dropped: self.queue.wakes_dropped,
            triggers_lost: self.queue.triggers_lost,
        }
    }

    /// Sends queued wakes and the end of the connection, up to `timeout`. Returns the losses.
    pub fn bye(mut self, timeout: Duration) -> LinkLosses {
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

    /// Reads available bytes.
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

    /// Returns the next complete message, if any.
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
