//! Nodes of ROS 2 see the nodes of Gleaner: `ros_discovery_info`, read by a program with one size
//! of Gid.
use gleaner_dds::Distro;
use gleaner_messages::transport::Qos;
use gleaner_tests::peers::message::MessageType;
use gleaner_tests::peers::{Peer, PeerEvent, PeerKind, PeerNode};
use libtest_mimic::Failed;

use crate::receiver::{TopicReceiver, join};
use crate::{DdsCase, Need, case};

const NEED_24: &[Need] = &[Need::Peer(PeerKind::Graph(24))];
const NEED_16: &[Need] = &[Need::Peer(PeerKind::Graph(16))];

pub const CASES: &[DdsCase] = &[
    case("a_node_of_humble_sees_the_nodes_of_gleaner", NEED_24, || seen(24, Some(Distro::Humble))),
    case("a_node_of_jazzy_sees_the_nodes_of_gleaner", NEED_16, || seen(16, Some(Distro::Newer))),
    case("the_distribution_humble_is_detected", NEED_24, || seen(24, None)),
    case("the_distribution_jazzy_is_detected", NEED_16, || seen(16, None)),
];

fn seen(gid_bytes: usize, distro: Option<Distro>) -> Result<(), Failed> {
    let mut peer = Peer::start(PeerKind::Graph(gid_bytes).command());
    let mut dds = join(distro)?;
    let _writer = dds.writer("/output", &MessageType::TimeReference.name(), 10)?;
    let qos = Qos::Fixed { reliable: true, transient_local: false, depth: 10 };
    let _receiver = TopicReceiver::new(&mut dds, MessageType::Imu, "/sensor", qos)?;
    // It may be announced in steps, as readers and writers are created; the last one is complete.
    let (gid, node) = peer.wait("the node with a reader and a writer", |event| match event {
        PeerEvent::Graph { gid, nodes } => {
            let complete = |node: &PeerNode| !node.readers.is_empty() && !node.writers.is_empty();
            nodes.into_iter().find(complete).map(|node| (gid, node))
        }
        _ => None,
    })?;
    if (node.namespace.as_str(), node.name.as_str()) != ("/gleaner", "tests") {
        return Err(format!("the node is {node:?}").into());
    }
    // The first twelve bytes are the participant's, the same in all; bytes of a Gid beyond sixteen
    // are zeros.
    for other in node.readers.iter().chain(&node.writers).chain([&gid]) {
        let zeros = other.get(32..).is_some_and(|rest| rest.bytes().all(|digit| digit == b'0'));
        if other.len() != 2 * gid_bytes || other[..24] != gid[..24] || !zeros {
            return Err(format!("participant {gid} has {other}").into());
        }
    }
    Ok(())
}
