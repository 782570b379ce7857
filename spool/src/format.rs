//! Layout of a segment: its header, the heads of its records, and gap records. All numbers are
//! little-endian; `docs/spool.md` has the tables.

use std::io;
use std::time::SystemTime;

use gleaner_base::{ByteSize, nanoseconds};
use rustix::time::{ClockId, clock_gettime};

/// Maximum length of a payload, in bytes, of a stream with a budget of 32 MiB or more. It bounds
/// the memory of a reader.
pub const PAYLOAD_MAX: usize = 1 << 20;

/// Maximum length of the name of a stream, in bytes.
pub const NAME_MAX: usize = 64;

pub const BUDGET_MIN: ByteSize = ByteSize::kib(64);

pub(crate) const MAGIC: [u8; 8] = *b"\x89GLSPL\r\n";
pub(crate) const VERSION: u16 = 1;
pub(crate) const HEADER_LEN: usize = 128;
pub(crate) const HEAD_LEN: usize = 40;
pub(crate) const GAP_LEN: usize = 17;

/// Maximum length of a segment. A reader ignores what follows, so that a file of any length is read
/// in bounded time.
pub(crate) const SEGMENT_MAX: u64 = 4 << 20;

/// Sequence numbers are below it, so that sums with a length never overflow.
pub(crate) const SEQ_END: u64 = 1 << 63;

pub(crate) fn segment_name(first: u64) -> String {
    format!("{first:020}.seg")
}

/// Kind of a gap record. All other kinds are the caller's.
pub(crate) const GAP_KIND: u8 = 0;

/// The identity of one boot of the machine: monotonic times are comparable within it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BootId(pub [u8; 16]);

impl BootId {
    /// Reads the identity that the kernel made for the current boot.
    ///
    /// # Errors
    ///
    /// Those of reading `/proc/sys/kernel/random/boot_id`.
    pub fn current() -> io::Result<BootId> {
        let text = std::fs::read_to_string("/proc/sys/kernel/random/boot_id")?;
        let digits: String = text.trim().chars().filter(|digit| *digit != '-').collect();
        let id = u128::from_str_radix(&digits, 16).map_err(io::Error::other)?;
        Ok(BootId(id.to_be_bytes()))
    }
}

/// The times of a record. Records are ordered by sequence number; the time of day may jump.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SpoolTime {
    /// Nanoseconds since boot, including suspension.
    pub since_boot_ns: u64,
    /// Nanoseconds since 1970 UTC, as the clock of the vehicle was set.
    pub wall_ns: i64,
}

impl SpoolTime {
    pub fn now() -> SpoolTime {
        let boot = clock_gettime(ClockId::Boottime);
        let since_boot_ns = (boot.tv_sec as u64) * 1_000_000_000 + boot.tv_nsec as u64;
        let wall_ns = match SystemTime::now().duration_since(SystemTime::UNIX_EPOCH) {
            Ok(after) => nanoseconds(after),
            Err(before) => -nanoseconds(before.duration()),
        };
        SpoolTime { since_boot_ns, wall_ns }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum GapReason {
    /// The budget of the stream removed them, as the oldest.
    Budget = 1,
    /// They were refused: the disk was full.
    DiskFull = 2,
    /// They were refused: writing to the disk failed.
    WriteFailed = 3,
    /// They were refused: more was appended between two commits than the queue holds.
    QueueFull = 4,
    /// A kill or a power cut interrupted their commit. The gap is an upper bound: some of its
    /// numbers were never used.
    Torn = 5,
    /// Their bytes were changed. Only a reader reports this.
    Damaged = 6,
    /// No segment has them, and the writer has not noted that the budget removed them. Only a
    /// reader reports this.
    Missing = 7,
}

impl GapReason {
    pub(crate) fn from_code(code: u8) -> Option<GapReason> {
        use GapReason::{Budget, Damaged, DiskFull, Missing, QueueFull, Torn, WriteFailed};
        let all = [Budget, DiskFull, WriteFailed, QueueFull, Torn, Damaged, Missing];
        all.into_iter().find(|reason| *reason as u8 == code)
    }
}

/// A range of sequence numbers without records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SpoolGap {
    /// First number of the range.
    pub from: u64,
    /// Last number of the range.
    pub to: u64,
    pub reason: GapReason,
    /// Number of the gap record that the writer left; `None` if the reader found the gap.
    pub record: Option<u64>,
}

impl SpoolGap {
    pub(crate) fn to_payload(self) -> [u8; GAP_LEN] {
        let mut bytes = [0; GAP_LEN];
        bytes[..8].copy_from_slice(&self.from.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.to.to_le_bytes());
        bytes[16] = self.reason as u8;
        bytes
    }

