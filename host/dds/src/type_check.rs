//! Decides which writers of a topic are received: those of its type, in one layout, that its reader
//! can match.

use std::collections::HashMap;
use std::sync::OnceLock;

use rustdds::DomainParticipant;

use super::discovery;
use super::names::{ros_type, visible};
use super::qos::Offer;
use gleaner_messages::transport::{Guid, SampleMeta};

/// Most writers that are remembered as left out.
const MAX_LEFT_OUT: usize = 1024;
/// Last byte of the GUID of a program's writer with a key (RTPS 2.5, 9.3.1.2).
const WITH_KEY: u8 = 0x02;

/// The reason why the samples of a writer are not received.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum LeftOut {
    /// RustDDS matches endpoints by the topic's name alone.
    Type,
    Layout,
    /// RustDDS takes it as matched, but the writer sends nothing to a reader without a key.
    Key,
    Encoding,
}

impl LeftOut {
    /// The reason why no reader can match a writer, if there is one.
    pub(super) fn unmatched(offer: &Offer) -> Option<Self> {
        match offer.encoding() {
            _ if offer.guid.0[15] == WITH_KEY => Some(Self::Key),
            "XCDR1" => None,
            _ => Some(Self::Encoding),
        }
    }

    /// The hash of the layout that a writer announces, if readers can match it.
    pub(super) fn layout_of(offer: &Offer) -> Option<&str> {
        offer.type_hash.as_deref().filter(|_| Self::unmatched(offer).is_none())
    }

    /// A warning about a writer of `topic`: its cause, and a sentence.
    pub(super) fn warning(
        self,
        offer: &Offer,
        (topic, type_name): (&str, &str),
        layout: &TopicLayout,
    ) -> (&'static str, String) {
        let (writer, wanted) = (offer.guid, ros_type(type_name));
        match self {
            Self::Type => {
                let found = visible(&ros_type(&offer.type_name));
                let text = format!("writer {writer} of `{topic}` sends `{found}`, not `{wanted}`");
                ("another type", text)
            }
            Self::Layout => {
                let announced = offer.type_hash.as_deref().unwrap_or_default();
                let fixed = layout.get().unwrap_or_default();
                let text = format!(
                    "writer {writer} of `{topic}` sends `{wanted}` in the layout {announced}, but \
                     {fixed} is read: its samples are left out; let all writers of the topic use \
                     one definition of the type, and start Gleaner again"
                );
                ("another layout", text)
            }
            Self::Key => {
                let text = format!(
                    "writer {writer} of `{topic}` has a key, and nothing of it is received: \
                     publish `{wanted}` without `@key`"
                );
                ("a key", text)
            }
            Self::Encoding => {
                let text = format!(
                    "writer {writer} of `{topic}` offers only {}, and nothing of it is received: \
                     let it offer XCDR1, the default of ROS 2",
                    offer.encoding()
                );
                ("another encoding", text)
            }
        }
    }
}

/// The layout of the samples of a subscription, as the hash of their type. Once fixed it stays:
/// readers have the definitions of that layout alone.
#[derive(Debug, Default)]
pub(super) struct TopicLayout {
    fixed: OnceLock<String>,
    /// That of the definition that is at hand without a node.
    at_hand: Option<String>,
}

impl TopicLayout {
    pub(super) fn new(at_hand: Option<String>) -> Self {
        Self { fixed: OnceLock::new(), at_hand }
    }

    pub(super) fn get(&self) -> Option<&str> {
        self.fixed.get().map(String::as_str)
    }

    /// Fixes the layout, unless it is fixed; returns whether it is this one.
    pub(super) fn fix(&self, hash: &str) -> bool {
        self.fixed.get_or_init(|| hash.to_owned()) == hash
    }

    /// The layout to fix if writers announce these: that of the definition at hand, else the first.
    pub(super) fn choose<'h>(
        at_hand: Option<&str>,
        announced: impl IntoIterator<Item = &'h str>,
    ) -> Option<&'h str> {
        let mut announced = announced.into_iter();
        let first = announced.next()?;
        let mut all = std::iter::once(first).chain(announced);
        Some(all.find(|hash| at_hand == Some(hash)).unwrap_or(first))
    }
}

/// The writers of one topic.
#[derive(Debug, Default)]
pub(super) struct TypeCheck {
    /// Each with the number of its layout: 1 if it announces one, else 0.
    received: HashMap<Guid, u16>,
    left_out: HashMap<Guid, LeftOut>,
    /// Samples of another type, and of another layout.
    skipped: [u64; 2],
}

