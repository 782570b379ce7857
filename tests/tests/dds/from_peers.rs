//! Gleaner receives the messages that peers write.

use std::collections::BTreeSet;

use gleaner_messages::transport::{Qos, Transport};
use gleaner_tests::peers::message::MessageType;
use gleaner_tests::peers::{Peer, PeerKind};
use libtest_mimic::Failed;

use crate::receiver::{ReceivedSample, TopicReceiver, join, number};
use crate::{DdsCase, Need, case};

const CYCLONE: &[Need] = &[Need::Peer(PeerKind::Cyclone)];
const FAST: &[Need] = &[Need::Peer(PeerKind::Fast)];

pub const CASES: &[DdsCase] = &[
    case("an_imu_of_cyclone_arrives_complete", CYCLONE, || imu(PeerKind::Cyclone)),
    case("an_imu_of_fast_dds_arrives_complete", FAST, || imu(PeerKind::Fast)),
    case("an_imu_of_python_arrives_complete", &[Need::Peer(PeerKind::Python)], || {
        imu(PeerKind::Python)
    }),
    case("images_of_cyclone_in_1080p_arrive_complete", CYCLONE, || images(PeerKind::Cyclone)),
    case("images_of_fast_dds_in_1080p_arrive_complete", FAST, || images(PeerKind::Fast)),
    case("compressed_images_of_cyclone_arrive_complete", CYCLONE, || compressed(PeerKind::Cyclone)),
    case("compressed_images_of_fast_dds_arrive_complete", FAST, || compressed(PeerKind::Fast)),
    case("point_clouds_of_cyclone_arrive_complete", CYCLONE, || clouds(PeerKind::Cyclone)),
    case("point_clouds_of_fast_dds_arrive_complete", FAST, || clouds(PeerKind::Fast)),
    case("samples_of_a_best_effort_writer_are_received", CYCLONE, best_effort),
    case("earlier_samples_of_a_transient_local_writer_are_received", CYCLONE, transient_local),
    case("writers_with_different_qos_are_both_received", CYCLONE, mixed),
    case("a_publisher_that_is_killed_and_restarted_is_received_again", CYCLONE, restarts),
];

fn imu(kind: PeerKind) -> Result<(), Failed> {
    complete(kind, MessageType::Imu, 200, 100)
}

fn images(kind: PeerKind) -> Result<(), Failed> {
    complete(kind, MessageType::Image { width: 1920, height: 1080 }, 20, 10)
}

fn compressed(kind: PeerKind) -> Result<(), Failed> {
    complete(kind, MessageType::CompressedImage(200_000), 100, 30)
}

fn clouds(kind: PeerKind) -> Result<(), Failed> {
    complete(kind, MessageType::PointCloud2(1 << 20), 50, 10)
}

fn complete(kind: PeerKind, ty: MessageType, count: u32, rate_hz: u32) -> Result<(), Failed> {
    let mut dds = join(None)?;
    let receiver = TopicReceiver::new(&mut dds, ty, "/sensor", Qos::Auto)?;
    let _peer =
        Peer::start(kind.publisher(ty, "/sensor", &format!("--count {count} --rate {rate_hz}")));
    receiver.all(&dds, count)
}

fn best_effort() -> Result<(), Failed> {
    let mut dds = join(None)?;
    let receiver = TopicReceiver::new(&mut dds, MessageType::Imu, "/sensor", Qos::Auto)?;
    let options = "--count 0 --rate 100 --reliability best_effort";
    let _peer = Peer::start(PeerKind::Cyclone.publisher(MessageType::Imu, "/sensor", options));
    // The first ones may be sent before the connection: they are not sent again.
    let samples =
        receiver.wait("messages of a best-effort writer", |samples| samples.len() >= 100)?;
    receiver.in_order(samples.iter().take(100), number(&samples[0]))
}

fn transient_local() -> Result<(), Failed> {
    let options = "--count 7 --rate 100 --durability transient_local --readers 0";
    let mut peer = Peer::start(PeerKind::Cyclone.publisher(MessageType::Imu, "/sensor", options));
    peer.written()?;
    let mut dds = join(None)?;
    let receiver = TopicReceiver::new(&mut dds, MessageType::Imu, "/sensor", Qos::Auto)?;
    receiver.all(&dds, 7)
}

fn mixed() -> Result<(), Failed> {
    let mut dds = join(None)?;
    let receiver = TopicReceiver::new(&mut dds, MessageType::Imu, "/sensor", Qos::Auto)?;
    let start = |offer: &str| {
        Peer::start(PeerKind::Cyclone.publisher(
            MessageType::Imu,
            "/sensor",
            &format!("--count 0 --rate 50 {offer}"),
        ))
    };
    let _first = start("--reliability reliable --durability transient_local");
    drop(receiver.wait("the first writer", |samples| samples.len() >= 10)?);
    let _second = start("--reliability best_effort");
    let writers_of = |samples: &[ReceivedSample]| {
        samples
            .iter()
            .rev()
            .take(20)
            .map(|sample| sample.meta.writer)
            .collect::<BTreeSet<_>>()
            .len()
    };
    receiver.wait("both writers at once", |samples| writers_of(samples) == 2).map(drop)
}

fn restarts() -> Result<(), Failed> {
    let times = gleaner_tests::times("GLEANER_RESTARTS", 5);
    let mut dds = join(None)?;
    let receiver = TopicReceiver::new(&mut dds, MessageType::Imu, "/sensor", Qos::Auto)?;
    let mut earlier = BTreeSet::new();
    for time in 0..times {
        let peer = Peer::start(PeerKind::Cyclone.publisher(
            MessageType::Imu,
            "/sensor",
            "--count 0 --rate 200",
        ));
        let before = receiver.count();
        // Only a new writer counts, not a late message of the previous one.
        let is_new =
            |sample: &ReceivedSample, earlier: &BTreeSet<_>| !earlier.contains(&sample.meta.writer);
        let samples = receiver
            .wait("a restarted publisher", |samples| {
                samples[before..].iter().filter(|sample| is_new(sample, &earlier)).count() >= 5
            })
            .map_err(|failed| format!("start {time}: {}", failed.message().unwrap_or_default()))?;
        earlier.extend(samples.iter().map(|sample| sample.meta.writer));
        drop(samples);
        peer.kill();
    }
    let status = dds.status(receiver.subscription);
    println!("{times} restarts, {} messages, {status:?}", receiver.count());
    Ok(())
}
