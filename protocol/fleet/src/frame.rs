//! Frames of the control channel: protobuf, one in each binary message of the WebSocket.

use std::cell::RefCell;
use std::io::{self, Read};

use prost::Message;
use sha2::{Digest, Sha256};
use zstd::bulk::Decompressor;

use crate::problem::WantedProblem;

thread_local! {
    /// Decompresses parts one after the other in the same memory. Between what lives as long as a
    /// connection, that of each part would keep the heap of a cloud at twice of what is in use.
    static DECOMPRESSOR: RefCell<Option<Decompressor<'static>>> =
        RefCell::new(Decompressor::new().ok());
}

/// Version of the channel. A cloud refuses vehicles of another one.
pub const PROTOCOL: u32 = 1;

/// Maximum length of a frame. Envelopes and files are fetched by HTTPS instead.
pub const FRAME_MAX: usize = 1 << 20;

/// Maximum length of lines and of a status once they are decompressed.
pub const LINES_MAX: u64 = 8 << 20;

/// Maximum number of records in a frame.
pub const RECORDS_MAX: usize = 4000;

/// Longest lease of streams that people read, in s; a cloud renews it in time.
pub const TAIL_S: u32 = 60;

/// Name in a lease of the vehicle's status, which it reports each second then.
pub const STATUS_STREAM: &str = "status";

/// Maximum number of streams in a lease.
pub const TAIL_STREAMS_MAX: usize = 64;

/// Maximum length of the name of a stream, in bytes.
pub const STREAM_NAME_MAX: usize = 256;

/// Maximum number of deployments in a desired state.
pub const WANTED_MAX: usize = 4000;

/// A frame.
#[derive(Clone, PartialEq, Message)]
pub struct Frame {
    /// Its content; absent in a frame of a later version, which is skipped.
    #[prost(oneof = "Body", tags = "1, 2, 3, 4, 5, 6, 7, 8, 9, 10")]
    pub body: Option<Body>,
}

/// The content of a frame.
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum Body {
    /// Vehicle to cloud: the first frame.
    #[prost(message, tag = "1")]
    Hello(Hello),
    /// Cloud to vehicle: the answer to `Hello`.
    #[prost(message, tag = "2")]
    Welcome(Welcome),
    /// Cloud to vehicle: the complete desired state.
    #[prost(message, tag = "3")]
    Desired(Desired),
    /// Vehicle to cloud: its status.
    #[prost(message, tag = "4")]
    Reported(Reported),
    /// Vehicle to cloud: records of a stream.
    #[prost(message, tag = "5")]
    Records(Records),
    /// Cloud to vehicle: records are durable.
    #[prost(message, tag = "6")]
    Ack(Ack),
    /// Both: a sign of life, which the other side returns as `Pong`.
    #[prost(message, tag = "7")]
    Ping(Ping),
    /// Both: the answer to `Ping`.
    #[prost(message, tag = "8")]
    Pong(Pong),
    /// Cloud to vehicle: the connection ends.
    #[prost(message, tag = "9")]
    GoAway(GoAway),
    /// Cloud to vehicle: streams that people read as they come.
    #[prost(message, tag = "10")]
    Tail(Tail),
}

/// The first frame of a vehicle. Its name is that of its certificate.
#[derive(Clone, PartialEq, Message)]
pub struct Hello {
    /// Version of the channel, [`PROTOCOL`].
    #[prost(uint32, tag = "1")]
    pub protocol: u32,
    /// Version of the orchestrator.
    #[prost(string, tag = "2")]
    pub version: String,
    /// Public key that verifies its clips.
    #[prost(string, tag = "3")]
    pub key: String,
    /// Number of the newest desired state of this cloud that it has received, also of one that it
    /// could not apply: a cloud that has never sent this one was restored from a backup.
    #[prost(uint64, tag = "4")]
    pub followed: u64,
    /// Boot of its machine, as 32 hexadecimal digits: a machine never comes back to a former one.
    #[prost(string, tag = "5")]
    pub boot: String,
}

