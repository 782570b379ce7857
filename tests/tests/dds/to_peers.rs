//! Peers receive the messages that Gleaner and its player write.

use std::thread;
use std::time::{Duration, Instant};

use gleaner_tests::TempFolder;
use gleaner_tests::drive::latched_imu;
use gleaner_tests::live::play;
use gleaner_tests::peers::message::MessageType;
use gleaner_tests::peers::{PATIENCE, Peer, PeerEvent, PeerKind};
use libtest_mimic::Failed;

use crate::receiver::join;
use crate::{DdsCase, Need, case};

const CYCLONE: &[Need] = &[Need::Peer(PeerKind::Cyclone)];
const FAST: &[Need] = &[Need::Peer(PeerKind::Fast)];

/// Messages that are sent in fragments: RustDDS writes 256 bytes in each.
const IMAGE: MessageType = MessageType::Image { width: 64, height: 48 };
const COMPRESSED: MessageType = MessageType::CompressedImage(5_000);
const CLOUD: MessageType = MessageType::PointCloud2(4_096);

pub const CASES: &[DdsCase] = &[
    case("cyclone_receives_the_imu", CYCLONE, || received_by(PeerKind::Cyclone, MessageType::Imu)),
    case("cyclone_receives_the_time_reference", CYCLONE, || {
        received_by(PeerKind::Cyclone, MessageType::TimeReference)
    }),
    case("cyclone_receives_the_images", CYCLONE, || received_by(PeerKind::Cyclone, IMAGE)),
    case("cyclone_receives_the_compressed_images", CYCLONE, || {
        received_by(PeerKind::Cyclone, COMPRESSED)
    }),
    case("cyclone_receives_the_point_clouds", CYCLONE, || received_by(PeerKind::Cyclone, CLOUD)),
    case("fast_dds_receives_the_imu", FAST, || received_by(PeerKind::Fast, MessageType::Imu)),
    case("fast_dds_receives_the_images", FAST, || received_by(PeerKind::Fast, IMAGE)),
    case("fast_dds_receives_the_compressed_images", FAST, || {
        received_by(PeerKind::Fast, COMPRESSED)
    }),
    case("fast_dds_receives_the_point_clouds", FAST, || received_by(PeerKind::Fast, CLOUD)),
    case("python_receives_the_imu", &[Need::Peer(PeerKind::Python)], || {
        received_by(PeerKind::Python, MessageType::Imu)
    }),
    case(
        "cyclone_receives_what_a_played_drive_has_latched_before_the_start",
        &[Need::Peer(PeerKind::Cyclone), Need::Player],
        played_from_a_start,
    ),
];

const COUNT: u32 = 200;
/// Number of the first message before the counted ones.
const FIRST_BEFORE: u32 = 10_000;

fn received_by(kind: PeerKind, ty: MessageType) -> Result<(), Failed> {
    let mut peer = Peer::start(kind.subscriber(ty, "/output", ""));
    let dds = join(None)?;
    let writer = dds.writer("/output", &ty.name(), 10)?;
    peer.matched()?;
    let deadline = Instant::now() + PATIENCE;
    while writer.readers() == 0 {
        if Instant::now() > deadline {
            return Err("the peer is connected, but the writer has no reader".into());
        }
        thread::sleep(Duration::from_millis(5));
    }
    // Both sides are matched, but a reader of Cyclone accepts nothing from a writer before its
    // first heartbeat, and volatile messages are not sent again. So some messages precede the
    // counted ones.
    let mut before = FIRST_BEFORE;
    let is_sample = |event| matches!(event, PeerEvent::Sample { .. }).then_some(());
    loop {
        writer.write(&ty.message(before).cdr())?;
        if peer.wait_for(Duration::from_millis(50), is_sample).is_some() {
            break;
        }
        before += 1;
        if Instant::now() > deadline {
            return Err(format!("{} messages, and none was received", before - FIRST_BEFORE).into());
        }
    }
    let started = Instant::now();
    for n in 1..=COUNT {
        thread::sleep((Duration::from_millis(10) * n).saturating_sub(started.elapsed()));
        writer.write(&ty.message(n).cdr())?;
    }
    all_of(&mut peer, ty, COUNT)
}

/// Waits for messages 1 to `count`.
fn all_of(peer: &mut Peer, ty: MessageType, count: u32) -> Result<(), Failed> {
    for n in 1..=count {
        let (seq, sum) = peer.wait(&format!("message {n}"), |event| match event {
            PeerEvent::Sample { seq, sum, .. } if seq < FIRST_BEFORE => Some((seq, sum)),
            _ => None,
        })?;
        if (seq, sum) != (n, ty.message(n).sum()) {
            return Err(format!("message {n} arrived as number {seq} with sum {sum}").into());
        }
    }
    Ok(())
}

fn played_from_a_start() -> Result<(), Failed> {
    let folder = TempFolder::new();
    let drive = latched_imu(&folder, 30);
    let subscriber = || {
        let options = "--durability transient_local";
        Peer::start(PeerKind::Cyclone.subscriber(MessageType::Imu, "/imu", options))
    };
    let mut early = subscriber();
    let path = drive.to_str().ok_or("the folder has no plain path")?;
    // Messages 1 to 5 come before it.
    let _player = play(&[path, "--start", "4.5", "--stamp", "recorded", "--wait", "1"]);
    all_of(&mut early, MessageType::Imu, 6)?;
    all_of(&mut subscriber(), MessageType::Imu, 6)
}
