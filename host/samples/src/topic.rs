//! Topics in shared memory, as this process maps them.
#![allow(unsafe_code)]

use std::fmt;
use std::io;
use std::os::fd::OwnedFd;

use crate::regions::{ControlRegion, MappedTopic};
use gleaner_buffers::shared::{
    HAZARDS, META_WORDS, PinLimits, ReaderMemory, SharedLayout, SharedReader,
};
use gleaner_messages::transport::{STORED_WORDS, live_definitions};
use gleaner_protocol::ingress::AttachedTopic;

use crate::FeedError;

/// Metadata of samples is [`StoredMeta`](gleaner_messages::transport::StoredMeta).
const _: () = assert!(META_WORDS == STORED_WORDS);

/// Positions on a control page have 48 bits.
const POSITION_BITS: u32 = 48;

/// A topic in shared memory.
#[derive(Clone)]
pub struct SharedTopicReader {
    /// Its description. Samples before `info.first` are not for this process.
    pub info: AttachedTopic,
    /// Finds and holds samples. Their metadata is a
    /// [`StoredMeta`](gleaner_messages::transport::StoredMeta), the counters are
    /// [`TopicCounters`](gleaner_messages::transport::TopicCounters).
    pub reader: SharedReader,
}

impl SharedTopicReader {
    /// Returns the definitions to use: those of a recording, `local` ones, or those of nodes.
    pub fn definitions<T>(&self, local: impl FnOnce() -> Option<T>) -> Option<T>
    where
        T: AsRef<str> + for<'a> From<&'a str>,
    {
        let carried = self.info.definitions.as_deref().map(T::from);
        if self.info.is_recorded {
            return carried.or_else(local);
        }
        live_definitions(&self.info.type_name, self.info.type_hash.as_deref(), local(), carried)
    }
}

impl fmt::Debug for SharedTopicReader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("FedTopic").field("info", &self.info).finish_non_exhaustive()
    }
}

/// The control page of this process, and which of its words belong to a topic.
pub(crate) struct OwnPage {
    pub(crate) control: ControlRegion,
    taken: Box<[bool]>,
}

pub(crate) enum AttachError {
    /// The ingress broke a rule.
    Malformed(FeedError),
    /// This process cannot map the memory.
    Memory(io::Error),
}

impl OwnPage {
    pub(crate) fn open(file: OwnedFd) -> Result<OwnPage, FeedError> {
        let control = ControlRegion::open(file).map_err(|source| FeedError::Control { source })?;
        Ok(OwnPage { control, taken: vec![false; HAZARDS].into() })
    }

    pub(crate) fn attach(
        &mut self,
        info: AttachedTopic,
        file: OwnedFd,
    ) -> Result<SharedTopicReader, AttachError> {
        let malformed = |why: &str| {
            AttachError::Malformed(FeedError::malformed(format!("topic {}: {why}", info.id)))
        };
        let layout = SharedLayout {
            depth: info.layout.depth,
            slots: info.layout.slots,
            slot_bytes: info.layout.slot_bytes,
        };
        let bytes = layout.bytes_needed().ok_or_else(|| malformed("its sizes are impossible"))?;
        if info.first >> POSITION_BITS != 0 {
            return Err(malformed("its first position is impossible"));
        }
        let limits = PinLimits {
            first_word: info.first_word,
            windows: info.holds.windows,
            window: info.holds.window,
            singles: info.holds.singles,
        };
        if !self.take(&limits) {
            return Err(malformed("its words on the control page are not its own"));
        }
        let mapped = MappedTopic::open(file, bytes).map_err(|error| match error.kind() {
            io::ErrorKind::InvalidData => malformed(&error.to_string()),
            _ => AttachError::Memory(error),
        })?;
        let memory = ReaderMemory::new(mapped, layout)
            .ok_or_else(|| malformed("its sizes are impossible"))?;
        // SAFETY: the ingress, the only process that can write this memory, attached this page with
        // these limits before it sent them. `take` gave these words to this reader alone, and a
        // forked process has no mapping of the page.
        let reader = unsafe { SharedReader::new(&memory, self.control.clone(), limits) };
        let reader =
            reader.map_err(|_| malformed("its words on the control page are not its own"))?;
        Ok(SharedTopicReader { info, reader })
    }

    /// Takes words for a topic. Returns `false` if the page lacks some, or another topic has one.
    fn take(&mut self, limits: &PinLimits) -> bool {
        let first = limits.first_word as usize;
        let count = usize::from(limits.windows) + usize::from(limits.singles);
        let Some(words) = self.taken.get_mut(first..first + count) else { return false };
        if words.contains(&true) {
            return false;
        }
        words.fill(true);
        true
    }
}