/// The answer to [`Hello`].
#[derive(Clone, PartialEq, Message)]
pub struct Welcome {
    /// Number of the connection: only the one with the highest of a vehicle counts.
    #[prost(uint64, tag = "1")]
    pub epoch: u64,
    /// Time of the cloud, in ms since 1970: a hint.
    #[prost(int64, tag = "2")]
    pub time_ms: i64,
    /// Interval of signs of life, in s. A side that receives nothing for three of them closes the
    /// connection.
    #[prost(uint32, tag = "3")]
    pub ping_s: u32,
    /// Records of each stream that are durable in the cloud.
    #[prost(message, repeated, tag = "4")]
    pub cursors: Vec<Cursor>,
}

/// The last durable record of a stream.
#[derive(Clone, PartialEq, Message)]
pub struct Cursor {
    /// Name of the stream: `events`, `orchestrator`, or `lambdas/ID`.
    #[prost(string, tag = "1")]
    pub stream: String,
    /// Number of the life of the stream: a vehicle that has lost its records begins another one.
    #[prost(uint64, tag = "2")]
    pub life: u64,
    /// Number of the next record.
    #[prost(uint64, tag = "3")]
    pub next: u64,
    /// Number of the last record that is not a gap, by which the vehicle checks that the stream is
    /// still the same.
    #[prost(uint64, tag = "4")]
    pub seq: u64,
    /// Boot of that record, as 32 hexadecimal digits; empty if there is none.
    #[prost(string, tag = "5")]
    pub boot: String,
    /// Time of that record since its boot, in ns.
    #[prost(uint64, tag = "6")]
    pub boot_ns: u64,
}

/// The complete desired state of a vehicle, as far as the cloud manages it. What was deployed
/// locally stays.
#[derive(Clone, PartialEq, Message)]
pub struct Desired {
    /// Number of the state: it grows with each change.
    #[prost(uint64, tag = "1")]
    pub generation: u64,
    /// All deployments, by id.
    #[prost(message, repeated, tag = "2")]
    pub deployments: Vec<Wanted>,
    /// True if nothing is to be stopped or removed: the cloud is older than what the vehicle has
    /// followed, and no person has agreed to its state yet.
    #[prost(bool, tag = "3")]
    pub keeps: bool,
}

/// A wanted deployment.
#[derive(Clone, PartialEq, Message)]
pub struct Wanted {
    /// Its id.
    #[prost(string, tag = "1")]
    pub id: String,
    /// SHA-256 of its signed envelope, in hexadecimal digits.
    #[prost(string, tag = "2")]
    pub envelope: String,
    /// False if it is to be stopped.
    #[prost(bool, tag = "3")]
    pub is_wanted: bool,
    /// Number of the request to run its fallback; 0 without one. A vehicle follows each request
    /// once.
    #[prost(uint64, tag = "4")]
    pub rollback: u64,
    /// Number of the request to start it again, also after a quarantine; 0 without one. A vehicle
    /// follows each request once, and leaves a lambda alone that runs.
    #[prost(uint64, tag = "5")]
    pub start: u64,
}

/// The status of a vehicle.
#[derive(Clone, PartialEq, Message)]
pub struct Reported {
    /// Number of the newest desired state that it has applied.
    #[prost(uint64, tag = "1")]
    pub generation: u64,
    /// Its status as JSON, compressed by [`compress`].
    #[prost(bytes = "vec", tag = "2")]
    pub status: Vec<u8>,
    /// The reasons why parts of the desired state are not applied.
    #[prost(message, repeated, tag = "4")]
    pub problems: Vec<WantedProblem>,
}

