//! What is said in the graph of ROS 2, the topic `ros_discovery_info`: the nodes of a participant
//! and their endpoints.
//!
//! Nodes up to Humble name an endpoint with 24 bytes there, newer ones with 16. Whoever reads the
//! wrong size fails, not only for us but for all nodes, so nothing is said before it is known who
//! listens.
//!
//! What never happens here: an allocation larger than the message, whatever it claims.

use super::Distro;
use super::names::visible;
use gleaner_messages::Endian;

/// Topic and type, as DDS spells them.
pub(super) const TOPIC: &str = "ros_discovery_info";
pub(super) const TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";

/// The longest namespace or name of a node that is taken for one.
const LONGEST: usize = 1024;

/// Our node as others shall see it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Entry {
    pub(super) participant: [u8; 16],
    pub(super) namespace: String,
    pub(super) name: String,
    pub(super) readers: Vec<[u8; 16]>,
    pub(super) writers: Vec<[u8; 16]>,
}

/// A node of somebody else, as it says itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Node {
    /// Namespace and name: `/sensors/camera`.
    pub(super) name: String,
    pub(super) writers: Vec<[u8; 16]>,
}

/// Whether we are in the graph.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Part {
    /// Nobody of ROS 2 was heard, and nothing is said of who they are.
    Silent,
    /// We speak as nodes of this distribution do.
    In(Distro),
    /// We stay out, because we would break somebody.
    Out(&'static str),
}

/// Who was heard, from which follows how to speak.
#[derive(Clone, Debug)]
pub(super) struct Hearing {
    /// What we were told.
    told: Option<Distro>,
    humble: bool,
    newer: bool,
}

impl Hearing {
    pub(super) fn new(told: Option<Distro>) -> Self {
        Self { told, humble: false, newer: false }
    }

    /// Somebody said `cdr`.
    pub(super) fn hear(&mut self, cdr: &[u8], endian: Endian) {
        // What can be read both ways, or neither, says nothing.
        match (plausible(cdr, endian, Distro::Humble), plausible(cdr, endian, Distro::Newer)) {
            (true, false) => self.humble = true,
            (false, true) => self.newer = true,
            _ => {}
        }
    }

    pub(super) fn part(&self) -> Part {
        match (self.told, self.humble, self.newer) {
            (_, true, true) => {
                Part::Out("nodes of Humble and nodes of newer distributions are here")
            }
            (Some(Distro::Humble), _, true) => {
                Part::Out("ROS_DISTRO says Humble or older, others are newer")
            }
            (Some(Distro::Newer), true, _) => {
                Part::Out("ROS_DISTRO says Iron or newer, others are Humble or older")
            }
            (Some(told), ..) => Part::In(told),
            (None, true, false) => Part::In(Distro::Humble),
            (None, false, true) => Part::In(Distro::Newer),
            (None, false, false) => Part::Silent,
        }
    }
}

