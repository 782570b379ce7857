//! Tracks the other participants of the domain, and the matches of local endpoints.

use std::collections::{HashMap, HashSet};
use std::ops::RangeBounds;

use rustdds::{DomainParticipantStatusEvent as Event, GUID};

use super::filter::Prefix;

/// Most participants, and most matches of one local endpoint, that are tracked.
const MOST: usize = 4096;

/// The GUID prefix of `guid`'s participant.
pub(super) fn prefix(guid: &GUID) -> Prefix {
    *guid.to_bytes().first_chunk().expect("12 of 16 bytes")
}

/// Other participants, and the matches of local endpoints with remote ones.
#[derive(Debug, Default)]
pub(super) struct Peers {
    /// The DDS vendor ID of each.
    participants: HashMap<GUID, [u8; 2]>,
    /// Matches by local endpoint.
    matched: HashMap<GUID, HashSet<GUID>>,
}

impl Peers {
    /// Applies an event. Returns whether offers may have changed.
    pub(super) fn note(&mut self, event: &Event) -> bool {
        match event {
            Event::ParticipantDiscovered { dpd } => {
                if self.participants.len() < MOST {
                    self.participants.insert(dpd.guid, dpd.vendor_id.vendor_id);
                }
            }
            Event::ParticipantLost { id, .. } => {
                let their = id.range();
                self.participants.retain(|participant, _| !their.contains(participant));
                self.matched
                    .values_mut()
                    .for_each(|matched| matched.retain(|guid| !their.contains(guid)));
            }
            Event::WriterLost { guid, .. } | Event::ReaderLost { guid, .. } => {
                for matched in self.matched.values_mut() {
                    matched.remove(guid);
                }
            }
            Event::RemoteWriterMatched { local_reader: own, remote_writer: their }
            | Event::RemoteReaderMatched { local_writer: own, remote_reader: their } => {
                // Built-in endpoints of RustDDS are not followed.
                if let Some(matched) =
                    self.matched.get_mut(own).filter(|matched| matched.len() < MOST)
                {
                    matched.insert(*their);
                }
                return false;
            }
            Event::WriterDetected { .. } => {}
            _ => return false,
        }
        true
    }

    /// Starts to track the matches of a local endpoint. To be called before it can be matched.
    pub(super) fn follow(&mut self, own: GUID) {
        self.matched.entry(own).or_default();
    }

    pub(super) fn forget(&mut self, own: GUID) {
        self.matched.remove(&own);
    }

    /// Number of matches of a local endpoint.
    pub(super) fn connected(&self, own: GUID) -> usize {
        self.matched.get(&own).map_or(0, HashSet::len)
    }

    pub(super) fn participants(&self) -> usize {
        self.participants.len()
    }

    /// The DDS vendor ID of the participant with this GUID prefix, if known.
    pub(super) fn vendor(&self, their: Prefix) -> Option<[u8; 2]> {
        self.participants.iter().find(|(guid, _)| prefix(guid) == their).map(|(_, vendor)| *vendor)
    }

    /// The GUID prefixes of all participants, sorted.
    pub(super) fn prefixes(&self) -> Vec<Prefix> {
        let mut prefixes: Vec<Prefix> = self.participants.keys().map(prefix).collect();
        prefixes.sort_unstable();
        prefixes
    }
}
