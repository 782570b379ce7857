//! Tests of the list of topics in a domain.

use gleaner_dds::{Dds, DdsOptions, Distro};
use gleaner_messages::transport::{Qos, Transport, TransportError};

use super::Test;
use super::peer::{KeptSamples, Little, Peer, domain, open, options, policies, spec, until};

pub const TESTS: &[Test] = &[
    ("topics_of_others_are_listed_with_types_definitions_and_offers", listed),
    ("definitions_are_found_by_the_type_of_a_subscription_or_of_a_writer", definitions),
    ("hostile_names_are_shown_escaped", hostile_names),
    ("only_the_named_interfaces_are_used_and_samples_still_arrive", interfaces),
];

fn listed() {
    let domain = domain();
    let dds = Dds::open(DdsOptions { distro: Some(Distro::Humble), ..options(domain) }).unwrap();
    let peer = Peer::join(domain);
    let _chatter = peer.writer("/chatter", true, false);
    let _strange = peer.writer_of::<Little>("rt/any", "Shape", &policies(false, true));
    let _reader = peer.reader("rt/chatter", "std_msgs::msg::dds_::String_", &policies(true, false));
    let _own = dds.writer("/own", "std_msgs/msg/String", 1).unwrap();
    until("all of them", || {
        dds.discovered().iter().map(|topic| topic.writers + topic.readers).sum::<usize>() == 3
    });
    let [any, chatter] = &dds.discovered()[..] else { panic!("{:?}", dds.discovered()) };
    let expected = ("/any", "Shape", 1, 0);
    assert_eq!((any.topic.as_str(), any.type_name.as_str(), any.writers, any.readers), expected);
    assert_eq!(any.qos, ["best effort, transient local"]);
    let expected = ("std_msgs/msg/String", 1, 1);
    assert_eq!((chatter.type_name.as_str(), chatter.writers, chatter.readers), expected);
    until("our entry in the graph", || dds.graph().starts_with("listed"));
    let topics = dds.topics();
    assert_eq!((topics[0].definitions_text.as_deref(), topics[0].messages), (None, None));
    assert!(topics[1].definitions_text.as_deref().unwrap().contains("string data"));
    let qos = topics[1].offered_qos.as_deref().unwrap();
    assert!(qos.contains("reliability: 1\n  durability: 2\n"), "{qos}");
}

fn definitions() {
    let (domain, mut dds) = open();
    dds.subscribe(&spec("/subscribed", Qos::Auto), KeptSamples::new()).unwrap();
    let first = dds.definitions("/subscribed").unwrap();
    let second = dds.definitions("/subscribed").unwrap();
    assert!(std::sync::Arc::ptr_eq(&first, &second), "all share them");
    assert!(matches!(dds.definitions("/subscribet"), Err(TransportError::NoSuchTopic { .. })));
    let peer = Peer::join(domain);
    let _strange = peer.writer_of::<Little>("rt/any", "Shape", &policies(true, false));
    let _chatter = peer.writer("/chatter", true, false);
    until("both", || dds.discovered().len() == 2);
    assert!(first.is_equivalent(&dds.definitions("/chatter").unwrap()), "it is the same type");
    let found = dds.definitions("/any");
    let Err(TransportError::NoDefinitions { type_name, .. }) = found else { panic!("{found:?}") };
    assert_eq!(type_name, "Shape");
}

fn hostile_names() {
    let (domain, dds) = open();
    let peer = Peer::join(domain);
    let long = format!("rt/{}", "n".repeat(2000));
    let _both = [("rt/\u{1b}[2J", "x\ny"), (long.as_str(), "x")].map(|(topic, type_name)| {
        peer.writer_of::<Little>(topic, type_name, &policies(true, false))
    });
    until("both", || dds.discovered().len() == 2);
    let found = dds.discovered();
    assert_eq!((found[0].topic.as_str(), found[0].type_name.as_str()), ("/\\u{1b}[2J", "x\\u{a}y"));
    assert!(found[1].topic.len() <= 256);
}

fn interfaces() {
    let domain = domain();
    let here = vec![std::net::Ipv4Addr::LOCALHOST.into()];
    let mut dds = Dds::open(DdsOptions { interfaces: here, ..options(domain) }).unwrap();
    let sink = KeptSamples::new();
    dds.subscribe(&spec("/here", Qos::Auto), sink.clone()).unwrap();
    let peer = Peer::join(domain);
    let writer = peer.writer("/here", true, false);
    sink.mark(&writer, b"here");
}
