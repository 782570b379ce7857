//! Tracks the writer of each channel, and the last sequence number of each writer.

use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use tracing::warn;

use super::file::Channels;
use gleaner_transport::Guid;

/// The writers of a drive, over all its files.
#[derive(Default)]
pub(super) struct Writers {
    files: u32,
    /// Sequence numbers, by topic and writer. Two clips of one drive name the same writer, whose
    /// numbers must continue from one to the other.
    counters: HashMap<(String, Guid), Arc<AtomicU64>>,
}

/// The writer of one channel.
pub(super) struct ChannelWriter {
    guid: Guid,
    /// Shared by the tracks of a replay, which one thread uses at a time: no ordering is needed.
    last_seq: Arc<AtomicU64>,
}

impl ChannelWriter {
    pub(super) fn guid(&self) -> Guid {
        self.guid
    }

    pub(super) fn last_seq(&self) -> u64 {
        self.last_seq.load(Relaxed)
    }

    /// Counts a message with the recorded number `sequence`.
    pub(super) fn count(&self, sequence: u32) {
        // Recorders that do not count write 0; numbers that fall back after a restart of the writer
        // would give two samples the same identity.
        self.last_seq.store(u64::from(sequence).max(self.last_seq() + 1), Relaxed);
    }
}

impl Writers {
    /// Returns the writers of the channels of one more file, by channel id.
    ///
    /// A channel has the writer that its metadata claims, unless another channel of its topic in
    /// this file claimed it first: then sequence numbers would be ambiguous. Channels without a
    /// claim get an identity made of the file's position in the drive and the channel's id.
    pub(super) fn of_next_file(
        &mut self,
        path: &Path,
        channels: &Channels,
    ) -> Vec<(u16, ChannelWriter)> {
        let mut taken = HashSet::new();
        let mut ignored = 0_u32;
        // Claims come first, so that no generated identity equals a later claim.
        let claims: Vec<_> = channels
            .iter()
            .map(|(id, info)| {
                let claim = info.writer.filter(|guid| taken.insert((info.topic.as_str(), *guid)));
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
            let guid = claim.unwrap_or_else(|| {
                let mut attempts = (0..=u32::MAX).map(|attempt| made_up(file, id, attempt));
                let free = attempts.find(|guid| taken.insert((topic, *guid)));
                free.expect("a file has fewer channels than there are attempts")
            });
            let last_seq = self.counters.entry((topic.to_owned(), guid)).or_default().clone();
            (id, ChannelWriter { guid, last_seq })
        });
        writers.collect()
    }
}

fn made_up(file: u32, channel: u16, attempt: u32) -> Guid {
    let mut bytes = [0; 16];
    bytes[..4].copy_from_slice(b"mcap");
    bytes[4..8].copy_from_slice(&file.to_be_bytes());
    bytes[8..12].copy_from_slice(&u32::from(channel).to_be_bytes());
    bytes[12..].copy_from_slice(&attempt.to_be_bytes());
    Guid(bytes)
}