/// Records of a stream.
#[derive(Clone, PartialEq, Message)]
pub struct Records {
    /// Name of the stream, as in [`Cursor`].
    #[prost(string, tag = "1")]
    pub stream: String,
    /// Number of the stream's life.
    #[prost(uint64, tag = "2")]
    pub life: u64,
    /// Number of the record after the last one of these.
    #[prost(uint64, tag = "3")]
    pub next: u64,
    /// The records: lines of JSON as of `GET /v1/events`, compressed by [`compress`].
    #[prost(bytes = "vec", tag = "4")]
    pub lines: Vec<u8>,
}

/// All records of a stream before `next` are durable.
#[derive(Clone, PartialEq, Message)]
pub struct Ack {
    /// Name of the stream.
    #[prost(string, tag = "1")]
    pub stream: String,
    /// Number of the stream's life.
    #[prost(uint64, tag = "2")]
    pub life: u64,
    /// Number of the next record.
    #[prost(uint64, tag = "3")]
    pub next: u64,
}

/// A sign of life.
#[derive(Clone, PartialEq, Message)]
pub struct Ping {
    /// Any number.
    #[prost(uint64, tag = "1")]
    pub number: u64,
}

/// The answer to a [`Ping`].
#[derive(Clone, PartialEq, Message)]
pub struct Pong {
    /// The number of the ping.
    #[prost(uint64, tag = "1")]
    pub number: u64,
}

/// The end of a connection.
#[derive(Clone, PartialEq, Message)]
pub struct GoAway {
    /// Time after which the vehicle may connect again, in ms.
    #[prost(uint64, tag = "1")]
    pub after_ms: u64,
    /// The reason.
    #[prost(string, tag = "2")]
    pub reason: String,
}

/// Streams of which people read each record as it comes: a lease, in the place of the one before.
/// It changes the speed of records only; without one, a vehicle collects log lines for a while.
#[derive(Clone, PartialEq, Message)]
pub struct Tail {
    /// Names of the streams, as in [`Cursor`]; at most [`TAIL_STREAMS_MAX`] count.
    #[prost(string, repeated, tag = "1")]
    pub streams: Vec<String>,
    /// Time until the end of the lease, in s; at most [`TAIL_S`] count.
    #[prost(uint32, tag = "2")]
    pub seconds: u32,
}

/// A frame that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// It is too long.
    #[error("a frame has {bytes} bytes, above the maximum of {FRAME_MAX}")]
    TooLong {
        /// Its length.
        bytes: usize,
    },
    /// It is no protobuf of this type.
    #[error("a frame cannot be decoded: {reason}")]
    Malformed {
        /// The reason.
        reason: String,
    },
    /// Its compressed part cannot be used.
    #[error("the compressed part of a frame cannot be used: {reason}")]
    Compressed {
        /// The reason.
        reason: String,
    },
}

impl Frame {
    /// Encodes a frame with this content.
    pub fn encoded(body: Body) -> Vec<u8> {
        Frame { body: Some(body) }.encode_to_vec()
    }

    /// Decodes a frame.
    ///
    /// # Errors
    ///
    /// [`FrameError`] if it is too long or no frame.
    pub fn decoded(bytes: &[u8]) -> Result<Frame, FrameError> {
        if bytes.len() > FRAME_MAX {
            return Err(FrameError::TooLong { bytes: bytes.len() });
        }
        let frame = Frame::decode(bytes);
        frame.map_err(|error| FrameError::Malformed { reason: error.to_string() })
    }
}

/// Longest window of the compression, as a power of two: a decoder takes that much memory.
const WINDOW_LOG: u32 = 23;

/// Compresses a part of a frame.
pub fn compress(bytes: &[u8]) -> Vec<u8> {
    // It writes to memory, which does not fail. As a whole, it states its length, and takes no more
    // memory than it needs: in a stream, each part would take some 2 MB on both sides.
    zstd::bulk::compress(bytes, 3).unwrap_or_default()
}

