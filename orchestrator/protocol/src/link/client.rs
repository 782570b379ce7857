//! From a lambda's process to the recorder.

use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use rustix::io::Errno;
use rustix::net::{RecvFlags, SendFlags, recv, send};

use super::LinkError;
use super::frame::{self, HEAD, tag};
use super::queue::Queue;
use crate::LinkLosses;
use gleaner_journal::{Encoder, JournalEntry, JournalHeader};

const RECORDER: &str = "the recorder";

/// Most bytes that wait for the recorder.
const WAITING: usize = 4 << 20;

/// Wakes without a trigger are sent when so many bytes wait. It is little beside [`WAITING`], and
/// much beside what comes between two calls of [`RecorderLink::poll`].
const PROMPT: usize = 16 << 10;

/// What is read of the recorder at a time: its frames are small.
const READ: usize = 4 << 10;

/// What the recorder says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RecorderMessage {
    /// It hears the lambda.
    Ready,
    /// It does not, or not any more.
    Refused(String),
    /// The windows of a decision with triggers are open: nothing that they cover is given up for
    /// its age.
    Opened {
        /// Time from the decision until then, in ns.
        wait_ns: u64,
    },
}

/// A lambda's connection to the recorder. Nothing but [`hello`](Self::hello) and [`bye`](Self::bye)
/// ever waits for it.
#[derive(Debug)]
pub struct RecorderLink {
    socket: UnixStream,
    encoder: EncoderOf,
    frame: Vec<u8>,
    queue: Queue,
    /// What is sent together. Not as slices: with what sends these, files could be sent, and a
    /// lambda's process may not.
    together: Vec<u8>,
    /// What came and is not a whole frame.
    heard: Vec<u8>,
}

/// Has no state that is worth showing.
struct EncoderOf(Encoder);

impl std::fmt::Debug for EncoderOf {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Encoder")
    }
}

impl RecorderLink {
    /// Over this socket, which the starter gave.
    pub fn new(socket: OwnedFd) -> RecorderLink {
        RecorderLink {
            socket: socket.into(),
            encoder: EncoderOf(Encoder::new(0)),
            frame: Vec::new(),
            queue: Queue::new(WAITING),
            together: Vec::new(),
            heard: Vec::new(),
        }
    }

    /// Says what the lambda is, and waits for the answer, but not longer than `patience`.
    ///
    /// # Errors
    ///
    /// [`LinkError::Refused`] if the recorder was told of another lambda, [`LinkError::Silent`] if
    /// it does not answer, and [`LinkError::Gone`] if it has ended.
    pub fn hello(&mut self, header: &JournalHeader, patience: Duration) -> Result<(), LinkError> {
        let until = Instant::now() + patience;
        let failed = |source: io::Error| LinkError::Socket { who: RECORDER, source };
        let payload = serde_json::to_vec(header).map_err(|error| failed(error.into()))?;
        if payload.len() > super::FRAME_MAX {
            return Err(LinkError::TooLong {
                who: "the lambda",
                frame: "hello",
                bytes: payload.len() as u64,
            });
        }
        self.encoder = EncoderOf(Encoder::new(header.inputs.len()));
        let hello = frame::whole(tag::HELLO, &payload);
        if let Err(error) = self.send_until(&hello, until, patience) {
            // It may have said why before it went.
            let _ = self.read(RecvFlags::DONTWAIT);
            return match self.next_said() {
                Ok(Some(RecorderMessage::Refused(why))) => Err(LinkError::Refused { why }),
                _ => Err(error),
            };
        }
        loop {
            let rest = until.saturating_duration_since(Instant::now());
            if rest.is_zero() {
                return Err(LinkError::Silent { seconds: patience.as_secs() });
            }
            self.socket.set_read_timeout(Some(rest)).map_err(failed)?;
            self.read(RecvFlags::empty())?;
            match self.next_said()? {
                Some(RecorderMessage::Ready) => return Ok(()),
                Some(RecorderMessage::Refused(why)) => return Err(LinkError::Refused { why }),
                Some(RecorderMessage::Opened { .. }) | None => {}
            }
        }
    }

    /// Tells the recorder of a wake, which was decided at `decided_monotonic_ns` of
    /// `CLOCK_MONOTONIC`.
    ///
    /// A wake with triggers or a fault goes at once, behind those that wait. Any other waits for
    /// the next of these, for 16 KiB to come together, for [`poll`](Self::poll) or for
    /// [`bye`](Self::bye): each sending wakes a thread of the recorder, which costs more than many
    /// a wake of a lambda. Call `poll` every 50 ms or so: the recorder keeps a clip open for wakes
    /// that are up to 200 ms late. What the recorder does not take waits, in 4 MiB at most; beyond
    /// that wakes are left out and counted, those without triggers first.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if something was to be sent, and the recorder has ended.
    pub fn wake(
        &mut self,
        entry: &JournalEntry,
        decided_monotonic_ns: i64,
    ) -> Result<(), LinkError> {
        let mut bytes = std::mem::take(&mut self.frame);
        frame::open(tag::WAKE, &mut bytes);
        bytes.extend_from_slice(&decided_monotonic_ns.to_le_bytes());
        bytes.extend_from_slice(&0_u32.to_le_bytes());
        // Each is whole, as others may be left out.
        self.encoder.0.reset();
        self.encoder.0.encode(entry, &mut bytes);
        let triggers = entry.triggers.len();
        if frame::close(&mut bytes) {
            self.queue.push(&bytes, triggers);
        } else {
            self.queue.leave_out(triggers);
        }
        self.frame = bytes;
        let is_prompt = triggers > 0 || entry.fault.is_some() || self.queue.bytes() > PROMPT;
        if is_prompt { self.flush() } else { Ok(()) }
    }

