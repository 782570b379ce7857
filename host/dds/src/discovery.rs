//! Lists the topics of a domain, with names made printable.

use std::collections::{BTreeMap, HashSet};

use rustdds::discovery::{DiscoveredReaderData, DiscoveredWriterData};
use rustdds::{DomainParticipant, RTPSEntity};

use super::Distro;
use super::names::{ros_topic, ros_type, visible};
use super::qos::{Offer, as_rosbag2, describe};
use super::type_check::LeftOut;
use super::type_query::type_hash;
use gleaner_messages::transport::Guid;

/// Most topics that are listed.
const TOPICS: usize = 4096;
/// Most different qualities of service, and layouts, that are listed for a topic.
const QUALITIES: usize = 16;

/// A ROS 2 topic that another participant writes or reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DomainTopic {
    /// Absolute name. Characters that are not printable are escaped.
    pub topic: String,
    /// `pkg/msg/Type`, or the DDS name if it is not a ROS 2 type. Characters that are not printable
    /// are escaped.
    pub type_name: String,
    /// Writers of other participants.
    pub writers: usize,
    /// Readers of other participants.
    pub readers: usize,
    /// The distinct QoS offers of the writers, as text.
    pub qos: Vec<String>,
}

/// A topic with further announcements of its writers.
pub(super) struct ListedTopic {
    pub(super) shown: DomainTopic,
    /// The offers in the format of rosbag2.
    pub(super) offered_qos: Option<String>,
    /// The distinct hashes of the type.
    pub(super) type_hashes: Vec<String>,
}

pub(super) fn offer(writer: &DiscoveredWriterData) -> Offer {
    let data = &writer.publication_topic_data;
    Offer {
        guid: Guid(writer.writer_proxy.remote_writer_guid.to_bytes()),
        topic: data.topic_name.clone(),
        type_name: data.type_name.clone(),
        qos: data.qos(),
        type_hash: type_hash(&writer.user_data),
    }
}

/// The topics of other participants, sorted by name, and under one name by the number of writers,
/// most first. If there are too many, those that are `subscribed`, by their names and types in DDS,
/// are among them.
pub(super) fn topics(
    participant: &DomainParticipant,
    distro: Option<Distro>,
    subscribed: &[(String, String)],
) -> Vec<ListedTopic> {
    let own = participant.guid().prefix;
    let writers = participant.discovered_writers();
    let readers = participant.discovered_readers();
    let writers = writers
        .iter()
        .filter(|writer| writer.writer_proxy.remote_writer_guid.prefix != own)
        .map(offer);
    let readers =
        readers.iter().filter(|reader| reader.reader_proxy.remote_reader_guid.prefix != own);
    sorted(subscribed_first(writers, subscribed), readers.map(names), distro)
}

fn subscribed_first(
    writers: impl Iterator<Item = Offer>,
    subscribed: &[(String, String)],
) -> impl Iterator<Item = Offer> {
    let subscribed: HashSet<(&str, &str)> =
        subscribed.iter().map(|(topic, type_name)| (topic.as_str(), type_name.as_str())).collect();
    let (first, others): (Vec<_>, Vec<_>) =
        writers.partition(|offer| subscribed.contains(&(&*offer.topic, &*offer.type_name)));
    first.into_iter().chain(others)
}

fn names(reader: &DiscoveredReaderData) -> (&str, &str) {
    let data = &reader.subscription_topic_data;
    (data.topic_name(), data.type_name())
}

fn sorted<'a>(
    writers: impl Iterator<Item = Offer>,
    readers: impl Iterator<Item = (&'a str, &'a str)>,
    distro: Option<Distro>,
) -> Vec<ListedTopic> {
    let mut found: BTreeMap<(String, String), (Vec<Offer>, usize)> = BTreeMap::new();
    let key = |topic: &str, type_name: &str| {
        Some((visible(ros_topic(topic)?), visible(&ros_type(type_name))))
    };
    for offer in writers {
        let Some(key) = key(&offer.topic, &offer.type_name) else { continue };
        if found.len() < TOPICS || found.contains_key(&key) {
            found.entry(key).or_default().0.push(offer);
        }
    }
    for (topic, type_name) in readers {
        let Some(key) = key(topic, type_name) else { continue };
        if found.len() < TOPICS || found.contains_key(&key) {
            found.entry(key).or_default().1 += 1;
        }
    }
    let shown =
        |((topic, type_name), (offers, readers)): ((String, String), (Vec<Offer>, usize))| {
            let qos = distinct(offers.iter().map(|offer| match LeftOut::unmatched(offer) {
                None => describe(&offer.qos),
                Some(LeftOut::Key) => describe(&offer.qos) + ", with a key: not received",
                Some(_) => format!("{}, {}: not received", describe(&offer.qos), offer.encoding()),
            }));
            let offered_qos = as_rosbag2(&offers.iter().collect::<Vec<_>>(), distro);
            let announced = offers.iter().filter_map(LeftOut::layout_of);
            let type_hashes = distinct(announced.map(str::to_owned));
            let shown = DomainTopic { topic, type_name, writers: offers.len(), readers, qos };
            ListedTopic { shown, offered_qos, type_hashes }
        };
    let mut topics: Vec<_> = found.into_iter().map(shown).collect();
    // A participant that announces a topic with a wrong type must not displace the real one.
    topics.sort_by(|ListedTopic { shown: one, .. }, ListedTopic { shown: other, .. }| {
        one.topic.cmp(&other.topic).then(other.writers.cmp(&one.writers))
    });
    topics
}

