//! Nodes of others see us: `ros_discovery_info`, as a program reads it that knows one size of Gid.

use gleaner_dds::Distro;
use gleaner_tests::peers::message::Type;
use gleaner_tests::peers::{Kind, Node, Peer, Said};
use gleaner_transport::Qos;
use libtest_mimic::Failed;

use crate::ours::{Heard, join};
use crate::{Case, Need};

const NEED_24: &[Need] = &[Need::Peer(Kind::Graph(24))];
const NEED_16: &[Need] = &[Need::Peer(Kind::Graph(16))];

pub const CASES: &[Case] = &[
    Case {
        name: "a_node_of_humble_sees_ours",
        needs: NEED_24,
        run: || seen(24, Some(Distro::Humble)),
    },
    Case {
        name: "a_node_of_jazzy_sees_ours",
        needs: NEED_16,
        run: || seen(16, Some(Distro::Newer)),
    },
    Case { name: "that_others_are_of_humble_is_found_out", needs: NEED_24, run: || seen(24, None) },
    Case { name: "that_others_are_of_jazzy_is_found_out", needs: NEED_16, run: || seen(16, None) },
];

fn seen(gid_bytes: usize, distro: Option<Distro>) -> Result<(), Failed> {
    let mut peer = Peer::start(Kind::Graph(gid_bytes).command());
    let mut dds = join(distro)?;
    let _writer = dds.writer("/ours", &Type::TimeReference.name(), 10)?;
    let qos = Qos::Fixed { reliable: true, transient_local: false, depth: 10 };
    let _heard = Heard::on(&mut dds, Type::Imu, "/sensor", qos)?;
    // It may be told in steps, as readers and writers come to be; in the end all is there.
    let (gid, node) = peer.wait("our node with a reader and a writer", |said| match said {
        Said::Graph { gid, nodes } => {
            let complete = |node: &Node| !node.readers.is_empty() && !node.writers.is_empty();
            nodes.into_iter().find(complete).map(|node| (gid, node))
        }
        _ => None,
    })?;
    if (node.namespace.as_str(), node.name.as_str()) != ("/gleaner", "tests") {
        return Err(format!("our node is called {node:?}").into());
    }
    // The first twelve bytes are the participant's, the same in all; what a Gid has more than
    // sixteen is zeros.
    for other in node.readers.iter().chain(&node.writers).chain([&gid]) {
        let zeros = other.get(32..).is_some_and(|rest| rest.bytes().all(|digit| digit == b'0'));
        if other.len() != 2 * gid_bytes || other[..24] != gid[..24] || !zeros {
            return Err(format!("participant {gid} has {other}").into());
        }
    }
    Ok(())
}
