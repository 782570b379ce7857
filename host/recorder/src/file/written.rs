//! Counts and checksums of the messages in a clip, by topic: computed while it is written, and
//! again when it is read.

use std::collections::{BTreeSet, HashMap};

use gleaner_messages::Endian;
use gleaner_messages::transport::SampleMeta;

use super::TopicSchema;

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct WrittenTopic {
    pub(super) name: String,
    pub(super) type_name: String,
    /// CRC-32 of the definitions of each layout, in hexadecimal digits; empty if the file has none.
    definitions: BTreeSet<String>,
    pub(super) messages: u64,
    checksum: u64,
}

impl WrittenTopic {
    /// Returns the checksums of its definitions, sorted; `None` if the file has none.
    pub(super) fn definitions(&self) -> Option<String> {
        let texts: Vec<&str> = self.definitions.iter().map(String::as_str).collect();
        (!texts.is_empty()).then(|| texts.join(", "))
    }

    /// Returns the checksum over all messages, in hexadecimal digits.
    pub(super) fn checksum(&self) -> String {
        format!("{:016x}", self.checksum)
    }
}

#[derive(Debug, Default)]
pub(super) struct Written {
    /// In the order in which they were added.
    topics: Vec<WrittenTopic>,
    by_name: HashMap<String, usize>,
    /// Stamps of the first and the last message.
    pub(super) span: Option<(i64, i64)>,
}

impl Written {
    /// Adds a topic, which is not there yet; returns its index.
    pub(super) fn add_topic(&mut self, topic: &TopicSchema) -> usize {
        self.topics.push(WrittenTopic {
            name: topic.name.clone(),
            type_name: topic.type_name.clone(),
            ..WrittenTopic::default()
        });
        let index = self.topics.len() - 1;
        self.by_name.insert(topic.name.clone(), index);
        index
    }

    pub(super) fn add_definitions(&mut self, topic: usize, text: &str) {
        // Readers trim definitions.
        let text = text.trim();
        if !text.is_empty() {
            self.topics[topic].definitions.insert(crc32(text.as_bytes()));
        }
    }

    pub(super) fn count(&mut self, topic: usize, meta: &SampleMeta, cdr: &[u8]) {
        let topic = &mut self.topics[topic];
        topic.messages += 1;
        // Readers sort messages by their stamps, so the checksum must not depend on the order. A
        // plain sum would miss one in 10,000 swaps of bytes between two messages, as a CRC is
        // linear; a sum of squares does not.
        let crc = u64::from(checksum(meta, cdr));
        topic.checksum = topic.checksum.wrapping_add(crc * crc);
        let (first, last) = self.span.unwrap_or((meta.at_ns, meta.at_ns));
        self.span = Some((first.min(meta.at_ns), last.max(meta.at_ns)));
    }

    pub(super) fn topic(&self, name: &str) -> Option<&WrittenTopic> {
        self.by_name.get(name).map(|index| &self.topics[*index])
    }

    pub(super) fn topics(&self) -> &[WrittenTopic] {
        &self.topics
    }

    pub(super) fn messages(&self) -> u64 {
        self.topics.iter().map(|topic| topic.messages).sum()
    }
}

/// Returns the stamp in the file: MCAP has no time before the epoch.
pub(super) fn stamp(ns: i64) -> u64 {
    u64::try_from(ns).unwrap_or(0)
}

pub(super) fn encapsulation(meta: &SampleMeta) -> [u8; 4] {
    let endian = u8::from(matches!(meta.endian, Endian::Little));
    [0, endian, meta.options[0], meta.options[1]]
}

/// Returns the CRC-32 of `bytes`, in hexadecimal digits.
pub(super) fn crc32(bytes: &[u8]) -> String {
    format!("{:08x}", crc32fast::hash(bytes))
}

/// Returns the CRC-32 of a message in the file: stamps, number, encapsulation and payload.
fn checksum(meta: &SampleMeta, cdr: &[u8]) -> u32 {
    let mut crc = crc32fast::Hasher::new();
    crc.update(&stamp(meta.at_ns).to_le_bytes());
    crc.update(&stamp(meta.publish_ns).to_le_bytes());
    crc.update(&(meta.seq as u32).to_le_bytes());
    crc.update(&encapsulation(meta));
    crc.update(cdr);
    crc.finalize()
}

#[cfg(test)]
mod tests {
    use gleaner_messages::transport::Guid;

    use super::*;

    fn meta(at_ns: i64) -> SampleMeta {
        SampleMeta { publish_ns: 2, options: [4, 5], ..SampleMeta::new(at_ns, Guid([0; 16]), 3) }
    }

    #[test]
    fn definitions_are_compared_without_surrounding_white_space() {
        let mut written = Written::default();
        for (name, text) in [("/a", "float64 x"), ("/b", "\nfloat64 x\n"), ("/c", " \n")] {
            let topic = written.add_topic(&TopicSchema {
                name: name.to_owned(),
                type_name: "T".to_owned(),
                ..TopicSchema::default()
            });
            written.add_definitions(topic, text);
        }
        let [a, b, c] = written.topics() else { panic!("three topics") };
        assert_eq!((a.definitions(), c.definitions()), (b.definitions(), None));
    }

    fn checksum_of(messages: &[(i64, &[u8])]) -> String {
        let mut written = Written::default();
        let imu = TopicSchema {
            name: "/imu".to_owned(),
            type_name: "T".to_owned(),
            ..TopicSchema::default()
        };
        let topic = written.add_topic(&imu);
        messages.iter().for_each(|(at_ns, cdr)| written.count(topic, &meta(*at_ns), cdr));
        written.topics()[topic].checksum()
    }

    /// Computed in Python: `zlib.crc32(struct.pack("<QQI4B", 1, 2, 3, 0, 1, 4, 5) + b"abc") ** 2`.
    #[test]
    fn a_checksum_is_as_documented() {
        assert_eq!(checksum_of(&[(1, b"abc")]), "2030abf0358c4d19");
    }

    #[test]
    fn a_checksum_ignores_the_order_of_messages_but_not_swapped_bytes() {
        let both = checksum_of(&[(1, b"abc"), (7, b"xyz")]);
        assert_eq!(checksum_of(&[(7, b"xyz"), (1, b"abc")]), both);
        assert_ne!(checksum_of(&[(1, b"xyz"), (7, b"abc")]), both);
        assert_ne!(checksum_of(&[(1, b"abc"), (7, b"xyz"), (7, b"xyz")]), both);
        assert_eq!(checksum_of(&[]), "0000000000000000");
    }
}
