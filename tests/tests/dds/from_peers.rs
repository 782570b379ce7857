//! What peers write, we hear.

use std::collections::BTreeSet;

use gleaner_tests::peers::message::Type;
use gleaner_tests::peers::{Kind, Peer};
use gleaner_transport::{Qos, Transport};
use libtest_mimic::Failed;

use crate::ours::{Heard, Sample, join, number};
use crate::{Case, Need};

const CYCLONE: &[Need] = &[Need::Peer(Kind::Cyclone)];
const FAST: &[Need] = &[Need::Peer(Kind::Fast)];

pub const CASES: &[Case] = &[
    Case { name: "an_imu_of_cyclone_arrives_whole", needs: CYCLONE, run: || imu(Kind::Cyclone) },
    Case { name: "an_imu_of_fast_dds_arrives_whole", needs: FAST, run: || imu(Kind::Fast) },
    Case {
        name: "an_imu_of_python_arrives_whole",
        needs: &[Need::Peer(Kind::Python)],
        run: || imu(Kind::Python),
    },
    Case {
        name: "images_of_cyclone_in_1080p_arrive_whole",
        needs: CYCLONE,
        run: || images(Kind::Cyclone),
    },
    Case {
        name: "images_of_fast_dds_in_1080p_arrive_whole",
        needs: FAST,
        run: || images(Kind::Fast),
    },
    Case {
        name: "compressed_images_of_cyclone_arrive_whole",
        needs: CYCLONE,
        run: || compressed(Kind::Cyclone),
    },
    Case {
        name: "compressed_images_of_fast_dds_arrive_whole",
        needs: FAST,
        run: || compressed(Kind::Fast),
    },
    Case {
        name: "point_clouds_of_cyclone_arrive_whole",
        needs: CYCLONE,
        run: || clouds(Kind::Cyclone),
    },
    Case { name: "point_clouds_of_fast_dds_arrive_whole", needs: FAST, run: || clouds(Kind::Fast) },
    Case { name: "a_best_effort_writer_is_heard", needs: CYCLONE, run: best_effort },
    Case {
        name: "what_a_transient_local_writer_wrote_before_is_heard",
        needs: CYCLONE,
        run: transient_local,
    },
    Case { name: "writers_with_different_offers_are_both_heard", needs: CYCLONE, run: mixed },
    Case {
        name: "a_publisher_that_is_killed_and_started_again_is_heard_again",
        needs: CYCLONE,
        run: restarts,
    },
];

fn imu(kind: Kind) -> Result<(), Failed> {
    whole(kind, Type::Imu, 200, 100)
}

fn images(kind: Kind) -> Result<(), Failed> {
    whole(kind, Type::Image { width: 1920, height: 1080 }, 20, 10)
}

fn compressed(kind: Kind) -> Result<(), Failed> {
    whole(kind, Type::CompressedImage(200_000), 100, 30)
}

fn clouds(kind: Kind) -> Result<(), Failed> {
    whole(kind, Type::PointCloud2(1 << 20), 50, 10)
}

fn whole(kind: Kind, ty: Type, count: u32, rate_hz: u32) -> Result<(), Failed> {
    let mut dds = join(None)?;
    let heard = Heard::on(&mut dds, ty, "/sensor", Qos::Auto)?;
    let _peer =
        Peer::start(kind.publisher(ty, "/sensor", &format!("--count {count} --rate {rate_hz}")));
    heard.all(&dds, count)
}

fn best_effort() -> Result<(), Failed> {
    let mut dds = join(None)?;
    let heard = Heard::on(&mut dds, Type::Imu, "/sensor", Qos::Auto)?;
    let options = "--count 0 --rate 100 --reliability best_effort";
    let _peer = Peer::start(Kind::Cyclone.publisher(Type::Imu, "/sensor", options));
    // The first may be gone before we are connected: nothing is sent again.
    let samples = heard.wait("messages of a best-effort writer", |samples| samples.len() >= 100)?;
    heard.in_order(samples.iter().take(100), number(&samples[0]))
}

fn transient_local() -> Result<(), Failed> {
    let options = "--count 7 --rate 100 --durability transient_local --readers 0";
    let mut peer = Peer::start(Kind::Cyclone.publisher(Type::Imu, "/sensor", options));
    peer.written()?;
    let mut dds = join(None)?;
    let heard = Heard::on(&mut dds, Type::Imu, "/sensor", Qos::Auto)?;
    heard.all(&dds, 7)
}

fn mixed() -> Result<(), Failed> {
    let mut dds = join(None)?;
    let heard = Heard::on(&mut dds, Type::Imu, "/sensor", Qos::Auto)?;
    let start = |offer: &str| {
        Peer::start(Kind::Cyclone.publisher(
            Type::Imu,
            "/sensor",
            &format!("--count 0 --rate 50 {offer}"),
        ))
    };
    let _first = start("--reliability reliable --durability transient_local");
    drop(heard.wait("the first writer", |samples| samples.len() >= 10)?);
    let _second = start("--reliability best_effort");
    let writers_of = |samples: &[Sample]| {
        samples
            .iter()
            .rev()
            .take(20)
            .map(|sample| sample.meta.writer)
            .collect::<BTreeSet<_>>()
            .len()
    };
    heard.wait("both writers at once", |samples| writers_of(samples) == 2).map(drop)
}

fn restarts() -> Result<(), Failed> {
    let times = gleaner_tests::times("GLEANER_RESTARTS", 5);
    let mut dds = join(None)?;
    let heard = Heard::on(&mut dds, Type::Imu, "/sensor", Qos::Auto)?;
    let mut known = BTreeSet::new();
    for time in 0..times {
        let peer =
            Peer::start(Kind::Cyclone.publisher(Type::Imu, "/sensor", "--count 0 --rate 200"));
        let before = heard.count();
        // Of a writer that is new, so that a late message of the last one does not count.
        let fresh = |sample: &Sample, known: &BTreeSet<_>| !known.contains(&sample.meta.writer);
        let samples = heard
            .wait("a publisher that was started again", |samples| {
                samples[before..].iter().filter(|sample| fresh(sample, &known)).count() >= 5
            })
            .map_err(|failed| format!("start {time}: {}", failed.message().unwrap_or_default()))?;
        known.extend(samples.iter().map(|sample| sample.meta.writer));
        drop(samples);
        peer.kill();
    }
    let status = dds.status(heard.subscription);
    println!("{times} restarts, {} messages, {status:?}", heard.count());
    Ok(())
}
