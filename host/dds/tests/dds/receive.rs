//! Tests of the delivery of samples to a sink.

use std::sync::{Arc, Mutex};

use bytes::Bytes;
use gleaner_messages::Endian;
use gleaner_messages::transport::{
    Delivery, Guid, LiveSource, Qos, SampleMeta, Sink, TopicSpec, Transport,
};
use rustdds::{RTPSEntity, Timestamp};

use super::Test;
use super::peer::{
    Big, KeptSamples, Parameters, Peer, Subscribed, connected, matched, open, policies, spec,
    subscribed, until, write,
};

pub const TESTS: &[Test] = &[
    ("samples_arrive_complete_with_writer_and_time", samples_arrive),
    ("a_sample_of_many_fragments_arrives_complete", fragments),
    ("the_first_fragmented_sample_arrives_without_retransmission", first_fragments),
    ("a_sink_that_can_copy_gets_the_bytes_once", copied),
    ("a_sink_that_panics_while_it_copies_is_reported_and_other_topics_go_on", panics_in_copy),
    ("the_byte_order_of_each_sample_is_detected", byte_order),
    ("a_sample_in_an_unsupported_encoding_is_counted_and_the_next_arrives", malformed),
    ("two_subscriptions_of_a_topic_both_get_every_sample", two_subscriptions),
    ("invalid_names_are_refused", bad_names),
    ("a_writer_that_is_recreated_a_hundred_times_is_received_each_time", recreated),
];

const FIXED: Qos = Qos::Fixed { reliable: true, transient_local: false, depth: 10 };

