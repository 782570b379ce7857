//! Tracks the writer of each channel, and the last sequence number of each writer.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

use tracing::warn;

use crate::file::Channels;
use gleaner_messages::transport::Guid;

/// The first bytes of the identity of a writer that no file names.
const MADE_UP: &[u8] = b"mcap";

#[derive(Default)]
pub struct Writers {
    files: u32,
    /// Sequence numbers, by topic and writer. Two clips of one drive name the same writer, whose
    /// numbers must continue from one to the other.
    counters: HashMap<(String, Guid), Arc<Numbers>>,
}

/// Numbers of a writer. The tracks of a replay share it, which one thread uses at a time: no
/// ordering is needed.
#[derive(Default)]
struct Numbers {
    last: AtomicU64,
    /// True if several files have messages of it.
    is_split: AtomicBool,
}

pub struct ChannelWriter {
    guid: Guid,
    /// True if the channel's metadata names it, and it was a real one.
    is_named: bool,
    numbers: Arc<Numbers>,
}

impl ChannelWriter {
    pub fn guid(&self) -> Guid {
        self.guid
    }

    pub fn last_seq(&self) -> u64 {
        self.numbers.last.load(Relaxed)
    }

    /// Continues after the number `seq`.
    pub fn skip_to(&self, seq: u64) {
        self.numbers.last.fetch_max(seq, Relaxed);
    }

    pub fn count(&self, sequence: u32) {
        let last = self.last_seq();
        // A named writer counts all its life; it has sent a sample twice if its number comes again.
        // Other recorders may write 0, and numbers that fall back after a restart of the writer or
        // in another file, which would give two samples the same identity.
        let seq = match self.is_named && last > 0 && !self.numbers.is_split.load(Relaxed) {
            true => {
                let step = i64::from(sequence.wrapping_sub(last as u32).cast_signed());
                last.saturating_add_signed(step)
            }
            false => u64::from(sequence).max(last + 1),
        };
        self.numbers.last.store(seq, Relaxed);
    }
}

impl Writers {
    /// Returns the writers of the channels of one more file, by channel id.
    ///
    /// A channel has the writer that its metadata claims, unless another channel of its topic in
    /// this file claimed it first: then sequence numbers would be ambiguous. Channels without a
    /// claim get an identity made of the file's position in the drive and the channel's id.
    pub fn of_next_file(&mut self, path: &Path, channels: &Channels) -> Vec<(u16, ChannelWriter)> {
        let mut taken = HashSet::new();
        let mut ignored = 0_u32;
        // Claims come first, so that no generated identity equals a later claim.
        let claims: Vec<_> = channels
            .iter()
            .map(|(id, info)| {
                // Samples from before a clip are in a channel of their own.
                let key = |guid: &Guid| (info.topic.as_str(), *guid, info.is_latched);
                let claim = info.writer.filter(|guid| taken.insert(key(guid)));
                ignored += u32::from(info.writer.is_some() && claim.is_none());
                (id, info.topic.as_str(), claim)
            })
            .collect();
        if ignored > 0 {
            warn!(
                path = %path.display(),
                ignored,
                "channels claim a writer that another channel of their topic claimed first"
            );
        }
        let file = self.files;
        self.files = self.files.saturating_add(1);
        let writers = claims.into_iter().map(|(id, topic, claim)| {
            let is_named = claim.is_some_and(|guid| !guid.0.starts_with(MADE_UP));
            let guid = claim.unwrap_or_else(|| {
                let mut attempts = (0..=u32::MAX).map(|attempt| made_up(file, id, attempt));
                let free = attempts.find(|guid| taken.insert((topic, *guid, false)));
                free.expect("a file has fewer channels than there are attempts")
            });
            let numbers = match self.counters.entry((topic.to_owned(), guid)) {
                Entry::Occupied(known) => {
                    known.get().is_split.store(true, Relaxed);
                    known.get().clone()
                }
                Entry::Vacant(new) => new.insert(Arc::default()).clone(),
            };
            (id, ChannelWriter { guid, is_named, numbers })
        });
        writers.collect()
    }
}

fn made_up(file: u32, channel: u16, attempt: u32) -> Guid {
    let mut bytes = [0; 16];
    bytes[..4].copy_from_slice(MADE_UP);
    bytes[4..8].copy_from_slice(&file.to_be_bytes());
    bytes[8..12].copy_from_slice(&u32::from(channel).to_be_bytes());
    bytes[12..].copy_from_slice(&attempt.to_be_bytes());
    Guid(bytes)
}
