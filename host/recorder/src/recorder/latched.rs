//! Samples of latched topics, which stay valid until newer ones replace them: maps, transforms and
//! models of a vehicle are published once. Clips begin with those that were valid then.

use std::collections::{HashMap, VecDeque};

use gleaner_transport::SampleMeta;

/// Most samples, and most bytes, that are kept of a topic.
const SAMPLES_MAX: usize = 1000;
const BYTES_MAX: usize = 16 << 20;

/// A sample of a latched topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LatchedSample {
    pub meta: SampleMeta,
    pub cdr: Box<[u8]>,
}

impl LatchedSample {
    pub fn new(meta: &SampleMeta, cdr: &[u8]) -> LatchedSample {
        LatchedSample { meta: *meta, cdr: cdr.into() }
    }
}

/// The number of samples of each writer that stay valid; `None` for all, as writers are unknown.
pub type LatchRule = Option<usize>;

/// The samples of one topic that are valid, or were valid not long ago.
#[derive(Debug, Default)]
pub struct LatchedTopic {
    samples: VecDeque<LatchedSample>,
    bytes: usize,
    /// Stamp of the last sample that found no room, and their number.
    dropped: Option<(i64, u64)>,
}

impl LatchedTopic {
    /// Keeps a sample. Nothing is asked for before `horizon`.
    pub fn keep(&mut self, sample: LatchedSample, depth: LatchRule, horizon: i64) {
        let writer = sample.meta.writer;
        self.bytes += sample.cdr.len();
        self.samples.push_back(sample);
        if let Some(depth) = depth {
            let is_old =
                |kept: &LatchedSample| kept.meta.writer == writer && kept.meta.at_ns < horizon;
            let replaced = self.samples.iter().filter(|kept| is_old(kept)).count();
            for _ in depth..replaced {
                let oldest = self.samples.iter().position(is_old);
                let removed = oldest.and_then(|at| self.samples.remove(at));
                self.bytes -= removed.map_or(0, |removed| removed.cdr.len());
            }
        }
        while self.samples.len() > SAMPLES_MAX || self.bytes > BYTES_MAX {
            let Some(removed) = self.samples.pop_front() else { break };
            self.bytes -= removed.cdr.len();
            let (_, count) = self.dropped.unwrap_or_default();
            self.dropped = Some((removed.meta.at_ns, count + 1));
        }
    }

    /// Returns the samples that were valid just before `from`, and the number of those among them
    /// that found no room.
    pub fn valid_at(&self, from: i64, depth: LatchRule) -> (Vec<LatchedSample>, u64) {
        let mut newer: HashMap<_, usize> = HashMap::new();
        let mut valid: Vec<_> = self
            .samples
            .iter()
            .rev()
            .filter(|kept| kept.meta.at_ns < from)
            .filter(|kept| {
                let newer = newer.entry(kept.meta.writer).or_default();
                *newer += 1;
                depth.is_none_or(|depth| *newer <= depth)
            })
            .cloned()
            .collect();
        valid.reverse();
        // Where the depth is known, newer samples of the same writers replaced nearly all of them.
        let dropped = self.dropped.filter(|(last, _)| depth.is_none() && *last < from);
        (valid, dropped.map_or(0, |(_, count)| count))
    }
}

/// Returns whether a topic is latched, by the QoS that its writers offer, as rosbag2 writes it: if
/// so, the number of samples of each writer that stay valid.
pub fn latched_depth(offered_qos: &str) -> Option<usize> {
    let value = |line: &str, key: &str| {
        let line = line.trim_start_matches(['-', ' ']);
        Some(line.strip_prefix(key)?.strip_prefix(':')?.trim().to_owned())
    };
    // Before ROS 2 Iron, policies are numbers.
    let is_latched = |line: &str| {
        value(line, "durability").is_some_and(|value| value == "transient_local" || value == "1")
    };
    let depth = |line: &str| value(line, "depth").and_then(|value| value.parse::<usize>().ok());
    let depths = offered_qos.lines().filter_map(depth).map(|depth| depth.max(1));
    offered_qos.lines().any(is_latched).then(|| depths.max().unwrap_or(1))
}

#[cfg(test)]
mod tests {
    use gleaner_messages::Endian;
    use gleaner_transport::Guid;

    use super::*;

    fn sample(writer: u8, at_ns: i64, bytes: usize) -> LatchedSample {
        let writer = Guid([writer; 16]);
        let (endian, options) = (Endian::Little, [0; 2]);
        let meta = SampleMeta {
            at_ns,
            publish_ns: 0,
            writer,
            seq: 1,
            endian,
            options,
            layout: 0,
            is_latched: false,
        };
        LatchedSample { meta, cdr: vec![0; bytes].into() }
    }

    fn stamps(samples: &[LatchedSample]) -> Vec<i64> {
        samples.iter().map(|kept| kept.meta.at_ns).collect()
    }

    #[test]
    fn the_newest_samples_of_each_writer_are_valid() {
        let mut topic = LatchedTopic::default();
        for (writer, at_ns) in [(1, 10), (2, 20), (1, 30), (1, 40), (2, 50)] {
            topic.keep(sample(writer, at_ns, 1), Some(1), 25);
        }
        // Before the horizon, replaced samples are gone; after it, they may still be asked for.
        assert_eq!(stamps(&topic.valid_at(35, Some(1)).0), [20, 30]);
        assert_eq!(stamps(&topic.valid_at(60, Some(1)).0), [40, 50]);
        assert_eq!(stamps(&topic.valid_at(60, Some(2)).0), [20, 30, 40, 50]);
        assert_eq!(topic.valid_at(5, Some(1)), (Vec::new(), 0));
    }

    #[test]
    fn without_writers_all_samples_are_valid_up_to_a_bound_that_is_counted() {
        let mut topic = LatchedTopic::default();
        for at_ns in 0..1003 {
            topic.keep(sample(1, at_ns, 1), None, i64::MAX);
        }
        let (valid, dropped) = topic.valid_at(1001, None);
        assert_eq!((valid.len(), valid[0].meta.at_ns, dropped), (998, 3, 3));
        topic.keep(sample(1, 2000, BYTES_MAX), None, i64::MAX);
        assert_eq!(stamps(&topic.valid_at(i64::MAX, None).0), [2000]);
        topic.keep(sample(1, 2001, BYTES_MAX + 1), None, i64::MAX);
        assert_eq!(topic.valid_at(i64::MAX, None), (Vec::new(), 1005));
    }

    #[test]
    fn the_offered_qos_states_whether_a_topic_is_latched() {
        for (qos, expected) in [
            ("- history: keep_last\n  depth: 5\n  durability: transient_local\n", Some(5)),
            ("- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n", Some(1)),
            ("- depth: 10\n  durability: volatile\n", None),
            ("- depth: 2\n  durability: 2\n- depth: 3\n  durability: 1\n", Some(3)),
            ("- history: keep_all\n  depth: 0\n  durability: transient_local", Some(1)),
            ("", None),
        ] {
            assert_eq!(latched_depth(qos), expected, "{qos}");
        }
    }
}