fn samples_arrive() {
    let Subscribed { dds, sink, subscription, peer, .. } = subscribed("/imu/data", FIXED);
    let writer = peer.writer("/imu/data", true, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    // 2.5 s after 1970.
    let stamp = Timestamp::from_ticks(2 << 32 | 1 << 31);
    writer.write(Bytes::from(vec![7; 324]), Some(stamp)).unwrap();
    write(&writer, b"the second..");
    let samples = sink.wait(2);
    let (first, bytes) = &samples[0];
    assert_eq!(*bytes, [7; 324]);
    assert_eq!((first.seq, first.publish_ns, first.options), (1, 2_500_000_000, [0, 0]));
    assert_eq!((first.writer, first.endian), (Guid(writer.guid().to_bytes()), Endian::Little));
    let (second, bytes) = &samples[1];
    assert_eq!((second.seq, second.writer), (2, first.writer));
    assert_eq!(bytes.as_slice(), b"the second..");
    assert!(second.at_ns > first.at_ns && first.at_ns > 0);
    let status = dds.status(subscription);
    assert_eq!((status.writers, status.lost, status.malformed), (Some(1), Some(0), 0));
    assert_eq!(status.qos.as_deref(), Some("reliable, volatile"));
    assert!(status.qos_warnings.is_empty(), "{:?}", status.qos_warnings);
    drop(writer);
    connected(&dds, subscription, 0);
}

fn fragments() {
    let Subscribed { dds, sink, subscription, peer, .. } = subscribed("/image", FIXED);
    let writer = peer.writer("/image", true, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    let image: Vec<u8> = (0..1_000_004_u32).map(|n| (n % 251) as u8).collect();
    write(&writer, &image);
    assert!(sink.bytes(1)[0] == image);
    // The next sample has its own size.
    write(&writer, b"small one...");
    assert_eq!(sink.bytes(2)[1], b"small one...");
}

fn first_fragments() {
    let Subscribed { dds: _dds, sink, peer, .. } = subscribed("/image", Qos::Auto);
    let writer = peer.writer("/image", false, false);
    matched(&writer);
    write(&writer, &[7; 100_000]);
    assert!(sink.bytes(1)[0] == [7; 100_000]);
}

/// A sink that copies at once, and refuses samples of more than 8 bytes.
#[derive(Default)]
struct Copies {
    copied: Mutex<Option<Vec<u8>>>,
    accepted: Mutex<Vec<(u64, Option<Vec<u8>>)>>,
}

impl Sink for Copies {
    fn deliver(&self, _: &SampleMeta, _: &[u8]) -> Delivery {
        unreachable!("it copies")
    }

    fn copy(&self, cdr: &[u8]) -> Option<Delivery> {
        let taken = (cdr.len() <= 8).then(|| cdr.to_vec());
        let delivery = if taken.is_some() { Delivery::Taken } else { Delivery::TooBig };
        *self.copied.lock().unwrap() = taken;
        Some(delivery)
    }

    fn accept(&self, meta: &SampleMeta) {
        self.accepted.lock().unwrap().push((meta.seq, self.copied.lock().unwrap().take()));
    }
}

fn copied() {
    let (domain, mut dds) = open();
    let sink = Arc::new(Copies::default());
    let subscription = dds.subscribe(&spec("/copied", FIXED), sink.clone()).unwrap();
    let peer = Peer::join(domain);
    let writer = peer.writer("/copied", true, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    for bytes in [b"1...".as_slice(), b"2 is too long...", b"3......."] {
        write(&writer, bytes);
    }
    until("all", || sink.accepted.lock().unwrap().len() == 3);
    let accepted = sink.accepted.lock().unwrap();
    let expected = [(1, Some(b"1...".to_vec())), (2, None), (3, Some(b"3.......".to_vec()))];
    assert_eq!(*accepted, expected);
}

struct PanicsInCopy;

impl Sink for PanicsInCopy {
    fn deliver(&self, _: &SampleMeta, _: &[u8]) -> Delivery {
        unreachable!("it copies")
    }

    fn copy(&self, _: &[u8]) -> Option<Delivery> {
        panic!("this sink was meant to panic")
    }
}

fn panics_in_copy() {
    let (domain, mut dds) = open();
    let (first, second) = (KeptSamples::new(), KeptSamples::new());
    let bad = dds.subscribe(&spec("/both", FIXED), Arc::new(PanicsInCopy)).unwrap();
    let good = dds.subscribe(&spec("/both", FIXED), first.clone()).unwrap();
    dds.subscribe(&spec("/other", FIXED), second.clone()).unwrap();
    let peer = Peer::join(domain);
    let (writer, other) = (peer.writer("/both", true, false), peer.writer("/other", true, false));
    connected(&dds, bad, 1);
    connected(&dds, good, 1);
    // The first also shows that RustDDS goes on: both read under the lock of the same topic.
    first.mark(&writer, b"1...");
    second.mark(&other, b"2...");
    until("death", || dds.health().dead.is_some());
    let dead = dds.health().dead.unwrap();
    assert_eq!(dead, "the sink of topic `/both` panicked: this sink was meant to panic");
    first.mark(&writer, b"3...");
}

fn byte_order() {
    let Subscribed { dds, sink, subscription, peer, .. } = subscribed("/big", FIXED);
    let policies = policies(true, false);
    let writer = peer.writer_of::<Big>("rt/big", "std_msgs::msg::dds_::String_", &policies);
    connected(&dds, subscription, 1);
    matched(&writer);
    write(&writer, &[0, 0, 0, 1]);
    let (meta, bytes) = &sink.wait(1)[0];
    assert_eq!((meta.endian, bytes.as_slice()), (Endian::Big, [0, 0, 0, 1].as_slice()));
}

fn malformed() {
    let Subscribed { dds, sink, subscription, peer, .. } = subscribed("/odd", FIXED);
    let policies = policies(true, false);
    let odd = peer.writer_of::<Parameters>("rt/odd", "std_msgs::msg::dds_::String_", &policies);
    let good = peer.writer("/odd", true, false);
    connected(&dds, subscription, 2);
    matched(&odd);
    matched(&good);
    for _ in 0..3 {
        write(&odd, b"what is this");
    }
    until("malformed samples", || dds.status(subscription).malformed == 3);
    write(&good, b"good");
    assert_eq!(sink.bytes(1), [b"good"]);
    assert_eq!(dds.health().dead, None);
}

fn two_subscriptions() {
    let (domain, mut dds) = open();
    let (first, second) = (KeptSamples::new(), KeptSamples::new());
    let subscription = dds.subscribe(&spec("/both", FIXED), first.clone()).unwrap();
    let peer = Peer::join(domain);
    let writer = peer.writer("/both", true, false);
    connected(&dds, subscription, 1);
    matched(&writer);
    write(&writer, b"before..");
    first.wait(1);
    let later = dds.subscribe(&spec("/both", FIXED), second.clone()).unwrap();
    connected(&dds, later, 1);
    matched(&writer);
    (0..20_u8).for_each(|n| write(&writer, &[n; 4]));
    assert_eq!(first.bytes(21).len(), 21);
    let expected: Vec<Vec<u8>> = (0..20).map(|n| vec![n; 4]).collect();
    assert_eq!(second.bytes(20), expected, "samples from before the subscription are skipped");
}

fn bad_names() {
    let (_, mut dds) = open();
    for (topic, type_name) in
        [("no_slash", "a/msg/B"), ("/a b", "a/msg/B"), ("/a", "B"), ("/a", "a/msg/B\n")]
    {
        let names = TopicSpec {
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            ..spec("/a", FIXED)
        };
        assert!(dds.subscribe(&names, KeptSamples::new()).is_err(), "{topic} {type_name:?}");
        assert!(dds.writer(topic, type_name, 1).is_err(), "{topic} {type_name:?}");
    }
}

fn recreated() {
    let Subscribed { dds, sink, subscription, peer, .. } = subscribed("/again", Qos::Auto);
    for round in 0..100_u8 {
        let writer = peer.writer("/again", round % 2 == 0, false);
        connected(&dds, subscription, 1);
        sink.mark(&writer, &[round; 4]);
        drop(writer);
        connected(&dds, subscription, 0);
    }
}
