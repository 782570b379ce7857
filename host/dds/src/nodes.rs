//! Which node writes what, as participants say it of themselves in the graph.

use std::collections::HashMap;

use super::Distro;
use super::filter::Prefix;
use super::graph::{Node, nodes};
use gleaner_messages::Endian;
use gleaner_transport::Guid;

/// Most participants whose nodes are known, and the longest word of one that is remembered: 4000
/// endpoints. Who says more is asked nothing.
const MOST: usize = 256;
const LONGEST: usize = 64 << 10;

/// The nodes of others, of Iron and newer: older ones answer no questions.
#[derive(Debug, Default)]
pub(super) struct Nodes(HashMap<Prefix, Vec<Node>>);

impl Nodes {
    /// `sender` said `cdr`, which replaces what it said before.
    pub(super) fn hear(&mut self, sender: Prefix, cdr: &[u8], endian: Endian) {
        let known = if cdr.len() > LONGEST { None } else { nodes(cdr, endian, Distro::Newer) };
        match known {
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

    /// The node that has this writer, if its own participant said so.
    pub(super) fn writing(&self, writer: Guid) -> Option<&str> {
        let nodes = self.0.get(writer.0.first_chunk::<12>()?)?;
        nodes.iter().find(|node| node.writers.contains(&writer.0)).map(|node| node.name.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::super::graph::{Entry, encode};
    use super::*;

    fn said(name: &str, writer: [u8; 16]) -> Vec<u8> {
        let (namespace, name) = ("/".to_owned(), name.to_owned());
        encode(&Entry { namespace, name, writers: vec![writer], ..Entry::default() }, Distro::Newer)
    }

    #[test]
    fn a_writer_is_of_the_node_of_which_its_own_participant_said_so_last() {
        let mut nodes = Nodes::default();
        nodes.hear([1; 12], &said("camera", [1; 16]), Endian::Little);
        assert_eq!(nodes.writing(Guid([1; 16])), Some("/camera"));
        nodes.hear([2; 12], &said("liar", [3; 16]), Endian::Little);
        assert_eq!(nodes.writing(Guid([3; 16])), None);
        nodes.hear([1; 12], &said("lens", [1; 16]), Endian::Little);
        assert_eq!(nodes.writing(Guid([1; 16])), Some("/lens"));
        nodes.keep(&[[2; 12]]);
        assert_eq!(nodes.writing(Guid([1; 16])), None);
    }

    #[test]
    fn no_more_participants_and_no_longer_words_are_remembered_than_anybody_has() {
        let mut nodes = Nodes::default();
        for n in 0..1000_u16 {
            let mut prefix = [7; 12];
            prefix[..2].copy_from_slice(&n.to_le_bytes());
            nodes.hear(prefix, &said("node", [7; 16]), Endian::Little);
        }
        assert_eq!(nodes.0.len(), MOST);
        let mut nodes = Nodes::default();
        let many = Entry {
            writers: vec![[1; 16]; LONGEST / 16],
            namespace: "/".into(),
            name: "n".into(),
            ..Entry::default()
        };
        nodes.hear([1; 12], &encode(&many, Distro::Newer), Endian::Little);
        assert_eq!(nodes.0.len(), 0);
    }
}
