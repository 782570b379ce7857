//! Several of our participants read one topic: its writer keeps running, and each of them receives
//! samples.

use gleaner_dds::Dds;
use gleaner_tests::live::run;
use gleaner_tests::peers::message::Type;
use gleaner_tests::peers::{Kind, Peer};
use gleaner_tests::{Folder, root};
use gleaner_transport::Qos;
use libtest_mimic::Failed;

use crate::faults::{announcement, udp_ports};
use crate::ours::{Heard, join};
use crate::{Case, Need};

pub const CASES: &[Case] = &[
    Case {
        name: "fast_dds_outlives_several_readers_of_its_topic",
        needs: &[Need::Peer(Kind::Fast)],
        run: || outlived(Kind::Fast),
    },
    Case {
        name: "cyclone_outlives_several_readers_of_its_topic",
        needs: &[Need::Peer(Kind::Cyclone)],
        run: || outlived(Kind::Cyclone),
    },
    Case {
        name: "no_multicast_address_is_announced_for_samples",
        needs: &[],
        run: || announced(|| join(None)),
    },
    Case {
        name: "no_multicast_address_is_announced_by_a_python_lambda",
        needs: &[],
        run: || {
            let out = Folder::new();
            announced(|| {
                let lambda =
                    run(&root().join("tests/lambdas/ticker/python"), out.path(), &["--no-record"]);
                lambda.until_ready();
                Ok(lambda)
            })
        },
    },
];

const TOPIC: &str = "/sensor";
const READERS: [usize; 4] = [2, 5, 2, 5];
const SAMPLES: usize = 10;

/// DDSI-RTPS 2.2, section 9.6.2.2.2: parameters of an announcement.
const METATRAFFIC_MULTICAST_LOCATOR: u16 = 0x0033;
const DEFAULT_MULTICAST_LOCATOR: u16 = 0x0048;

fn outlived(kind: Kind) -> Result<(), Failed> {
    let publisher = || Peer::start(kind.publisher(Type::Imu, TOPIC, "--count 0 --rate 100"));
    let mut early = publisher();
    for readers in READERS {
        let mut ours = (0..readers).map(|_| join(None)).collect::<Result<Vec<Dds>, Failed>>()?;
        let qos = Qos::Fixed { reliable: true, transient_local: false, depth: 10 };
        let subscribe = |dds: &mut Dds| Heard::on(dds, Type::Imu, TOPIC, qos);
        let mut heard = ours.iter_mut().map(subscribe).collect::<Result<Vec<Heard>, Failed>>()?;
        receives(&mut early, &heard)?;
        // A writer may send to one reader in another way than to several.
        ours.truncate(1);
        heard.truncate(1);
        receives(&mut early, &heard)?;
    }
    let mut ours = [join(None)?, join(None)?];
    let subscribe = |dds: &mut Dds| Heard::on(dds, Type::Imu, TOPIC, Qos::Auto);
    let heard = ours.iter_mut().map(subscribe).collect::<Result<Vec<Heard>, Failed>>()?;
    receives(&mut early, &heard)?;
    drop(early);
    receives(&mut publisher(), &heard)
}

/// Waits until each has received more, or the writer has ended.
fn receives(writer: &mut Peer, heard: &[Heard]) -> Result<(), Failed> {
    for heard in heard {
        let enough = heard.count() + SAMPLES;
        let mut ended = None;
        drop(heard.wait("samples", |samples| {
            ended = writer.ended();
            ended.is_some() || samples.len() >= enough
        })?);
        if let Some(how) = ended {
            return Err(format!("the writer ended with several readers: {how}").into());
        }
    }
    Ok(())
}

/// Looks at what the one participant in this network announces, which lives as long as the result
/// of `start`.
fn announced<T>(start: impl FnOnce() -> Result<T, Failed>) -> Result<(), Failed> {
    let _participant = start()?;
    let packet = announcement(&udp_ports()?)?;
    let announces = |parameter: u16| {
        // A locator has 24 bytes.
        let [low, high] = parameter.to_le_bytes();
        packet.windows(4).any(|bytes| bytes == [low, high, 24, 0])
    };
    match (announces(METATRAFFIC_MULTICAST_LOCATOR), announces(DEFAULT_MULTICAST_LOCATOR)) {
        (true, false) => Ok(()),
        (discovery, samples) => Err(format!(
            "multicast is announced for discovery: {discovery}, for samples: {samples}"
        )
        .into()),
    }
}