fn distinct(texts: impl Iterator<Item = String>) -> Vec<String> {
    let mut distinct: Vec<String> = Vec::new();
    for text in texts {
        if distinct.len() < QUALITIES && !distinct.contains(&text) {
            distinct.push(text);
        }
    }
    distinct
}

#[cfg(test)]
mod tests {
    use super::super::qos::Request;
    use super::*;

    fn offer(topic: &str, type_name: &str, reliable: bool) -> Offer {
        let qos = Request { reliable, transient_local: false }.policies(1);
        Offer {
            guid: Guid::default(),
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            qos,
            type_hash: None,
        }
    }

    #[test]
    fn topics_are_sorted_and_their_offers_are_distinct() {
        let imu = "sensor_msgs::msg::dds_::Imu_";
        let writers =
            [offer("rt/b", imu, true), offer("rt/a", imu, true), offer("rt/a", imu, false)];
        let writers = writers.iter().chain(&writers).cloned();
        let readers = [("rt/a", imu), ("rt/c", "x"), ("rq/service", imu)];
        let topics = sorted(writers, readers.into_iter(), None);
        let names: Vec<_> = topics.iter().map(|listed| listed.shown.topic.as_str()).collect();
        assert_eq!(names, ["/a", "/b", "/c"]);
        let ListedTopic { shown: a, offered_qos: offered, .. } = &topics[0];
        assert_eq!((a.type_name.as_str(), a.writers, a.readers), ("sensor_msgs/msg/Imu", 4, 1));
        assert_eq!(a.qos, ["reliable, volatile", "best effort, volatile"]);
        assert_eq!(offered.as_ref().unwrap().matches("- history").count(), 4);
        assert_eq!(topics[2].offered_qos, None);
    }

    #[test]
    fn of_several_types_the_one_with_most_writers_comes_first() {
        let types =
            ["aaa::msg::dds_::X_", "sensor_msgs::msg::dds_::Imu_", "sensor_msgs::msg::dds_::Imu_"];
        let writers = types.map(|type_name| offer("rt/imu", type_name, true));
        let topics = sorted(writers.into_iter(), [("rt/imu", "a")].into_iter(), None);
        let shown = topics.iter().map(|listed| &listed.shown);
        let types: Vec<_> = shown.map(|topic| (topic.type_name.as_str(), topic.writers)).collect();
        assert_eq!(types, [("sensor_msgs/msg/Imu", 2), ("aaa/msg/X", 1), ("a", 0)]);
    }

    #[test]
    fn the_number_of_topics_is_bounded() {
        let writers = (0..10_000).map(|n| offer(&format!("rt/t{n}"), "x", true));
        assert_eq!(sorted(writers.clone(), std::iter::empty(), None).len(), TOPICS);
        let subscribed = [("rt/t9999".to_owned(), "x".to_owned())];
        let topics = sorted(subscribed_first(writers, &subscribed), std::iter::empty(), None);
        assert!(topics.iter().any(|found| found.shown.topic == "/t9999"));
        assert_eq!(topics.len(), TOPICS);
    }

    #[test]
    fn hostile_names_are_shown_escaped() {
        let topics =
            sorted([offer("rt/\u{1b}[2J", "\n", true)].into_iter(), std::iter::empty(), None);
        let expected = ("/\\u{1b}[2J", "\\u{a}");
        assert_eq!((topics[0].shown.topic.as_str(), topics[0].shown.type_name.as_str()), expected);
    }
}
