//! Tests of writers whose samples have another layout, a key or an encoding that is not read.

use gleaner_dds::Dds;
use gleaner_messages::transport::{DefinitionsSearch, LiveSource, Qos, TopicSpec, Transport};
use rustdds::policy::{DataRepresentation, XCDR2_DATA_REPRESENTATION};
use rustdds::{GUID, Keyed, RTPSEntity, TopicKind};
use serde::{Deserialize, Serialize};

use super::Test;
use super::peer::{
    KeptSamples, Little, Peer, Subscribed, connected, matched, open, policies, spec, subscribed,
    until, write,
};
use super::type_query::{announce, announcement};

pub const TESTS: &[Test] = &[
    ("samples_in_another_layout_are_left_out_counted_and_named", two_layouts),
    ("writers_that_no_reader_can_match_are_named_and_do_not_count", unmatched),
    ("feedback_of_actions_and_events_of_services_are_received", not_messages),
];

const STRING: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

/// Announces a writer of `std_msgs/msg/String` again, now with a hash.
fn announce_hash(domain: u16, writer: GUID, topic: &str, hash: &str) {
    let topic = format!("rt{topic}");
    // Numbers that the peer has used are ignored.
    let again = |seq| announcement(writer, seq, &topic, "std_msgs::msg::dds_::String_", hash);
    announce(domain, (1..20).map(again));
}

fn warned(dds: &Dds, subscription: gleaner_messages::transport::Subscription, sentence: &str) {
    until(sentence, || {
        dds.status(subscription).qos_warnings.iter().any(|line| line.contains(sentence))
    });
}

fn two_layouts() {
    let (domain, mut dds) = open();
    let sink = KeptSamples::new();
    let subscription = dds.subscribe(&spec("/name", Qos::Auto), sink.clone()).unwrap();
    assert_eq!(dds.type_hash("/name"), None, "no writer announces one");
    // A participant each, since the announcements take the numbers of its own.
    let peers = [Peer::join(domain), Peer::join(domain), Peer::join(domain)];
    let [same, other, silent] = peers.each_ref().map(|peer| peer.writer("/name", true, false));
    connected(&dds, subscription, 3);
    [&same, &other, &silent].into_iter().for_each(matched);
    announce_hash(domain, same.guid(), "/name", STRING);
    until("the hash", || dds.type_hash("/name").as_deref() == Some(STRING));
    let another = STRING.replace('d', "0");
    announce_hash(domain, other.guid(), "/name", &another);
    let (writer, type_name) = (other.guid().to_bytes(), "std_msgs/msg/String");
    let sentence = format!(
        "writer {} of `/name` sends `{type_name}` in the layout {another}, but {STRING} is read",
        gleaner_messages::transport::Guid(writer)
    );
    warned(&dds, subscription, &sentence);
    connected(&dds, subscription, 2);
    write(&other, b"not to be read..");
    warned(&dds, subscription, "1 sample of `/name` skipped: another layout");
    sink.mark(&same, b"same");
    sink.mark(&silent, b"none");
    assert!(sink.bytes(2).iter().all(|bytes| bytes == b"same" || bytes == b"none"));
    assert_eq!(dds.layout(subscription).as_deref(), Some(STRING));

    // Of a type that is not at hand, the first writer fixes it, also for later subscriptions.
    let car = "car_msgs/msg/Unknown".to_owned();
    let spec = TopicSpec { type_name: car, ..spec("/later", Qos::Auto) };
    let subscription = dds.subscribe(&spec, KeptSamples::new()).unwrap();
    assert_eq!((dds.layout(subscription), dds.type_hash("/later")), (None, None));
    let again = |seq| {
        announcement(silent.guid(), seq, "rt/later", "car_msgs::msg::dds_::Unknown_", &another)
    };
    announce(domain, (1..20).map(again));
    until("a layout", || dds.layout(subscription).as_deref() == Some(&*another));
    let larger = dds.subscribe(&spec, KeptSamples::new()).unwrap();
    assert_eq!(dds.layout(larger), Some(another));
}

#[derive(Serialize, Deserialize)]
struct KeyedLong(u32);

impl Keyed for KeyedLong {
    type K = u32;
    fn key(&self) -> u32 {
        self.0
    }
}

fn unmatched() {
    let Subscribed { mut dds, sink, subscription, peer, .. } = subscribed("/keyed", Qos::Auto);
    let reliable = policies(true, false);
    let (name, type_name) = ("rt/keyed".to_owned(), "std_msgs::msg::dds_::String_".to_owned());
    let topic = peer.0.create_topic(name, type_name, &reliable, TopicKind::WithKey).unwrap();
    let publisher = peer.0.create_publisher(&reliable).unwrap();
    let _keyed = publisher.create_datawriter_cdr::<KeyedLong>(&topic, Some(reliable)).unwrap();
    warned(&dds, subscription, "of `/keyed` has a key, and nothing of it is received: publish");
    let other = peer.writer("/keyed", true, false);
    // By then RustDDS has matched both.
    sink.mark(&other, b"read");
    assert_eq!(connected(&dds, subscription, 1).qos.as_deref(), Some("reliable, volatile"));

    let xcdr2 = policies(true, false)
        .with_data_representation(DataRepresentation { value: vec![XCDR2_DATA_REPRESENTATION] });
    let subscription = dds.subscribe(&spec("/xcdr2", Qos::Auto), KeptSamples::new()).unwrap();
    let _xcdr2 = peer.writer_of::<Little>("rt/xcdr2", "std_msgs::msg::dds_::String_", &xcdr2);
    warned(&dds, subscription, "of `/xcdr2` offers only XCDR2, and nothing of it is received: let");
    assert_eq!(dds.status(subscription).writers, Some(0));
    let listed = |name: &str| dds.discovered().into_iter().find(|topic| topic.topic == name);
    assert_eq!(listed("/xcdr2").unwrap().qos, ["reliable, volatile, XCDR2: not received"]);
    let keyed = "reliable, volatile, with a key: not received";
    assert!(listed("/keyed").unwrap().qos.iter().any(|qos| qos == keyed));
}

fn not_messages() {
    let (domain, mut dds) = open();
    let peer = Peer::join(domain);
    for (name, package, type_name) in [
        ("/spin/_action/feedback", "nav2_msgs::action", "nav2_msgs/action/Spin_FeedbackMessage"),
        ("/add/_service_event", "car_msgs::srv", "car_msgs/srv/Add_Event"),
    ] {
        let sink = KeptSamples::new();
        let type_name = type_name.to_owned();
        let wanted = TopicSpec { type_name: type_name.clone(), ..spec(name, Qos::Auto) };
        let subscription = dds.subscribe(&wanted, sink.clone()).unwrap();
        let policies = policies(true, false);
        let leaf = type_name.rsplit_once('/').unwrap().1;
        let dds_type = format!("{package}::dds_::{leaf}_");
        let writer = peer.writer_of::<Little>(&format!("rt{name}"), &dds_type, &policies);
        connected(&dds, subscription, 1);
        matched(&writer);
        sink.mark(&writer, b"feedback");
        let topics = dds.topics();
        let found = topics.iter().find(|found| found.topic == name).unwrap();
        assert_eq!((&found.type_name, &found.definitions_text), (&type_name, &None));
        assert_eq!(dds.search_definitions(&type_name), DefinitionsSearch::Ended);
    }
}
