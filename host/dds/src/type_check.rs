//! Skips samples of writers that announced another type.

use std::collections::HashSet;

use rustdds::DomainParticipant;

use super::discovery;
use super::qos::Offer;
use gleaner_transport::Guid;

/// Most writers of another type that are remembered.
const MOST_OTHER: usize = 1024;

/// The writers of one topic by type: RustDDS matches endpoints by the topic's name alone.
#[derive(Debug, Default)]
pub(super) struct TypeCheck {
    same: HashSet<Guid>,
    other: HashSet<Guid>,
    skipped: u64,
}

impl TypeCheck {
    /// Takes the current writers of the topic.
    pub(super) fn note(&mut self, same: &[&Offer], other: &[&Offer]) {
        self.same = same.iter().map(|offer| offer.guid).collect();
        if self.other.len() > MOST_OTHER {
            self.other.clear();
        }
        // Writers that are gone stay: samples that they sent before may still be queued.
        self.other.extend(other.iter().map(|offer| offer.guid));
    }

    /// Returns whether `writer` announced another type than `type_name`, so that its sample is
    /// skipped. A writer that is new since the last [`note`](Self::note) is looked up once.
    pub(super) fn is_of_another_type(
        &mut self,
        participant: &DomainParticipant,
        writer: Guid,
        type_name: &str,
    ) -> bool {
        if !self.same.contains(&writer) && !self.other.contains(&writer) {
            let writers = participant.discovered_writers();
            let found = writers.iter().map(discovery::offer).find(|offer| offer.guid == writer);
            let differs = found.is_some_and(|offer| offer.type_name != type_name);
            if differs { &mut self.other } else { &mut self.same }.insert(writer);
        }
        let differs = self.other.contains(&writer);
        self.skipped += u64::from(differs);
        differs
    }

    /// A warning with the number of skipped samples of `topic`, if there are any.
    pub(super) fn warning(&self, topic: &str) -> Option<String> {
        let samples = if self.skipped == 1 { "sample" } else { "samples" };
        let count = self.skipped;
        (count > 0).then(|| format!("{count} {samples} of `{topic}` skipped: another type"))
    }
}
