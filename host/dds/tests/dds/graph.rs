//! Tests of our node in the ROS 2 graph, read by an independent parser.

use gleaner_dds::{Dds, DdsOptions, Distro};
use gleaner_messages::transport::{LiveSource, Transport};
use rustdds::RTPSEntity;

use super::Test;
use super::peer::{
    KeptSamples, LittleWriter, Peer, connected, domain, options, policies, spec, take, until, write,
};

pub const TESTS: &[Test] = &[
    ("nothing_is_sent_to_the_graph_before_a_node_is_seen", silent),
    ("we_are_listed_with_24_bytes_among_nodes_of_humble", || listed(Distro::Humble)),
    ("we_are_listed_with_16_bytes_among_newer_nodes", || listed(Distro::Newer)),
    ("we_withdraw_when_nodes_of_both_kinds_are_seen", both),
    ("we_stay_unlisted_when_the_configured_distribution_is_wrong", wrong_distro),
];

const TOPIC: &str = "ros_discovery_info";
const TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";

/// The graph message of a node without endpoints.
fn message_of_a_node(gid: usize) -> Vec<u8> {
    let mut cdr = vec![9; 16];
    cdr.resize(gid, 0);
    cdr.extend_from_slice(&[1, 0, 0, 0, 2, 0, 0, 0, b'/', 0, 0, 0, 5, 0, 0, 0]);
    cdr.extend_from_slice(b"node\0\0\0\0");
    cdr.extend_from_slice(&[0; 8]);
    cdr
}

fn announce(peer: &Peer, gid: usize) -> LittleWriter {
    let writer = peer.writer_of(TOPIC, TYPE, &policies(true, true));
    write(&writer, &message_of_a_node(gid));
    writer
}

#[derive(Debug, PartialEq, Eq)]
struct ParsedMessage {
    participant: Vec<u8>,
    nodes: Vec<ParsedNode>,
}

#[derive(Debug, PartialEq, Eq)]
struct ParsedNode {
    namespace: String,
    name: String,
    readers: Vec<Vec<u8>>,
    writers: Vec<Vec<u8>>,
}

/// Parses a message with GIDs of `gid` bytes; all bytes have to be used up.
fn parse(cdr: &[u8], gid: usize) -> Option<ParsedMessage> {
    let mut at = 0;
    let mut bytes = |n: usize, align: usize| {
        at += (align - at % align) % align;
        let taken = cdr.get(at..at + n)?.to_vec();
        at += n;
        Some(taken)
    };
    let participant = bytes(gid, 1)?;
    let mut nodes = Vec::new();
    let number =
        |four: Vec<u8>| four.iter().rev().fold(0, |sum, byte| sum * 256 + usize::from(*byte));
    for _ in 0..number(bytes(4, 4)?) {
        let mut texts = Vec::new();
        let mut lists = Vec::new();
        for _ in 0..2 {
            let length = number(bytes(4, 4)?);
            texts
                .push(String::from_utf8(bytes(length, 1)?).ok()?.trim_end_matches('\0').to_owned());
        }
        for _ in 0..2 {
            let count = number(bytes(4, 4)?);
            lists.push((0..count).map(|_| bytes(gid, 1)).collect::<Option<Vec<_>>>()?);
        }
        let (name, namespace) = (texts.pop()?, texts.pop()?);
        let (writers, readers) = (lists.pop()?, lists.pop()?);
        nodes.push(ParsedNode { namespace, name, readers, writers });
    }
    (at == cdr.len()).then_some(ParsedMessage { participant, nodes })
}

fn open(distro: Option<Distro>) -> (u16, Dds) {
    let domain = domain();
    (domain, Dds::open(DdsOptions { distro, ..options(domain) }).unwrap())
}

fn silent() {
    let (domain, dds) = open(None);
    let peer = Peer::join(domain);
    let reader = peer.reader(TOPIC, TYPE, &policies(true, true));
    until("the other participant", || dds.health().network.unwrap().participants == 1);
    let _other = peer.writer("/other", true, false);
    until("the other's topic", || !dds.discovered().is_empty());
    assert_eq!(dds.graph(), "not listed: no ROS 2 node seen yet");
    assert_eq!(take(&reader), None);
}