    /// Parses the payload of gap record `seq`.
    pub(crate) fn parse(payload: &[u8], seq: u64) -> Option<SpoolGap> {
        let payload: &[u8; GAP_LEN] = payload.try_into().ok()?;
        let (from, to) = (u64_at(payload, 0), u64_at(payload, 8));
        let reason = GapReason::from_code(payload[16])?;
        (from <= to && to < seq).then_some(SpoolGap { from, to, reason, record: Some(seq) })
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SegmentHeader {
    pub(crate) stream: String,
    pub(crate) boot: BootId,
    pub(crate) first: u64,
    /// Random, and part of every checksum of a head, so that neither bytes of another segment nor
    /// bytes in a payload look like a record of this one.
    pub(crate) salt: u64,
}

impl SegmentHeader {
    pub(crate) fn to_bytes(&self) -> [u8; HEADER_LEN] {
        let mut bytes = [0; HEADER_LEN];
        bytes[..8].copy_from_slice(&MAGIC);
        bytes[8..10].copy_from_slice(&VERSION.to_le_bytes());
        bytes[10] = u8::try_from(self.stream.len()).expect("a name is at most 64 bytes");
        bytes[16..32].copy_from_slice(&self.boot.0);
        bytes[32..40].copy_from_slice(&self.first.to_le_bytes());
        bytes[40..48].copy_from_slice(&self.salt.to_le_bytes());
        bytes[48..48 + self.stream.len()].copy_from_slice(self.stream.as_bytes());
        let crc = crc32fast::hash(&bytes[..124]);
        bytes[124..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Parses a header; `None` if it is incomplete or changed. The error is its version, if that is
    /// another one.
    pub(crate) fn parse(bytes: &[u8]) -> Result<Option<SegmentHeader>, u16> {
        let bytes = bytes.get(..HEADER_LEN).and_then(without_crc);
        let Some(bytes) = bytes.filter(|bytes| bytes.starts_with(&MAGIC)) else { return Ok(None) };
        let version = u16::from_le_bytes([bytes[8], bytes[9]]);
        if version != VERSION {
            return Err(version);
        }
        let name = bytes[48..48 + NAME_MAX].get(..bytes[10].into()).unwrap_or_default();
        let boot = BootId(bytes[16..32].try_into().expect("16 bytes"));
        let (first, salt) = (u64_at(bytes, 32), u64_at(bytes, 40));
        let stream = String::from_utf8(name.to_vec()).ok();
        Ok(stream.map(|stream| SegmentHeader { stream, boot, first, salt }))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RecordHead {
    pub(crate) len: usize,
    pub(crate) payload_crc: u32,
    pub(crate) seq: u64,
    pub(crate) time: SpoolTime,
    pub(crate) kind: u8,
}

impl RecordHead {
    /// Encodes the head without its checksum, which [`seal`] adds for a segment.
    pub(crate) fn to_bytes(self) -> [u8; HEAD_LEN] {
        let mut bytes = [0; HEAD_LEN];
        let len = u32::try_from(self.len).expect("a payload is at most 1 MiB");
        bytes[..4].copy_from_slice(&len.to_le_bytes());
        bytes[4..8].copy_from_slice(&self.payload_crc.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.seq.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.time.since_boot_ns.to_le_bytes());
        bytes[24..32].copy_from_slice(&self.time.wall_ns.to_le_bytes());
        bytes[32] = self.kind;
        bytes
    }

    pub(crate) fn parse(bytes: &[u8], salt: u64) -> Option<RecordHead> {
        let len = u32_at(bytes, 0) as usize;
        let seq = u64_at(bytes, 8);
        // First what costs nothing: a search after damage tries every offset.
        if len > PAYLOAD_MAX || seq >= SEQ_END || bytes[33..36] != [0; 3] {
            return None;
        }
        let wall_ns = u64_at(bytes, 24).cast_signed();
        let time = SpoolTime { since_boot_ns: u64_at(bytes, 16), wall_ns };
        let head = RecordHead { len, payload_crc: u32_at(bytes, 4), seq, time, kind: bytes[32] };
        (u32_at(bytes, 36) == head_crc(bytes, salt)).then_some(head)
    }
}

/// Writes the checksum of the head at the start of `record`, for the segment with `salt`.
pub(crate) fn seal(record: &mut [u8], salt: u64) {
    let crc = head_crc(record, salt);
    record[36..HEAD_LEN].copy_from_slice(&crc.to_le_bytes());
}

fn head_crc(record: &[u8], salt: u64) -> u32 {
    let mut crc = crc32fast::Hasher::new();
    crc.update(&salt.to_le_bytes());
    crc.update(&record[..36]);
    crc.finalize()
}

/// Returns `bytes` without the checksum at their end; `None` if it is wrong.
pub(crate) fn without_crc(bytes: &[u8]) -> Option<&[u8]> {
    let (content, crc) = bytes.split_last_chunk()?;
    (crc32fast::hash(content).to_le_bytes() == *crc).then_some(content)
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("4 bytes"))
}

pub(crate) fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("8 bytes"))
}