impl TypeCheck {
    /// Takes the current writers of the topic; splits them into those that are received, and
    /// others.
    pub(super) fn note<'o>(
        &mut self,
        offers: &[&'o Offer],
        type_name: &str,
        layout: &TopicLayout,
    ) -> (Vec<&'o Offer>, Vec<(&'o Offer, LeftOut)>) {
        let of_type = offers.iter().filter(|offer| offer.type_name == type_name);
        let announced = of_type.filter_map(|offer| LeftOut::layout_of(offer));
        if let Some(hash) = TopicLayout::choose(layout.at_hand.as_deref(), announced) {
            layout.fix(hash);
        }
        let (mut received, mut left_out) = (Vec::new(), Vec::new());
        for offer in offers {
            match left_out_for(offer, type_name, layout) {
                None => received.push(*offer),
                Some(why) => left_out.push((*offer, why)),
            }
        }
        self.received = received.iter().map(|offer| (offer.guid, number_of(offer))).collect();
        if self.left_out.len() > MAX_LEFT_OUT {
            self.left_out.clear();
        }
        // Writers that are gone stay: samples that they sent before may still be queued.
        self.left_out.extend(left_out.iter().map(|(offer, why)| (offer.guid, *why)));
        (received, left_out)
    }

    /// Returns the number of the layout of a sample of `writer`; `None` if it is skipped. A writer
    /// that is new since the last [`note`](Self::note) is looked up once.
    pub(super) fn layout_of(
        &mut self,
        participant: &DomainParticipant,
        writer: Guid,
        type_name: &str,
        layout: &TopicLayout,
    ) -> Option<u16> {
        if !self.received.contains_key(&writer) && !self.left_out.contains_key(&writer) {
            let writers = participant.discovered_writers();
            let found = writers.iter().map(discovery::offer).find(|offer| offer.guid == writer);
            match found.as_ref().and_then(|offer| left_out_for(offer, type_name, layout)) {
                Some(why) => drop(self.left_out.insert(writer, why)),
                None => drop(self.received.insert(writer, found.as_ref().map_or(0, number_of))),
            }
        }
        let Some(why) = self.left_out.get(&writer) else {
            return self.received.get(&writer).copied();
        };
        self.skipped[usize::from(*why == LeftOut::Layout)] += 1;
        None
    }

    /// Warnings with the numbers of skipped samples of `topic`.
    pub(super) fn warnings(&self, topic: &str) -> impl Iterator<Item = String> {
        let skipped = self.skipped.into_iter().zip(["another type", "another layout"]);
        skipped.filter(|(count, _)| *count > 0).map(move |(count, why)| {
            let samples = if count == 1 { "sample" } else { "samples" };
            format!("{count} {samples} of `{topic}` skipped: {why}")
        })
    }
}

fn number_of(offer: &Offer) -> u16 {
    if offer.type_hash.is_some() { SampleMeta::ANNOUNCED } else { 0 }
}

fn left_out_for(offer: &Offer, type_name: &str, layout: &TopicLayout) -> Option<LeftOut> {
    if offer.type_name != type_name {
        return Some(LeftOut::Type);
    }
    let is_of_it = || offer.type_hash.as_deref().is_none_or(|hash| layout.fix(hash));
    LeftOut::unmatched(offer).or_else(|| (!is_of_it()).then_some(LeftOut::Layout))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writers_that_no_reader_can_match_do_not_fix_the_layout() {
        let offer = |entity: u8, hash: &str| Offer {
            guid: Guid([entity; 16]),
            topic: "rt/tyre".to_owned(),
            type_name: "Tyre".to_owned(),
            qos: rustdds::QosPolicyBuilder::new().build(),
            type_hash: Some(hash.to_owned()),
        };
        let (keyed, plain) = (offer(WITH_KEY, "RIHS01_1"), offer(3, "RIHS01_2"));
        let (mut check, layout) = (TypeCheck::default(), TopicLayout::new(None));
        let (received, left_out) = check.note(&[&keyed, &plain], "Tyre", &layout);
        assert_eq!(layout.get(), Some("RIHS01_2"));
        assert_eq!(received[0].guid, plain.guid);
        assert!(matches!(left_out[..], [(offer, LeftOut::Key)] if offer.guid == keyed.guid));
    }
}