/// Decompresses a part of a frame, at most [`LINES_MAX`] bytes.
///
/// # Errors
///
/// [`FrameError::Compressed`] if it is damaged or longer.
pub fn decompress(bytes: &[u8]) -> Result<Vec<u8>, FrameError> {
    let failed = |reason: String| FrameError::Compressed { reason };
    let long = || failed(format!("it has more than {LINES_MAX} bytes"));
    let length = Decompressor::upper_bound(bytes);
    if length.is_some_and(|length| length as u64 > LINES_MAX) {
        return Err(long());
    }
    let whole = DECOMPRESSOR.with_borrow_mut(|it| Some(it.as_mut()?.decompress(bytes, length?)));
    let whole = whole.unwrap_or_else(|| decompress_stream(bytes));
    let whole = whole.map_err(|error| failed(error.to_string()))?;
    if whole.len() as u64 > LINES_MAX { Err(long()) } else { Ok(whole) }
}

/// Decompresses a part that does not state its length, to one byte more than is allowed.
fn decompress_stream(bytes: &[u8]) -> io::Result<Vec<u8>> {
    let mut decoder = zstd::stream::Decoder::new(bytes)?;
    decoder.window_log_max(WINDOW_LOG)?;
    let mut whole = Vec::new();
    decoder.take(LINES_MAX + 1).read_to_end(&mut whole)?;
    Ok(whole)
}

/// Returns the digest of a desired state, without its number: equal states have the same one.
pub fn desired_digest(deployments: &[Wanted]) -> String {
    let mut digest = Sha256::new();
    for wanted in deployments {
        digest.update(wanted.encode_length_delimited_to_vec());
    }
    gleaner_base::hex(&digest.finalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(id: &str) -> Wanted {
        Wanted {
            id: id.to_owned(),
            envelope: "a".repeat(64),
            is_wanted: true,
            rollback: 0,
            start: 0,
        }
    }

    #[test]
    fn a_frame_of_a_later_version_is_empty_and_bad_bytes_are_refused() {
        // Field 200, with a message of one byte.
        let later = [0xc2, 0x0c, 1, 0];
        assert_eq!(Frame::decoded(&later).unwrap().body, None);
        let damaged = Frame::decoded(&[0x0a, 0xff]).unwrap_err().to_string();
        assert!(damaged.starts_with("a frame cannot be decoded"), "{damaged}");
        let long = Frame::decoded(&vec![0; FRAME_MAX + 1]).unwrap_err().to_string();
        assert_eq!(long, "a frame has 1048577 bytes, above the maximum of 1048576");
    }

    #[test]
    fn a_compressed_part_is_bounded() {
        let text = b"a line\n".repeat(1000);
        assert_eq!(decompress(&compress(&text)).unwrap(), text);
        // As earlier versions send it: without its length.
        let stream = |bytes: &[u8]| zstd::stream::encode_all(bytes, 3).unwrap();
        assert_eq!(decompress(&stream(&text)).unwrap(), text);
        assert!(decompress(&stream(&vec![0; LINES_MAX as usize + 1])).is_err());
        let bomb = compress(&vec![0; LINES_MAX as usize + 1]);
        assert!(bomb.len() < 10_000);
        let refused = decompress(&bomb).unwrap_err().to_string();
        assert!(refused.ends_with("it has more than 8388608 bytes"), "{refused}");
        assert!(decompress(b"no zstd").is_err());
    }

    #[test]
    fn the_digest_of_a_state_changes_with_each_part() {
        let states = [
            vec![],
            vec![wanted("a")],
            vec![wanted("a"), wanted("b")],
            vec![wanted("b"), wanted("a")],
            vec![Wanted { is_wanted: false, ..wanted("a") }],
            vec![Wanted { rollback: 1, ..wanted("a") }],
            vec![Wanted { start: 1, ..wanted("a") }],
        ];
        let digests: std::collections::BTreeSet<_> =
            states.iter().map(|state| desired_digest(state)).collect();
        assert_eq!(digests.len(), states.len());
    }
}