    /// Sends what waits, and returns what the recorder said.
    ///
    /// # Errors
    ///
    /// [`LinkError::Gone`] if it has ended; [`LinkError`] if it says what makes no sense.
    pub fn poll(&mut self) -> Result<Vec<RecorderMessage>, LinkError> {
        self.flush()?;
        self.read(RecvFlags::DONTWAIT)?;
        let mut all = Vec::new();
        while let Some(said) = self.next_said()? {
            all.push(said);
        }
        Ok(all)
    }

    /// Wakes and triggers that could not be told.
    pub fn dropped(&self) -> LinkLosses {
        LinkLosses {
            wakes_dropped: self.queue.wakes_dropped,
            triggers_lost: self.queue.triggers_lost,
        }
    }

    /// Says that nothing more comes, after all that waits, but gives up after `patience`. Returns
    /// what could not be told.
    pub fn bye(mut self, patience: Duration) -> LinkLosses {
        let until = Instant::now() + patience;
        while let Some(next) = self.queue.next().map(<[u8]>::to_vec) {
            if self.send_until(&next, until, patience).is_err() {
                self.queue.give_up();
                return self.dropped();
            }
            self.queue.sent(next.len());
        }
        let _ = self.send_until(&frame::whole(tag::BYE, &[]), until, patience);
        self.dropped()
    }

    fn flush(&mut self) -> Result<(), LinkError> {
        while self.queue.bytes() > 0 {
            self.queue.together(&mut self.together);
            match send(&self.socket, &self.together, SendFlags::DONTWAIT | SendFlags::NOSIGNAL) {
                Ok(sent) => self.queue.sent(sent),
                Err(Errno::AGAIN) => return Ok(()),
                Err(Errno::INTR) => {}
                Err(error) => return Err(LinkError::of(RECORDER, error)),
            }
        }
        Ok(())
    }

    fn send_until(
        &self,
        mut bytes: &[u8],
        until: Instant,
        patience: Duration,
    ) -> Result<(), LinkError> {
        while !bytes.is_empty() {
            let rest = until.saturating_duration_since(Instant::now());
            if rest.is_zero() {
                return Err(LinkError::Silent { seconds: patience.as_secs() });
            }
            self.socket
                .set_write_timeout(Some(rest))
                .map_err(|source| LinkError::Socket { who: RECORDER, source })?;
            match send(&self.socket, bytes, SendFlags::NOSIGNAL) {
                Ok(sent) => bytes = &bytes[sent..],
                Err(Errno::INTR | Errno::AGAIN) => {}
                Err(error) => return Err(LinkError::of(RECORDER, error)),
            }
        }
        Ok(())
    }

    /// Reads what is there.
    fn read(&mut self, flags: RecvFlags) -> Result<(), LinkError> {
        let mut buffer = [0; READ];
        match recv(&self.socket, &mut buffer, flags) {
            Ok((_, 0)) => Err(LinkError::Gone { who: RECORDER }),
            Ok((_, read)) => {
                self.heard.extend_from_slice(&buffer[..read]);
                Ok(())
            }
            Err(Errno::AGAIN | Errno::INTR) => Ok(()),
            Err(error) => Err(LinkError::of(RECORDER, error)),
        }
    }

    /// The next whole frame of those that came.
    fn next_said(&mut self) -> Result<Option<RecorderMessage>, LinkError> {
        let Some(bytes) = self.heard.first_chunk::<HEAD>() else { return Ok(None) };
        let (tag, len) = frame::head(*bytes, RECORDER)?;
        if len > READ {
            let why = format!("it has {len} bytes, above the maximum of {READ}");
            return Err(LinkError::Malformed { who: RECORDER, frame: frame::name(tag), why });
        }
        let Some(payload) = self.heard.get(HEAD..HEAD + len) else { return Ok(None) };
        let said = match tag {
            tag::READY => RecorderMessage::Ready,
            tag::REFUSED => {
                RecorderMessage::Refused(gleaner_base::visible(&String::from_utf8_lossy(payload)))
            }
            tag::OPENED => {
                let wait = payload.try_into().map_err(|_| LinkError::Malformed {
                    who: RECORDER,
                    frame: "opened",
                    why: format!("it has {len} bytes instead of 8"),
                })?;
                RecorderMessage::Opened { wait_ns: u64::from_le_bytes(wait) }
            }
            tag => return Err(LinkError::Unknown { who: RECORDER, tag }),
        };
        self.heard.drain(..HEAD + len);
        Ok(Some(said))
    }
}
