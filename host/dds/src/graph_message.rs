//! Encodes and parses messages of the ROS 2 graph, the topic `ros_discovery_info`: the nodes of a
//! participant and their endpoints.
//!
//! Nodes up to Humble identify an endpoint with 24 bytes there, newer ones with 16. A node that
//! reads the wrong size fails for all nodes, so nothing is sent before the format of the readers is
//! known.
//!
//! Never here: an allocation larger than the message, whatever it claims.

use super::Distro;
use super::names::visible;
use gleaner_messages::Endian;

/// DDS names of the topic and its type.
pub(super) const TOPIC: &str = "ros_discovery_info";
pub(super) const TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";

/// The longest namespace or name of a node that is accepted.
const LONGEST: usize = 1024;

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct OwnNode {
    pub(super) participant: [u8; 16],
    pub(super) namespace: String,
    pub(super) name: String,
    pub(super) readers: Vec<[u8; 16]>,
    pub(super) writers: Vec<[u8; 16]>,
}

/// A node of another participant, as listed in its graph message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct RemoteNode {
    /// Namespace and name: `/sensors/camera`.
    pub(super) name: String,
    pub(super) writers: Vec<[u8; 16]>,
}

/// The state of our node in the graph.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Listing {
    /// Not listed: no ROS 2 node was seen, and no distribution is configured.
    Unlisted,
    /// Listed in the format of this distribution.
    In(Distro),
    /// Not listed for this reason: some nodes would fail.
    Out(&'static str),
}

/// Detects the distribution of the other nodes, from which the format of our messages follows.
#[derive(Clone, Debug)]
pub(super) struct DistroDetector {
    configured: Option<Distro>,
    humble: bool,
    newer: bool,
}

impl DistroDetector {
    pub(super) fn new(configured: Option<Distro>) -> Self {
        Self { configured, humble: false, newer: false }
    }

    /// Takes a graph message of another participant.
    pub(super) fn observe(&mut self, cdr: &[u8], endian: Endian) {
        // A message that is valid in both formats, or in neither, is not evidence.
        match (plausible(cdr, endian, Distro::Humble), plausible(cdr, endian, Distro::Newer)) {
            (true, false) => self.humble = true,
            (false, true) => self.newer = true,
            _ => {}
        }
    }

    pub(super) fn listing(&self) -> Listing {
        match (self.configured, self.humble, self.newer) {
            (_, true, true) => {
                Listing::Out("nodes of Humble and of newer distributions are present")
            }
            (Some(Distro::Humble), _, true) => {
                Listing::Out("ROS_DISTRO is Humble or older, other nodes are newer")
            }
            (Some(Distro::Newer), true, _) => {
                Listing::Out("ROS_DISTRO is Iron or newer, other nodes are Humble or older")
            }
            (Some(distro), ..) => Listing::In(distro),
            (None, true, false) => Listing::In(Distro::Humble),
            (None, false, true) => Listing::In(Distro::Newer),
            (None, false, false) => Listing::Unlisted,
        }
    }
}

impl Listing {
    pub(super) fn describe(self, node: &str) -> String {
        match self {
            Self::Unlisted => "not listed: no ROS 2 node seen yet".to_owned(),
            Self::In(Distro::Humble) => {
                format!("listed as `{}` in the format of Humble", visible(node))
            }
            Self::In(Distro::Newer) => {
                format!("listed as `{}` in the format of Iron and newer", visible(node))
            }
            Self::Out(why) => format!("not listed: {why}"),
        }
    }
}

fn gid_size(distro: Distro) -> usize {
    match distro {
        Distro::Humble => 24,
        Distro::Newer => 16,
    }
}

/// Encodes `rmw_dds_common/msg/ParticipantEntitiesInfo` in little-endian CDR. Without `entry`'s
/// name, no node is listed.
pub(super) fn encode(entry: &OwnNode, distro: Distro) -> Vec<u8> {
    let mut cdr = Vec::new();
    let gid = |cdr: &mut Vec<u8>, gid: &[u8; 16]| {
        cdr.extend_from_slice(gid);
        cdr.resize(cdr.len() + gid_size(distro) - gid.len(), 0);
    };
    gid(&mut cdr, &entry.participant);
    count(&mut cdr, usize::from(!entry.name.is_empty()));
    if !entry.name.is_empty() {
        for text in [&entry.namespace, &entry.name] {
            count(&mut cdr, text.len() + 1);
            cdr.extend_from_slice(text.as_bytes());
            cdr.push(0);
        }
        for list in [&entry.readers, &entry.writers] {
            count(&mut cdr, list.len());
            list.iter().for_each(|one| gid(&mut cdr, one));
        }
    }
    cdr
}

fn count(cdr: &mut Vec<u8>, n: usize) {
    cdr.resize(cdr.len().next_multiple_of(4), 0);
    cdr.extend_from_slice(&u32::try_from(n).unwrap_or(u32::MAX).to_le_bytes());
}

/// Returns whether `cdr` is such a message of a node of `distro`, down to its last byte.
fn plausible(cdr: &[u8], endian: Endian, distro: Distro) -> bool {
    nodes(cdr, endian, distro).is_some()
}

/// Parses the nodes of a participant; `None` if it is not such a message, or lists no node.
pub(super) fn nodes(cdr: &[u8], endian: Endian, distro: Distro) -> Option<Vec<RemoteNode>> {
    let mut parser = Parser { cdr, at: 0, endian };
    let nodes = parser.nodes(gid_size(distro))?;
    // Some writers pad to a multiple of four.
    (cdr.len() - parser.at < 4).then_some(nodes)
}

