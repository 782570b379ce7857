//! Which writers of a topic send its type.

use std::collections::HashSet;

use rustdds::DomainParticipant;

use super::offers::Offer;
use super::wire;
use gleaner_transport::Guid;

/// Writers of another type that are remembered, if there are not more of them.
const OTHERS: usize = 1024;

/// Of one topic, the writers whose type was looked up: RustDDS connects them by the topic's name
/// alone.
#[derive(Debug, Default)]
pub(super) struct Types {
    ours: HashSet<Guid>,
    others: HashSet<Guid>,
    skipped: u64,
}

impl Types {
    /// Notes who offers the topic.
    pub(super) fn note(&mut self, ours: &[&Offer], others: &[&Offer]) {
        self.ours = ours.iter().map(|offer| offer.guid).collect();
        if self.others.len() > OTHERS {
            self.others.clear();
        }
        // Those that have gone stay: what they sent before may still wait.
        self.others.extend(others.iter().map(|offer| offer.guid));
    }

    /// Whether a sample of `writer` is to be passed over, because it announced another type than
    /// `type_name`. Looked up once if it came after what was noted.
    pub(super) fn is_backing_off(
        &mut self,
        participant: &DomainParticipant,
        writer: Guid,
        type_name: &str,
    ) -> bool {
        if !self.ours.contains(&writer) && !self.others.contains(&writer) {
            let writers = participant.discovered_writers();
            let found = writers.iter().map(wire::offer).find(|offer| offer.guid == writer);
            let other = found.is_some_and(|offer| offer.type_name != type_name);
            if other { &mut self.others } else { &mut self.ours }.insert(writer);
        }
        let other = self.others.contains(&writer);
        self.skipped += u64::from(other);
        other
    }

    /// How many samples of `topic` were passed over, in words.
    pub(super) fn qos_warnings(&self, topic: &str) -> Option<String> {
        let samples = if self.skipped == 1 { "sample" } else { "samples" };
        let count = self.skipped;
        (count > 0).then(|| format!("{count} {samples} of `{topic}`, of another type, passed over"))
    }
}
