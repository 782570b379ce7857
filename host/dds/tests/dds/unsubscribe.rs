//! Tests of subscriptions that end.

use std::collections::HashSet;
use std::sync::Arc;

use gleaner_dds::{Dds, DdsOptions, Distro};
use gleaner_messages::transport::{LiveSource, Qos, ReceptionStatus, Subscription, Transport};

use super::Test;
use super::peer::{
    KeptSamples, Peer, Subscribed, connected, domain, matched, open, options, spec, subscribed,
    until, write,
};

pub const TESTS: &[Test] = &[
    ("an_ended_subscription_releases_its_reader_and_its_sink", ended),
    ("a_subscription_that_ends_does_not_disturb_the_others", others),
    ("a_topic_can_be_subscribed_again_and_gets_no_sample_twice", again),
    ("subscriptions_that_come_and_go_leave_nothing_in_the_domain", many),
    ("samples_from_before_the_match_are_counted", before_match),
];

fn ended() {
    let Subscribed { mut dds, sink, subscription, peer, .. } = subscribed("/ended", Qos::Auto);
    let writer = peer.writer("/ended", true, false);
    connected(&dds, subscription, 1);
    sink.mark(&writer, b"mark");
    dds.unsubscribe(subscription);
    assert_eq!(dds.status(subscription), ReceptionStatus::default());
    until("the end of the reader", || peer.0.discovered_readers().iter().all(not_ended));
    until("the end of the sink", || Arc::strong_count(&sink) == 1);
    // Ending it twice, or one that never was, is harmless.
    dds.unsubscribe(subscription);
    dds.unsubscribe(Subscription(99));
    assert_eq!(dds.health().dead, None);
}

fn not_ended(reader: &rustdds::discovery::DiscoveredReaderData) -> bool {
    reader.subscription_topic_data.topic_name() != "rt/ended"
}

fn others() {
    let (domain, mut dds) = open();
    let sinks = [(); 3].map(|()| KeptSamples::new());
    let [first, second, third] = ["/first", "/second", "/third"];
    let subscriptions = [0, 1, 2].map(|n: usize| {
        dds.subscribe(&spec([first, second, third][n], Qos::Auto), sinks[n].clone()).unwrap()
    });
    let peer = Peer::join(domain);
    let writers = [first, second, third].map(|topic| peer.writer(topic, true, false));
    for (subscription, writer) in subscriptions.iter().zip(&writers) {
        connected(&dds, *subscription, 1);
        matched(writer);
    }
    dds.unsubscribe(subscriptions[1]);
    // The number of an ended subscription is not given again.
    let later = KeptSamples::new();
    let fourth = dds.subscribe(&spec("/fourth", Qos::Auto), later.clone()).unwrap();
    assert_eq!(fourth, Subscription(3));
    for n in [0, 2] {
        write(&writers[n], b"after...");
        assert_eq!(sinks[n].bytes(1), [b"after..."]);
        assert_eq!(dds.status(subscriptions[n]).writers, Some(1));
    }
    let writer = peer.writer("/fourth", true, false);
    later.mark(&writer, b"later...");
    connected(&dds, fourth, 1);
}

fn again() {
    let (domain, mut dds) = open();
    let peer = Peer::join(domain);
    let writer = peer.writer("/again", true, false);
    let mut received = HashSet::new();
    for round in 0..20_u8 {
        let sink = KeptSamples::new();
        let subscription = dds.subscribe(&spec("/again", Qos::Auto), sink.clone()).unwrap();
        sink.mark(&writer, &[round; 4]);
        // RustDDS keeps the samples of the earlier subscriptions.
        for (meta, bytes) in sink.wait(1) {
            assert!(received.insert(meta.seq), "round {round}: {} again, {bytes:?}", meta.seq);
        }
        // While the reader of the subscription before ends, it may still receive samples for the
        // topic, and neither reader the next ones: these are lost, and no others.
        until("the count of lost samples", || {
            let seqs: Vec<u64> = sink.wait(1).iter().map(|(meta, _)| meta.seq).collect();
            let from_first = seqs.iter().filter(|seq| **seq >= seqs[0]);
            let sent = from_first.clone().max().map_or(0, |last| last - seqs[0] + 1);
            dds.status(subscription).lost == Some(sent - from_first.count() as u64)
        });
        dds.unsubscribe(subscription);
        until("the end of the sink", || Arc::strong_count(&sink) == 1);
        received.extend(sink.wait(1).iter().map(|(meta, _)| meta.seq));
    }
}

fn many() {
    let domain = domain();
    let mut dds = Dds::open(DdsOptions { distro: Some(Distro::Newer), ..options(domain) }).unwrap();
    let peer = Peer::join(domain);
    let writers: Vec<_> =
        (0..20).map(|n| peer.writer(&format!("/many_{n}"), true, false)).collect();
    for _ in 0..5 {
        let sinks: Vec<_> = writers.iter().map(|_| KeptSamples::new()).collect();
        let subscriptions: Vec<_> = (0..writers.len())
            .map(|n| {
                dds.subscribe(&spec(&format!("/many_{n}"), Qos::Auto), sinks[n].clone()).unwrap()
            })
            .collect();
        for (sink, writer) in sinks.iter().zip(&writers) {
            sink.mark(writer, b"mark");
        }
        subscriptions.into_iter().for_each(|subscription| dds.unsubscribe(subscription));
        until("the end of the sinks", || sinks.iter().all(|sink| Arc::strong_count(sink) == 1));
    }
    let is_ours = |topic: &str| topic.starts_with("rt/many_");
    until("the end of the readers", || {
        !peer
            .0
            .discovered_readers()
            .iter()
            .any(|reader| is_ours(reader.subscription_topic_data.topic_name()))
    });
}

fn before_match() {
    let Subscribed { dds, sink, subscription, peer, .. } = subscribed("/early", Qos::Auto);
    let writer = peer.writer("/early", true, false);
    sink.mark(&writer, b"mark");
    write(&writer, b"next");
    sink.wait(2);
    // The writer may still have kept its first samples.
    let sent = sink.wait(1)[0].0.seq - 1;
    until("the count", || {
        let before = dds.status(subscription).before_match;
        before.is_some_and(|before| before <= sent && (before > 0) == (sent > 0))
    });
    assert_eq!(dds.status(subscription).lost, Some(0));
}
