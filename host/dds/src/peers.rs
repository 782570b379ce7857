//! Tracks the other participants of the domain, and the matches of local endpoints.

use std::collections::{HashMap, HashSet};
use std::ops::RangeBounds;

use rustdds::{DomainParticipantStatusEvent as Event, GUID};

use super::filter::Prefix;
use gleaner_messages::transport::Guid;

/// Most participants, and most matches of one local endpoint, that are tracked.
const MOST: usize = 4096;

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

    /// Removes matches of the local endpoints `own` with remote ones that are not `present`.
    ///
    /// RustDDS reports a loss by another thread than matches: the loss may come first, and the
    /// match would stay. `present` has to be read after the events of the matches.
    pub(super) fn keep(&mut self, own: impl Fn(&GUID) -> bool, present: &HashSet<GUID>) {
        for (own, matched) in self.matched.iter_mut().filter(|(guid, _)| own(guid)) {
            // Endpoints of our participant are not listed as present.
            matched.retain(|their| their.prefix == own.prefix || present.contains(their));
        }
    }

    /// Number of matches of a local endpoint.
    pub(super) fn connected(&self, own: GUID) -> usize {
        self.matched.get(&own).map_or(0, HashSet::len)
    }

    /// The same without those that are left out.
    pub(super) fn connected_but(&self, own: GUID, left_out: &HashSet<Guid>) -> usize {
        let counts = |their: &&GUID| !left_out.contains(&Guid(their.to_bytes()));
        self.matched.get(&own).map_or(0, |matched| matched.iter().filter(counts).count())
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

#[cfg(test)]
mod tests {
    use rustdds::LostReason;

    use super::*;

    fn guid(participant: u8, kind: u8, number: u8) -> GUID {
        let mut bytes = [participant; 16];
        bytes[12..].copy_from_slice(&[0, 0, number, kind]);
        GUID::from_bytes(bytes)
    }

    #[test]
    fn a_match_that_is_reported_after_the_loss_of_the_writer_does_not_stay() {
        let (reader, gone, here, own) =
            (guid(1, 4, 1), guid(2, 3, 1), guid(2, 3, 2), guid(1, 3, 2));
        let mut peers = Peers::default();
        peers.follow(reader);
        peers.note(&Event::WriterLost { guid: gone, reason: LostReason::Disposed });
        for remote_writer in [gone, here, own] {
            peers.note(&Event::RemoteWriterMatched { local_reader: reader, remote_writer });
        }
        assert_eq!(peers.connected(reader), 3);
        let is_reader = |guid: &GUID| guid.entity_id.kind().is_reader();
        peers.keep(|guid| !is_reader(guid), &HashSet::new());
        assert_eq!(peers.connected(reader), 3);
        peers.keep(is_reader, &HashSet::from([here]));
        assert_eq!(peers.connected(reader), 2, "of this participant, and of the other one");
    }
}
