//! What we write, peers hear.

use std::thread;
use std::time::{Duration, Instant};

use gleaner_tests::peers::message::Type;
use gleaner_tests::peers::{Kind, PATIENCE, Peer, Said};
use libtest_mimic::Failed;

use crate::ours::join;
use crate::{Case, Need};

const CYCLONE: &[Need] = &[Need::Peer(Kind::Cyclone)];
const FAST: &[Need] = &[Need::Peer(Kind::Fast)];

/// What goes out in fragments: RustDDS writes 256 bytes in each.
const IMAGE: Type = Type::Image { width: 64, height: 48 };
const COMPRESSED: Type = Type::CompressedImage(5_000);
const CLOUD: Type = Type::PointCloud2(4_096);

pub const CASES: &[Case] = &[
    Case {
        name: "cyclone_hears_our_imu",
        needs: CYCLONE,
        run: || heard_by(Kind::Cyclone, Type::Imu),
    },
    Case {
        name: "cyclone_hears_our_time_reference",
        needs: CYCLONE,
        run: || heard_by(Kind::Cyclone, Type::TimeReference),
    },
    Case {
        name: "cyclone_hears_our_images",
        needs: CYCLONE,
        run: || heard_by(Kind::Cyclone, IMAGE),
    },
    Case {
        name: "cyclone_hears_our_compressed_images",
        needs: CYCLONE,
        run: || heard_by(Kind::Cyclone, COMPRESSED),
    },
    Case {
        name: "cyclone_hears_our_point_clouds",
        needs: CYCLONE,
        run: || heard_by(Kind::Cyclone, CLOUD),
    },
    Case { name: "fast_dds_hears_our_imu", needs: FAST, run: || heard_by(Kind::Fast, Type::Imu) },
    Case { name: "fast_dds_hears_our_images", needs: FAST, run: || heard_by(Kind::Fast, IMAGE) },
    Case {
        name: "fast_dds_hears_our_compressed_images",
        needs: FAST,
        run: || heard_by(Kind::Fast, COMPRESSED),
    },
    Case {
        name: "fast_dds_hears_our_point_clouds",
        needs: FAST,
        run: || heard_by(Kind::Fast, CLOUD),
    },
    Case {
        name: "python_hears_our_imu",
        needs: &[Need::Peer(Kind::Python)],
        run: || heard_by(Kind::Python, Type::Imu),
    },
];

const COUNT: u32 = 200;
/// Number of the first message before those that count.
const FIRST_BEFORE: u32 = 10_000;

fn heard_by(kind: Kind, ty: Type) -> Result<(), Failed> {
    let mut peer = Peer::start(kind.subscriber(ty, "/ours", ""));
    let dds = join(None)?;
    let writer = dds.writer("/ours", &ty.name(), 10)?;
    peer.matched()?;
    let deadline = Instant::now() + PATIENCE;
    while writer.readers() == 0 {
        if Instant::now() > deadline {
            return Err("the peer is connected, and we know of no reader".into());
        }
        thread::sleep(Duration::from_millis(5));
    }
    // Both sides know of each other, but a reader of Cyclone takes nothing of a writer before its
    // first heartbeat, and what is volatile does not come again. So there are some before those
    // that count.
    let mut before = FIRST_BEFORE;
    let heard = |said| matches!(said, Said::Sample { .. }).then_some(());
    loop {
        writer.write(&ty.message(before).cdr())?;
        if peer.wait_for(Duration::from_millis(50), heard).is_some() {
            break;
        }
        before += 1;
        if Instant::now() > deadline {
            return Err(format!("{} messages, and none was heard", before - FIRST_BEFORE).into());
        }
    }
    let started = Instant::now();
    for n in 1..=COUNT {
        thread::sleep((Duration::from_millis(10) * n).saturating_sub(started.elapsed()));
        writer.write(&ty.message(n).cdr())?;
    }
    for n in 1..=COUNT {
        let (seq, sum) = peer.wait(&format!("message {n}"), |said| match said {
            Said::Sample { seq, sum, .. } if seq < FIRST_BEFORE => Some((seq, sum)),
            _ => None,
        })?;
        if (seq, sum) != (n, ty.message(n).sum()) {
            return Err(format!("message {n} came as number {seq} with sum {sum}").into());
        }
    }
    Ok(())
}
