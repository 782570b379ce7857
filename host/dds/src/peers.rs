//! Who else is in the domain, and who is connected to whom of ours.

use std::collections::{HashMap, HashSet};
use std::ops::RangeBounds;

use rustdds::{DomainParticipantStatusEvent as Event, GUID};

use super::filter::Prefix;

/// Most participants, and most endpoints that are connected to one of ours, of which is kept track.
const MOST: usize = 4096;

/// How the names of all endpoints of `guid`'s participant begin.
pub(super) fn prefix(guid: &GUID) -> Prefix {
    *guid.to_bytes().first_chunk().expect("12 of 16 bytes")
}

/// Other participants, and connections of our endpoints to theirs.
#[derive(Debug, Default)]
pub(super) struct Peers {
    /// Of each, whose DDS it is on: the vendor's number.
    participants: HashMap<GUID, [u8; 2]>,
    /// By endpoint of ours.
    matched: HashMap<GUID, HashSet<GUID>>,
}

impl Peers {
    /// Whether what happened changes who offers what.
    pub(super) fn note(&mut self, event: &Event) -> bool {
        match event {
            Event::ParticipantDiscovered { dpd } => {
                if self.participants.len() < MOST {
                    self.participants.insert(dpd.guid, dpd.vendor_id.vendor_id);
                }
            }
            Event::ParticipantLost { id, .. } => {
                let theirs = id.range();
                self.participants.retain(|participant, _| !theirs.contains(participant));
                self.matched
                    .values_mut()
                    .for_each(|matched| matched.retain(|guid| !theirs.contains(guid)));
            }
            Event::WriterLost { guid, .. } | Event::ReaderLost { guid, .. } => {
                for matched in self.matched.values_mut() {
                    matched.remove(guid);
                }
            }
            Event::RemoteWriterMatched { local_reader: ours, remote_writer: theirs }
            | Event::RemoteReaderMatched { local_writer: ours, remote_reader: theirs } => {
                // Endpoints of ours that RustDDS has for itself are not followed.
                if let Some(matched) =
                    self.matched.get_mut(ours).filter(|matched| matched.len() < MOST)
                {
                    matched.insert(*theirs);
                }
                return false;
            }
            Event::WriterDetected { .. } => {}
            _ => return false,
        }
        true
    }

    /// Follows an endpoint of ours from now on. To be called before it can be connected.
    pub(super) fn follow(&mut self, ours: GUID) {
        self.matched.entry(ours).or_default();
    }

    pub(super) fn forget(&mut self, ours: GUID) {
        self.matched.remove(&ours);
    }

    /// How many are connected to an endpoint of ours.
    pub(super) fn connected(&self, ours: GUID) -> usize {
        self.matched.get(&ours).map_or(0, HashSet::len)
    }

    pub(super) fn participants(&self) -> usize {
        self.participants.len()
    }

    /// Whose DDS the participant is on whose endpoints' names begin so: the vendor's number, if it
    /// is known.
    pub(super) fn vendor(&self, theirs: Prefix) -> Option<[u8; 2]> {
        self.participants.iter().find(|(guid, _)| prefix(guid) == theirs).map(|(_, vendor)| *vendor)
    }

    /// How the names of all endpoints of each participant begin, sorted.
    pub(super) fn prefixes(&self) -> Vec<Prefix> {
        let mut prefixes: Vec<Prefix> = self.participants.keys().map(prefix).collect();
        prefixes.sort_unstable();
        prefixes
    }
}
