//! Several participants of Gleaner read one topic: its writer keeps running, and each of them
//! receives samples.

use gleaner_dds::Dds;
use gleaner_tests::live::run;
use gleaner_tests::peers::message::MessageType;
use gleaner_tests::peers::{Peer, PeerKind};
use gleaner_tests::{TempFolder, root};
use gleaner_transport::Qos;
use libtest_mimic::Failed;

use crate::faults::{announcement, udp_ports};
use crate::receiver::{TopicReceiver, join};
use crate::{DdsCase, Need};

pub const CASES: &[DdsCase] = &[
    DdsCase {
        name: "fast_dds_survives_several_readers_of_its_topic",
        needs: &[Need::Peer(PeerKind::Fast)],
        run: || survives(PeerKind::Fast),
    },
    DdsCase {
        name: "cyclone_survives_several_readers_of_its_topic",
        needs: &[Need::Peer(PeerKind::Cyclone)],
        run: || survives(PeerKind::Cyclone),
    },
    DdsCase {
        name: "no_multicast_address_is_announced_for_samples",
        needs: &[],
        run: || announces_no_multicast(|| join(None)),
    },
    DdsCase {
        name: "no_multicast_address_is_announced_by_a_python_lambda",
        needs: &[],
        run: || {
            let out = TempFolder::new();
            announces_no_multicast(|| {
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

fn survives(kind: PeerKind) -> Result<(), Failed> {
    let publisher = || Peer::start(kind.publisher(MessageType::Imu, TOPIC, "--count 0 --rate 100"));
    let mut early = publisher();
    for readers in READERS {
        let mut participants =
            (0..readers).map(|_| join(None)).collect::<Result<Vec<Dds>, Failed>>()?;
        let qos = Qos::Fixed { reliable: true, transient_local: false, depth: 10 };
        let subscribe = |dds: &mut Dds| TopicReceiver::new(dds, MessageType::Imu, TOPIC, qos);
        let mut receivers = participants
            .iter_mut()
            .map(subscribe)
            .collect::<Result<Vec<TopicReceiver>, Failed>>()?;
        receives(&mut early, &receivers)?;
        // A writer may send to a single reader differently than to several.
        participants.truncate(1);
        receivers.truncate(1);
        receives(&mut early, &receivers)?;
    }
    let mut participants = [join(None)?, join(None)?];
    let subscribe = |dds: &mut Dds| TopicReceiver::new(dds, MessageType::Imu, TOPIC, Qos::Auto);
    let receivers =
        participants.iter_mut().map(subscribe).collect::<Result<Vec<TopicReceiver>, Failed>>()?;
    receives(&mut early, &receivers)?;
    drop(early);
    receives(&mut publisher(), &receivers)
}

/// Waits until each receiver has received more, or the writer has ended.
fn receives(writer: &mut Peer, receivers: &[TopicReceiver]) -> Result<(), Failed> {
    for receiver in receivers {
        let enough = receiver.count() + SAMPLES;
        let mut ended = None;
        drop(receiver.wait("samples", |samples| {
            ended = writer.ended();
            ended.is_some() || samples.len() >= enough
        })?);
        if let Some(how) = ended {
            return Err(format!("the writer ended with several readers: {how}").into());
        }
    }
    Ok(())
}

/// Checks the announcement of the only participant in this network, which lives as long as the
/// result of `start`.
fn announces_no_multicast<T>(start: impl FnOnce() -> Result<T, Failed>) -> Result<(), Failed> {
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