struct Parser<'a> {
    cdr: &'a [u8],
    at: usize,
    endian: Endian,
}

impl<'a> Parser<'a> {
    fn nodes(&mut self, gid: usize) -> Option<Vec<RemoteNode>> {
        self.take(gid)?;
        let count = self.count()?;
        // Without a node there is too little to distinguish the two formats.
        if count == 0 {
            return None;
        }
        let mut nodes = Vec::new();
        for _ in 0..count {
            let (namespace, name) = (self.name()?, self.name()?);
            if !namespace.starts_with('/') {
                return None;
            }
            self.gids(gid)?;
            let writers = self.gids(gid)?;
            nodes.push(RemoteNode {
                name: format!("{}/{name}", namespace.trim_end_matches('/')),
                writers,
            });
        }
        Some(nodes)
    }

    fn name(&mut self) -> Option<&'a str> {
        let length = self.count()?;
        let [bytes @ .., 0] = self.take(length)? else { return None };
        let printable = bytes.iter().all(|byte| byte.is_ascii_graphic());
        if !printable || bytes.is_empty() || bytes.len() > LONGEST {
            return None;
        }
        str::from_utf8(bytes).ok()
    }

    /// A list of GIDs of endpoints, the 16 significant bytes of each.
    fn gids(&mut self, gid: usize) -> Option<Vec<[u8; 16]>> {
        let bytes = self.count()?.checked_mul(gid)?;
        let gids = self.take(bytes)?.chunks_exact(gid);
        gids.map(|gid| gid.first_chunk().copied()).collect()
    }

    fn count(&mut self) -> Option<usize> {
        self.at = self.at.next_multiple_of(4);
        let bytes = self.take(4)?.try_into().ok()?;
        let n = match self.endian {
            Endian::Little => u32::from_le_bytes(bytes),
            Endian::Big => u32::from_be_bytes(bytes),
        };
        usize::try_from(n).ok()
    }

    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let end = self.at.checked_add(n)?;
        let taken = self.cdr.get(self.at..end)?;
        self.at = end;
        Some(taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(name: &str, readers: usize, writers: usize) -> OwnNode {
        OwnNode {
            participant: [7; 16],
            namespace: "/".to_owned(),
            name: name.to_owned(),
            readers: vec![[1; 16]; readers],
            writers: vec![[2; 16]; writers],
        }
    }

    fn listing(configured: Option<Distro>, seen: &[Distro]) -> Listing {
        let mut detector = DistroDetector::new(configured);
        for distro in seen {
            detector.observe(&encode(&entry("camera", 3, 4), *distro), Endian::Little);
        }
        detector.listing()
    }

    #[test]
    fn a_message_identifies_the_distribution_whatever_it_lists() {
        for name in ["n", "no", "nod", "node"] {
            for (readers, writers) in [(0, 0), (1, 0), (0, 1), (9, 40)] {
                for (distro, humble) in [(Distro::Humble, true), (Distro::Newer, false)] {
                    let cdr = encode(&entry(name, readers, writers), distro);
                    for (distro, expected) in [(Distro::Humble, humble), (Distro::Newer, !humble)] {
                        let found = plausible(&cdr, Endian::Little, distro);
                        assert_eq!(found, expected, "{name} {readers} {writers}");
                    }
                }
            }
        }
    }

    #[test]
    fn nodes_are_read_with_what_they_write() {
        for distro in [Distro::Humble, Distro::Newer] {
            for (namespace, full) in [("/", "/camera"), ("/front/left", "/front/left/camera")] {
                let entry = OwnNode { namespace: namespace.to_owned(), ..entry("camera", 3, 2) };
                let found = nodes(&encode(&entry, distro), Endian::Little, distro).unwrap();
                let expected = [RemoteNode { name: full.to_owned(), writers: vec![[2; 16]; 2] }];
                assert_eq!(found, expected);
            }
        }
    }

    #[test]
    fn we_are_listed_as_other_nodes_are_or_as_configured() {
        use Distro::{Humble, Newer};
        assert_eq!(listing(None, &[]), Listing::Unlisted);
        assert_eq!(listing(None, &[Humble]), Listing::In(Humble));
        assert_eq!(listing(None, &[Newer]), Listing::In(Newer));
        assert_eq!(listing(Some(Humble), &[]), Listing::In(Humble));
        assert_eq!(listing(Some(Newer), &[Newer]), Listing::In(Newer));
    }

    #[test]
    fn we_stay_unlisted_where_some_nodes_would_fail() {
        use Distro::{Humble, Newer};
        for (configured, seen) in [
            (None, vec![Humble, Newer]),
            (Some(Humble), vec![Newer]),
            (Some(Newer), vec![Humble]),
            (Some(Newer), vec![Newer, Humble]),
        ] {
            let found = listing(configured, &seen);
            assert!(matches!(found, Listing::Out(_)), "{configured:?} {seen:?}");
        }
    }

    #[test]
    fn truncated_and_invalid_messages_are_ignored() {
        let whole = encode(&entry("camera", 2, 2), Distro::Humble);
        for length in 0..whole.len() {
            let mut detector = DistroDetector::new(None);
            detector.observe(&whole[..length], Endian::Little);
            assert_eq!(detector.listing(), Listing::Unlisted, "{length} bytes");
        }
        let mut detector = DistroDetector::new(None);
        detector.observe(&whole, Endian::Big);
        detector.observe(&[0xff; 4096], Endian::Little);
        detector.observe(&encode(&entry("two words", 0, 0), Distro::Humble), Endian::Little);
        detector.observe(&encode(&entry("", 0, 0), Distro::Humble), Endian::Little);
        assert_eq!(detector.listing(), Listing::Unlisted);
    }
}
