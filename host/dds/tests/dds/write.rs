//! Tests of writers.

use super::Test;
use super::peer::{Peer, domain, open, policies, take, until};

pub const TESTS: &[Test] = &[
    ("written_bytes_arrive_unchanged_and_readers_are_counted", written),
    ("a_writer_may_outlive_the_participant", outlives),
];

fn written() {
    let domain = domain();
    let dds = open(domain);
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
    assert!(
        came.iter().enumerate().all(|(n, bytes)| *bytes == [n as u8; 332]),
        "in order, unchanged"
    );
    drop(reader);
    until("no reader", || writer.readers() == 0);
}

fn outlives() {
    let dds = open(domain());
    let writer = dds.writer("/event", "std_msgs/msg/String", 10).unwrap();
    drop(dds);
    // The result does not matter, but the call must return.
    drop(writer.write(b"no reader..."));
    assert_eq!(writer.readers(), 0);
}
