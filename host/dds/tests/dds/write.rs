//! Tests of writers.

use rustdds::{GUID, RTPSEntity};

use super::Test;
use super::peer::{Peer, open, policies, take, until};
use super::type_query::{announce, announcement};

pub const TESTS: &[Test] = &[
    ("written_bytes_arrive_unchanged_and_readers_are_counted", written),
    ("messages_that_a_reader_does_not_acknowledge_are_limited", unacknowledged),
    ("a_writer_may_outlive_the_participant", outlives),
];

fn written() {
    let (domain, dds) = open();
    let writer = dds.writer("/event", "std_msgs/msg/String", 50).unwrap();
    assert_eq!(writer.readers(), 0);
    writer.write(b"no reader...").unwrap();
    let peer = Peer::join(domain);
    let reader = peer.reader("rt/event", "std_msgs::msg::dds_::String_", &policies(true, false));
    until("a reader", || writer.readers() == 1);
    for n in 0..50 {
        writer.write(&[n; 332]).unwrap();
    }
    let mut came = Vec::new();
    until("all", || {
        came.extend(take(&reader));
        came.len() == 50
    });
    let is_right = |(n, bytes): (usize, &Vec<u8>)| *bytes == [n as u8; 332];
    assert!(came.iter().enumerate().all(is_right), "in order, unchanged");
    drop(reader);
    until("no reader", || writer.readers() == 0);
}

/// A reader that exists only in its announcement acknowledges nothing.
fn unacknowledged() {
    let (domain, dds) = open();
    let writer = dds.writer("/event", "std_msgs/msg/String", 300).unwrap();
    let peer = Peer::join(domain);
    let _ready = peer.writer("/ready", true, false);
    until("the peer", || dds.discovered().iter().any(|topic| topic.topic == "/ready"));
    let prefix = peer.0.guid().to_bytes();
    let guid = [&prefix[..12], &[9, 9, 9, 4]].concat();
    let guid = GUID::from_bytes(guid.try_into().unwrap());
    // Sequence numbers that were used are ignored.
    let again = |seq| announcement(guid, seq, "rt/event", "std_msgs::msg::dds_::String_", "");
    announce(domain, (1..20).map(again));
    until("a reader", || writer.readers() == 1);
    let sent = (0..9000).take_while(|_| writer.write(&[1; 8]).is_ok()).count();
    assert_eq!(sent, 300);
}

fn outlives() {
    let (_, dds) = open();
    let writer = dds.writer("/event", "std_msgs/msg/String", 10).unwrap();
    drop(dds);
    // The result does not matter, but the call must return.
    drop(writer.write(b"no reader..."));
    assert_eq!(writer.readers(), 0);
}
