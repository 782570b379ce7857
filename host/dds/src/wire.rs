//! What is in the domain, made fit to be shown.

use std::collections::BTreeMap;

use rustdds::discovery::{DiscoveredReaderData, DiscoveredWriterData};
use rustdds::{DomainParticipant, RTPSEntity};

use super::Distro;
use super::names::{ros_topic, ros_type, visible};
use super::offers::{Offer, as_rosbag2, in_words};
use gleaner_transport::Guid;

/// Most topics that are shown.
const TOPICS: usize = 4096;
/// Most different qualities of service that are shown of a topic.
const QUALITIES: usize = 16;

/// A topic of ROS 2 that somebody else writes or reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicOnWire {
    /// Absolute name. What is not printable is escaped.
    pub topic: String,
    /// `pkg/msg/Type`, or what DDS says if it is no type of ROS 2. What is not printable is
    /// escaped.
    pub type_name: String,
    /// Writers of others.
    pub writers: usize,
    /// Readers of others.
    pub readers: usize,
    /// What the writers offer, in words, each once.
    pub qos: Vec<String>,
}

pub(super) fn offer(writer: &DiscoveredWriterData) -> Offer {
    let data = &writer.publication_topic_data;
    Offer {
        guid: Guid(writer.writer_proxy.remote_writer_guid.to_bytes()),
        topic: data.topic_name.clone(),
        type_name: data.type_name.clone(),
        qos: data.qos(),
    }
}

/// The topics of others, sorted by name, and of one name by the number of writers, most first; with
/// what their writers offer as rosbag2 notes it.
pub(super) fn topics(
    participant: &DomainParticipant,
    distro: Option<Distro>,
) -> Vec<(TopicOnWire, Option<String>)> {
    let ours = participant.guid().prefix;
    let writers = participant.discovered_writers();
    let readers = participant.discovered_readers();
    let writers = writers
        .iter()
        .filter(|writer| writer.writer_proxy.remote_writer_guid.prefix != ours)
        .map(offer);
    let readers =
        readers.iter().filter(|reader| reader.reader_proxy.remote_reader_guid.prefix != ours);
    sorted(writers, readers.map(names), distro)
}

fn names(reader: &DiscoveredReaderData) -> (&str, &str) {
    let data = &reader.subscription_topic_data;
    (data.topic_name(), data.type_name())
}

fn sorted<'a>(
    writers: impl Iterator<Item = Offer>,
    readers: impl Iterator<Item = (&'a str, &'a str)>,
    distro: Option<Distro>,
) -> Vec<(TopicOnWire, Option<String>)> {
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
            let mut qos: Vec<String> = Vec::new();
            for words in offers.iter().map(|offer| in_words(&offer.qos)) {
                if qos.len() < QUALITIES && !qos.contains(&words) {
                    qos.push(words);
                }
            }
            let offered = as_rosbag2(&offers.iter().collect::<Vec<_>>(), distro);
            (TopicOnWire { topic, type_name, writers: offers.len(), readers, qos }, offered)
        };
    let mut topics: Vec<_> = found.into_iter().map(shown).collect();
    // Somebody who announces a topic as another type is not to be taken for the one who is meant.
    topics.sort_by(|(one, _), (other, _)| {
        one.topic.cmp(&other.topic).then(other.writers.cmp(&one.writers))
    });
    topics
}

#[cfg(test)]
mod tests {
    use super::super::offers::Request;
    use super::*;

    fn offer(topic: &str, type_name: &str, reliable: bool) -> Offer {
        let qos = Request { reliable, transient_local: false }.policies(1);
        Offer {
            guid: Guid::default(),
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            qos,
        }
    }

    #[test]
    fn topics_are_sorted_and_their_offers_said_once() {
        let imu = "sensor_msgs::msg::dds_::Imu_";
        let writers =
            [offer("rt/b", imu, true), offer("rt/a", imu, true), offer("rt/a", imu, false)];
        let writers = writers.iter().chain(&writers).cloned();
        let readers = [("rt/a", imu), ("rt/c", "x"), ("rq/service", imu)];
        let topics = sorted(writers, readers.into_iter(), None);
        let names: Vec<_> = topics.iter().map(|(topic, _)| topic.topic.as_str()).collect();
        assert_eq!(names, ["/a", "/b", "/c"]);
        let (a, offered) = &topics[0];
        assert_eq!((a.type_name.as_str(), a.writers, a.readers), ("sensor_msgs/msg/Imu", 4, 1));
        assert_eq!(a.qos, ["reliable, volatile", "best effort, volatile"]);
        assert_eq!(offered.as_ref().unwrap().matches("- history").count(), 4);
        assert_eq!(topics[2].1, None);
    }

    #[test]
    fn of_a_topic_of_several_types_the_one_that_most_write_comes_first() {
        let types =
            ["aaa::msg::dds_::X_", "sensor_msgs::msg::dds_::Imu_", "sensor_msgs::msg::dds_::Imu_"];
        let writers = types.map(|type_name| offer("rt/imu", type_name, true));
        let topics = sorted(writers.into_iter(), [("rt/imu", "a")].into_iter(), None);
        let types: Vec<_> =
            topics.iter().map(|(topic, _)| (topic.type_name.as_str(), topic.writers)).collect();
        assert_eq!(types, [("sensor_msgs/msg/Imu", 2), ("aaa/msg/X", 1), ("a", 0)]);
    }

    #[test]
    fn more_topics_than_anybody_has_are_not_kept() {
        let writers = (0..10_000).map(|n| offer(&format!("rt/t{n}"), "x", true));
        assert_eq!(sorted(writers, std::iter::empty(), None).len(), TOPICS);
    }

    #[test]
    fn hostile_names_are_shown_escaped() {
        let topics =
            sorted([offer("rt/\u{1b}[2J", "\n", true)].into_iter(), std::iter::empty(), None);
        assert_eq!(
            (topics[0].0.topic.as_str(), topics[0].0.type_name.as_str()),
            ("/\\u{1b}[2J", "\\u{a}")
        );
    }
}
