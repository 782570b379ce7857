//! Finds the node of a writer, from the graph messages of participants.

use std::collections::HashMap;

use super::Distro;
use super::filter::Prefix;
use super::graph_message::{RemoteNode, nodes};
use gleaner_messages::Endian;
use gleaner_messages::transport::Guid;

/// Most participants whose nodes are kept, and the longest graph message that is kept: 4000
/// endpoints. A participant with a longer one gets no type queries.
const MOST: usize = 256;
const LONGEST: usize = 64 << 10;

/// The nodes of other participants, of Iron and newer: older ones have no type description service.
#[derive(Debug, Default)]
pub(super) struct Nodes(HashMap<Prefix, Vec<RemoteNode>>);

impl Nodes {
    /// Takes a graph message of `sender`, which replaces its previous one.
    pub(super) fn note(&mut self, sender: Prefix, cdr: &[u8], endian: Endian) {
        let parsed = if cdr.len() > LONGEST { None } else { nodes(cdr, endian, Distro::Newer) };
        match parsed {
            Some(nodes) if self.0.len() < MOST || self.0.contains_key(&sender) => {
                drop(self.0.insert(sender, nodes))
            }
            _ => drop(self.0.remove(&sender)),
        }
    }

    /// Forgets participants that are not among `present`, which is sorted.
    pub(super) fn keep(&mut self, present: &[Prefix]) {
        self.0.retain(|participant, _| present.binary_search(participant).is_ok());
    }

    /// The node that has this writer, according to its own participant.
    pub(super) fn writing(&self, writer: Guid) -> Option<&str> {
        let nodes = self.0.get(writer.0.first_chunk::<12>()?)?;
        nodes.iter().find(|node| node.writers.contains(&writer.0)).map(|node| node.name.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::super::graph_message::{OwnNode, encode};
    use super::*;

    fn message(name: &str, writer: [u8; 16]) -> Vec<u8> {
        let (namespace, name) = ("/".to_owned(), name.to_owned());
        encode(
            &OwnNode { namespace, name, writers: vec![writer], ..OwnNode::default() },
            Distro::Newer,
        )
    }

    #[test]
    fn a_writer_belongs_to_the_node_that_its_own_participant_named_last() {
        let mut nodes = Nodes::default();
        nodes.note([1; 12], &message("camera", [1; 16]), Endian::Little);
        assert_eq!(nodes.writing(Guid([1; 16])), Some("/camera"));
        nodes.note([2; 12], &message("liar", [3; 16]), Endian::Little);
        assert_eq!(nodes.writing(Guid([3; 16])), None);
        nodes.note([1; 12], &message("lens", [1; 16]), Endian::Little);
        assert_eq!(nodes.writing(Guid([1; 16])), Some("/lens"));
        nodes.keep(&[[2; 12]]);
        assert_eq!(nodes.writing(Guid([1; 16])), None);
    }

    #[test]
    fn participants_and_long_messages_are_bounded() {
        let mut nodes = Nodes::default();
        for n in 0..1000_u16 {
            let mut prefix = [7; 12];
            prefix[..2].copy_from_slice(&n.to_le_bytes());
            nodes.note(prefix, &message("node", [7; 16]), Endian::Little);
        }
        assert_eq!(nodes.0.len(), MOST);
        let mut nodes = Nodes::default();
        let many = OwnNode {
            writers: vec![[1; 16]; LONGEST / 16],
            namespace: "/".into(),
            name: "n".into(),
            ..OwnNode::default()
        };
        nodes.note([1; 12], &encode(&many, Distro::Newer), Endian::Little);
        assert_eq!(nodes.0.len(), 0);
    }
}