fn listed(distro: Distro) {
    let gid = if distro == Distro::Humble { 24 } else { 16 };
    let (domain, mut dds) = open(None);
    let peer = Peer::join(domain);
    let reader = peer.reader(TOPIC, TYPE, &policies(true, true));
    let subscription = dds
        .subscribe(&spec("/imu", gleaner_messages::transport::Qos::Auto), KeptSamples::new())
        .unwrap();
    let imu = peer.writer("/imu", true, false);
    connected(&dds, subscription, 1);
    let out = dds.writer("/out", "std_msgs/msg/String", 5).unwrap();
    let _node = announce(&peer, gid);

    // The last message: with one reader and one writer.
    let own = imu.guid().prefix;
    let mut last = None;
    until("our entry", || {
        while let Some(message) = take(&reader) {
            let message = parse(&message, gid).expect("a valid message");
            last = (message.participant[..12] != imu.guid().to_bytes()[..12])
                .then_some(message)
                .or(last.take());
        }
        last.as_ref()
            .is_some_and(|message| message.nodes.len() == 1 && message.nodes[0].writers.len() == 1)
    });
    let message = last.take().unwrap();
    let ParsedNode { namespace, name, readers, writers } = &message.nodes[0];
    assert_eq!((namespace.as_str(), name.as_str()), ("/gleaner", "test"));
    assert_eq!((readers.len(), writers.len()), (1, 1));
    let found = peer.0.discovered_writers();
    let found =
        found.iter().find(|writer| writer.publication_topic_data.topic_name == "rt/out").unwrap();
    let guid = found.writer_proxy.remote_writer_guid;
    assert_ne!(guid.prefix, own);
    assert_eq!(writers[0][..16], guid.to_bytes());
    assert_eq!(message.participant[..12], guid.to_bytes()[..12]);
    assert_eq!(message.participant[12..16], [0, 0, 1, 0xc1]);
    assert!(writers[0][16..].iter().chain(&message.participant[16..]).all(|byte| *byte == 0));
    assert!(dds.graph().starts_with("listed as `/gleaner/test`"));

    // An endpoint that goes is withdrawn, and with the participant the node.
    drop(out);
    until("our next entry", || {
        let message = take(&reader).and_then(|message| parse(&message, gid));
        message.is_some_and(|message| {
            message.nodes[0].name == "test" && message.nodes[0].writers.is_empty()
        })
    });
    drop(dds);
    until("our end", || {
        peer.0
            .discovered_writers()
            .iter()
            .all(|writer| writer.writer_proxy.remote_writer_guid.prefix == own)
    });
}

fn both() {
    let (domain, dds) = open(None);
    let (old, new) = (Peer::join(domain), Peer::join(domain));
    let reader = old.reader(TOPIC, TYPE, &policies(true, true));
    let _old = announce(&old, 24);
    until("being listed", || dds.graph().starts_with("listed"));
    let _new = announce(&new, 16);
    until("being unlisted", || dds.graph().contains("Humble and of newer"));
    until("the withdrawal", || {
        take(&reader).is_some_and(|message| {
            parse(&message, 24).is_some_and(|message| message.nodes.is_empty())
        })
    });
    let graph_writers = |peer: &Peer| {
        let info = peer.0.discovered_writers();
        info.iter().filter(|writer| writer.publication_topic_data.topic_name == TOPIC).count()
    };
    // Two peers, each of which discovers the other.
    until("our writer's end", || graph_writers(&old) <= 2 && graph_writers(&new) <= 2);
}

fn wrong_distro() {
    for (configured, gid) in [(Distro::Humble, 16), (Distro::Newer, 24)] {
        let (domain, dds) = open(Some(configured));
        until("being listed", || dds.graph().starts_with("listed"));
        let peer = Peer::join(domain);
        let _node = announce(&peer, gid);
        until("being unlisted", || dds.graph().starts_with("not listed: ROS_DISTRO is"));
    }
}
