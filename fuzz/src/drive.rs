//! Fuzzes MCAP files. An input is a whole file, so that other readers can open a finding.

use std::collections::HashMap;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use gleaner_drives::{DriveLimits, Replay, ReplayStep, read_extras};
use gleaner_messages::transport::{Delivery, SampleMeta, Sink, Subscription, TopicSpec, Transport};
use rustix::fs::{MemfdFlags, SeekFrom, ftruncate, memfd_create, seek};

use crate::budget;

/// Small enough that a file of a few KB can reach them.
const LIMITS: DriveLimits =
    DriveLimits { chunk_bytes: 256 << 10, open_bytes: 512 << 10, unpacked_bytes: 1 << 20 };

/// Memory budget of a replay: the open chunks, the chunk that is being opened, and the channel
/// records of the file.
pub(crate) const MEMORY: usize = 16 << 20;

/// Memory budget of metadata and attachments, overhead included.
const EXTRAS: u64 = 32 << 10;

/// More steps than the limits on chunks and files allow for a valid drive; a replay that exceeds
/// them does not terminate.
const STEPS_MAX: usize = 200_000;

/// Replays a file twice and reads its extras. Returns whether it is complete and holds messages.
pub fn check(data: &[u8]) -> bool {
    let (file, path) = file();
    rewrite(file, data);
    let paths = [path.clone()];
    let with_peek = budget::within(MEMORY, || replay(&paths, true));
    let without_peek = budget::within(MEMORY, || replay(&paths, false));
    assert_eq!(with_peek, without_peek, "peeking changes the delivered samples");
    let extras = budget::within(MEMORY, || read_extras(path, EXTRAS));
    if let Ok(extras) = &extras {
        let pair = |(key, value): (&String, &String)| 128 + key.len() + value.len();
        let metadata = extras
            .metadata
            .iter()
            .map(|(name, pairs)| 128 + name.len() + pairs.iter().map(pair).sum::<usize>());
        let attachments = extras
            .attachments
            .iter()
            .map(|one| one.name.len() + one.media_type.len() + one.data.len());
        let taken = metadata.sum::<usize>() + attachments.sum::<usize>();
        assert!(taken as u64 <= EXTRAS, "{taken} bytes of metadata and attachments");
    }
    with_peek.0 > 0 && with_peek.2.is_empty() && extras.is_ok()
}

/// The file in memory that all inputs are written to, and its path.
fn file() -> &'static (OwnedFd, PathBuf) {
    static FILE: OnceLock<(OwnedFd, PathBuf)> = OnceLock::new();
    FILE.get_or_init(|| {
        let file = memfd_create("drive.mcap", MemfdFlags::CLOEXEC)
            .expect("the system has files in memory");
        let path = PathBuf::from(format!("/proc/self/fd/{}", file.as_raw_fd()));
        (file, path)
    })
}

fn rewrite(file: impl AsFd, data: &[u8]) {
    ftruncate(&file, 0).expect("the file in memory is writable");
    seek(&file, SeekFrom::Start(0)).expect("the file in memory is writable");
    let mut rest = data;
    while !rest.is_empty() {
        let written = rustix::io::write(&file, rest).expect("the file in memory is writable");
        rest = &rest[written..];
    }
}

/// Replays the drive; returns the number of steps, a digest of them, and how the replay ended.
pub(crate) fn replay(paths: &[PathBuf], peeking: bool) -> (usize, u64, String) {
    let mut replay = match Replay::open_with(paths, LIMITS) {
        Ok(replay) => replay,
        Err(error) => return (0, 0, error.to_string()),
    };
    let sink = Arc::new(LastSample::default());
    for found in replay.topics().into_iter().take(8) {
        let _ = replay.definitions(&found.topic);
        let spec = TopicSpec {
            topic: found.topic,
            type_name: found.type_name,
            queue: 1,
            max_bytes: 1 << 20,
            qos: Default::default(),
        };
        let _ = replay.subscribe(&spec, sink.clone());
    }
    let (mut steps, mut digest) = (0, 0);
    let mut order = OrderCheck::default();
    let ended = loop {
        let ahead = if peeking { replay.peek_at_ns() } else { Ok(None) };
        let step = match ahead {
            Err(error) => break error.to_string(),
            Ok(ahead) => match replay.step() {
                Err(error) => break error.to_string(),
                Ok(step) => {
                    let at_ns = step.as_ref().map(|step| step.at_ns);
                    assert!(!peeking || ahead == at_ns, "expected {ahead:?}, not {at_ns:?}");
                    step
                }
            },
        };
        let Some(step) = step else { break String::new() };
        steps += 1;
        assert_eq!(replay.progress().done, steps as u64);
        order.note(&step);
        let (meta, crc) = sink.last();
        if step.delivery != Delivery::Malformed {
            assert_eq!((meta, sink.bytes()), (Some(step.meta), step.bytes as u64), "step and sink");
        }
        digest = digest_of(digest, &step, crc);
        if steps >= STEPS_MAX {
            return (steps, digest, "too many steps".to_owned());
        }
    };
    assert!(matches!(replay.step(), Ok(None)), "a step after the end");
    assert!(matches!(replay.peek_at_ns(), Ok(None)), "a time after the end");
    assert_eq!(replay.out_of_order(), order.late, "messages out of order");
    (steps, digest, ended)
}

fn digest_of(before: u64, step: &ReplayStep, crc: u64) -> u64 {
    let words = [before, step.at_ns as u64, step.meta.seq, step.subscription.0 as u64, crc];
    let mut hash = crc32fast::Hasher::new();
    words.iter().for_each(|word| hash.update(&word.to_le_bytes()));
    u64::from(hash.finalize()) | before << 32
}

/// Checks the guarantees about the order of messages.
#[derive(Default)]
struct OrderCheck {
    newest_ns: Option<i64>,
    late: u64,
    /// Newest sequence number by topic and writer: in a file, one writer may write several topics.
    numbers: HashMap<(Subscription, [u8; 16]), u64>,
}

impl OrderCheck {
    fn note(&mut self, step: &ReplayStep) {
        assert_eq!(step.at_ns, step.meta.at_ns);
        self.late += u64::from(self.newest_ns.is_some_and(|newest| step.at_ns < newest));
        self.newest_ns = self.newest_ns.max(Some(step.at_ns));
        let before = self
            .numbers
            .insert((step.subscription, step.meta.writer.0), step.meta.seq)
            .unwrap_or(0);
        // A named writer may have sent a sample twice.
        let is_made_up = step.meta.writer.0.starts_with(b"mcap");
        assert!(step.meta.seq > before || !is_made_up, "number {} after {before}", step.meta.seq);
    }
}

#[derive(Default)]
struct LastSample {
    meta: Mutex<(Option<SampleMeta>, u64)>,
    bytes: AtomicU64,
}

impl LastSample {
    fn last(&self) -> (Option<SampleMeta>, u64) {
        *self.meta.lock().expect("nothing panics while it is held")
    }

    fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }
}

impl Sink for LastSample {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        *self.meta.lock().expect("nothing panics while it is held") =
            (Some(*meta), crc32fast::hash(cdr).into());
        self.bytes.store(cdr.len() as u64, Ordering::Relaxed);
        Delivery::Taken
    }
}
