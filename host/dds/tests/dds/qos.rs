//! Tests of offered and requested quality of service.

use gleaner_messages::transport::{Qos, Transport};
use rustdds::RTPSEntity;

use super::Test;
use super::hostile::{LITTLE, data, send};
use super::peer::{
    KeptSamples, Little, Peer, Subscribed, connected, domain, matched, open, open_in, policies,
    spec, subscribed, until, write,
};

pub const TESTS: &[Test] = &[
    ("auto_requests_what_the_first_writer_offers_and_less_when_another_offers_less", auto_adapts),
    ("auto_gets_the_samples_kept_for_late_readers", auto_transient_local),
    ("auto_requests_more_again_when_all_writers_are_gone", auto_recovers),
    ("a_fixed_request_that_a_writer_does_not_satisfy_is_a_warning", fixed_does_not_fit),
    ("a_writer_of_another_type_is_a_warning_and_its_samples_are_skipped", another_type),
    ("a_sequence_number_far_ahead_hides_no_sample_from_a_new_reader", far_ahead),
];

fn auto_adapts() {
    let Subscribed { domain, dds, sink, subscription, peer } = subscribed("/mixed", Qos::Auto);
    assert_eq!(dds.status(subscription).qos, None, "no writer yet");
    let reliable = peer.writer("/mixed", true, false);
    assert_eq!(connected(&dds, subscription, 1).qos.as_deref(), Some("reliable, volatile"));
    matched(&reliable);
    for n in 0..10 {
        write(&reliable, &[n; 4]);
    }
    sink.wait(10);

    let other = Peer::join(domain);
    let best_effort = other.writer("/mixed", false, false);
    let status = connected(&dds, subscription, 2);
    assert_eq!(status.qos.as_deref(), Some("best effort, volatile"));
    sink.mark(&best_effort, b"from the second.");
    sink.mark(&reliable, b"from the first..");
    let samples = sink.bytes(12);
    for n in 0..10 {
        let count = samples.iter().filter(|bytes| **bytes == [n; 4]).count();
        assert_eq!(count, 1, "no sample arrives twice");
    }
    let qos_warnings = dds.status(subscription).qos_warnings;
    let differ = |line: &String| line.contains("differ") && line.contains("best effort, volatile");
    assert!(qos_warnings.iter().any(differ), "{qos_warnings:?}");
    assert!(qos_warnings.iter().any(|line| line.contains("re-subscribed")), "{qos_warnings:?}");
}

fn auto_transient_local() {
    let domain = domain();
    let peer = Peer::join(domain);
    let writer = peer.writer("/map", true, true);
    for n in 0..5 {
        write(&writer, &[n; 4]);
    }
    let mut dds = open_in(domain);
    let sink = KeptSamples::new();
    let subscription = dds.subscribe(&spec("/map", Qos::Auto), sink.clone()).unwrap();
    assert_eq!(sink.bytes(5), (0..5).map(|n| vec![n; 4]).collect::<Vec<_>>());
    assert_eq!(dds.status(subscription).qos.as_deref(), Some("reliable, transient local"));
    // The same for a subscription that is made when RustDDS already has these samples.
    let late = KeptSamples::new();
    dds.subscribe(&spec("/map", Qos::Auto), late.clone()).unwrap();
    assert_eq!(late.bytes(5), (0..5).map(|n| vec![n; 4]).collect::<Vec<_>>());
}

fn auto_recovers() {
    let Subscribed { dds, sink, subscription, peer, .. } = subscribed("/driver", Qos::Auto);
    let weak = peer.writer("/driver", false, false);
    assert_eq!(connected(&dds, subscription, 1).qos.as_deref(), Some("best effort, volatile"));
    let strong = peer.writer("/driver", true, false);
    // One that offers more is no reason to lose samples.
    assert_eq!(connected(&dds, subscription, 2).qos.as_deref(), Some("best effort, volatile"));
    drop((weak, strong));
    connected(&dds, subscription, 0);
    // Not before all writers are seen to be gone, for which there is no event.
    let mut strong = None;
    until("a stronger request", || {
        drop(strong.take());
        connected(&dds, subscription, 0);
        strong = Some(peer.writer("/driver", true, false));
        connected(&dds, subscription, 1).qos.as_deref() == Some("reliable, volatile")
    });
    let strong = strong.unwrap();
    sink.mark(&strong, b"received");
}

fn fixed_does_not_fit() {
    let (domain, mut dds) = open();
    let qos = Qos::Fixed { reliable: true, transient_local: false, depth: 5 };
    let subscription = dds.subscribe(&spec("/strict", qos), KeptSamples::new()).unwrap();
    let peer = Peer::join(domain);
    let _writer = peer.writer("/strict", false, false);
    until("qos_warnings", || !dds.status(subscription).qos_warnings.is_empty());
    let status = dds.status(subscription);
    let [line] = status.qos_warnings.as_slice() else { panic!("{:?}", status.qos_warnings) };
    assert!(line.contains("`/strict` offers best effort, but reliable is requested"), "{line}");
    assert_eq!((status.writers, status.qos.as_deref()), (Some(0), Some("reliable, volatile")));
}

fn another_type() {
    let Subscribed { dds, sink, subscription, peer, .. } = subscribed("/typed", Qos::Auto);
    let same = peer.writer("/typed", true, false);
    connected(&dds, subscription, 1);
    let policies = policies(true, false);
    let other = peer.writer_of::<Little>("rt/typed", "sensor_msgs::msg::dds_::Imu_", &policies);
    matched(&other);
    // At once, before its type was looked up.
    write(&other, b"of the other");
    let skipped = "1 sample of `/typed` skipped: another type";
    until("qos_warnings", || {
        dds.status(subscription).qos_warnings.iter().any(|line| line == skipped)
    });
    let qos_warnings = dds.status(subscription).qos_warnings;
    let expected = "sends `sensor_msgs/msg/Imu`, not `std_msgs/msg/String`";
    assert!(qos_warnings[0].contains(expected), "{qos_warnings:?}");
    sink.mark(&same, b"correct.");
    assert!(sink.bytes(1).iter().all(|bytes| bytes == b"correct."));
}

fn far_ahead() {
    let Subscribed { domain, dds, sink, subscription, peer } = subscribed("/far", Qos::Auto);
    let writer = peer.writer("/far", false, true);
    let status = connected(&dds, subscription, 1);
    assert_eq!(status.qos.as_deref(), Some("best effort, transient local"));
    matched(&writer);
    write(&writer, b"1...");
    sink.wait(1);
    send(domain, &data(writer.guid(), 1 << 40, b"far.", LITTLE));
    sink.wait(2);
    let _less = peer.writer("/far", false, false);
    assert_eq!(connected(&dds, subscription, 2).qos.as_deref(), Some("best effort, volatile"));
    sink.mark(&writer, b"near");
    assert!(sink.bytes(3)[2..].iter().all(|bytes| bytes == b"near"), "nothing arrives twice");
}