impl Part {
    /// In words, of node `node`.
    pub(super) fn in_words(self, node: &str) -> String {
        match self {
            Self::Silent => "not listed: no node of ROS 2 was heard yet".to_owned(),
            Self::In(Distro::Humble) => {
                format!("listed as `{}`, as nodes of Humble are", visible(node))
            }
            Self::In(Distro::Newer) => {
                format!("listed as `{}`, as nodes of Iron and newer are", visible(node))
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

/// `rmw_dds_common/msg/ParticipantEntitiesInfo` in little-endian CDR. Without `entry`'s name, no
/// node is listed.
pub(super) fn encode(entry: &Entry, distro: Distro) -> Vec<u8> {
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

/// Whether `cdr` is such a message of a node of `distro`, down to its last byte.
fn plausible(cdr: &[u8], endian: Endian, distro: Distro) -> bool {
    nodes(cdr, endian, distro).is_some()
}

/// The nodes of a participant out of such a message; `None` if it is none, or names no node.
pub(super) fn nodes(cdr: &[u8], endian: Endian, distro: Distro) -> Option<Vec<Node>> {
    let mut rest = Rest { cdr, at: 0, endian };
    let nodes = rest.nodes(gid_size(distro))?;
    // Some writers fill up to a multiple of four.
    (cdr.len() - rest.at < 4).then_some(nodes)
}

struct Rest<'a> {
    cdr: &'a [u8],
    at: usize,
    endian: Endian,
}

impl<'a> Rest<'a> {
    fn nodes(&mut self, gid: usize) -> Option<Vec<Node>> {
        self.take(gid)?;
        let count = self.count()?;
        // Without a node there is too little to tell the sizes apart by.
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
            nodes.push(Node {
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

    /// A list of names of endpoints, of each the 16 bytes that mean something.
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

    fn entry(name: &str, readers: usize, writers: usize) -> Entry {
        Entry {
            participant: [7; 16],
            namespace: "/".to_owned(),
            name: name.to_owned(),
            readers: vec![[1; 16]; readers],
            writers: vec![[2; 16]; writers],
        }
    }

    fn part(told: Option<Distro>, heard: &[Distro]) -> Part {
        let mut hearing = Hearing::new(told);
        for distro in heard {
            hearing.hear(&encode(&entry("camera", 3, 4), *distro), Endian::Little);
        }
        hearing.part()
    }

    #[test]
    fn a_message_tells_the_distribution_whatever_it_lists() {
        for name in ["n", "no", "nod", "node"] {
            for (readers, writers) in [(0, 0), (1, 0), (0, 1), (9, 40)] {
                for (distro, humble) in [(Distro::Humble, true), (Distro::Newer, false)] {
                    let cdr = encode(&entry(name, readers, writers), distro);
                    assert_eq!(
                        plausible(&cdr, Endian::Little, Distro::Humble),
                        humble,
                        "{name} {readers} {writers}"
                    );
                    assert_eq!(
                        plausible(&cdr, Endian::Little, Distro::Newer),
                        !humble,
                        "{name} {readers} {writers}"
                    );
                }
            }
        }
    }

    #[test]
    fn nodes_are_read_with_what_they_write() {
        for distro in [Distro::Humble, Distro::Newer] {
            for (namespace, full) in [("/", "/camera"), ("/front/left", "/front/left/camera")] {
                let entry = Entry { namespace: namespace.to_owned(), ..entry("camera", 3, 2) };
                let found = nodes(&encode(&entry, distro), Endian::Little, distro).unwrap();
                assert_eq!(found, [Node { name: full.to_owned(), writers: vec![[2; 16]; 2] }]);
            }
        }
    }

    #[test]
    fn we_speak_as_those_who_are_heard_or_as_we_were_told() {
        use Distro::{Humble, Newer};
        assert_eq!(part(None, &[]), Part::Silent);
        assert_eq!(part(None, &[Humble]), Part::In(Humble));
        assert_eq!(part(None, &[Newer]), Part::In(Newer));
        assert_eq!(part(Some(Humble), &[]), Part::In(Humble));
        assert_eq!(part(Some(Newer), &[Newer]), Part::In(Newer));
    }

    #[test]
    fn we_stay_out_where_some_would_be_broken() {
        use Distro::{Humble, Newer};
        for (told, heard) in [
            (None, vec![Humble, Newer]),
            (Some(Humble), vec![Newer]),
            (Some(Newer), vec![Humble]),
            (Some(Newer), vec![Newer, Humble]),
        ] {
            assert!(matches!(part(told, &heard), Part::Out(_)), "{told:?} {heard:?}");
        }
    }

    #[test]
    fn what_is_cut_or_makes_no_sense_says_nothing() {
        let whole = encode(&entry("camera", 2, 2), Distro::Humble);
        for length in 0..whole.len() {
            let mut hearing = Hearing::new(None);
            hearing.hear(&whole[..length], Endian::Little);
            assert_eq!(hearing.part(), Part::Silent, "{length} bytes");
        }
        let mut hearing = Hearing::new(None);
        hearing.hear(&whole, Endian::Big);
        hearing.hear(&[0xff; 4096], Endian::Little);
        hearing.hear(&encode(&entry("two words", 0, 0), Distro::Humble), Endian::Little);
        hearing.hear(&encode(&entry("", 0, 0), Distro::Humble), Endian::Little);
        assert_eq!(hearing.part(), Part::Silent);
    }
}
