//! Samples of latched topics, which stay valid until newer ones replace them: maps, transforms and
//! models of a vehicle are published once. Clips, and replays of a part of a drive, begin with
//! those that were valid then.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use crate::transport::SampleMeta;

/// Most samples, and most bytes, that are kept of a topic.
const SAMPLES_MAX: usize = 1000;
const BYTES_MAX: usize = 16 << 20;
/// Most bytes of several topics together.
const ALL_BYTES_MAX: usize = 64 << 20;
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LatchedSample {
    pub meta: SampleMeta,
    /// Its bytes, which copies share.
    pub cdr: Arc<[u8]>,
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
    depth: LatchRule,
    samples: VecDeque<LatchedSample>,
    bytes: usize,
    /// Stamp of the last valid sample that found no room, and their number.
    dropped: Option<(i64, u64)>,
}

impl LatchedTopic {
    /// Keeps a sample. Nothing is asked for before `horizon`.
    pub fn keep(&mut self, sample: LatchedSample, depth: LatchRule, horizon: i64) {
        let writer = sample.meta.writer;
        self.depth = depth;
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
            self.drop_oldest();
        }
    }

    /// Drops the oldest sample, and counts it if no newer ones replace it.
    pub fn drop_oldest(&mut self) {
        let Some(LatchedSample { meta, cdr }) = self.samples.pop_front() else { return };
        self.bytes -= cdr.len();
        let newer = self.samples.iter().filter(|kept| kept.meta.writer == meta.writer);
        if self.depth.is_none_or(|depth| newer.count() < depth) {
            let (_, count) = self.dropped.unwrap_or_default();
            self.dropped = Some((meta.at_ns, count + 1));
        }
    }

    /// Returns the samples that were valid just before `from`, and the number of those among them
    /// that found no room.
    pub fn valid_at(&self, from: i64) -> (Vec<LatchedSample>, u64) {
        let mut newer: HashMap<_, usize> = HashMap::new();
        let mut valid: Vec<_> = self
            .samples
            .iter()
            .rev()
            .filter(|kept| kept.meta.at_ns < from)
            .filter(|kept| {
                let newer = newer.entry(kept.meta.writer).or_default();
                *newer += 1;
                self.depth.is_none_or(|depth| *newer <= depth)
            })
            .cloned()
            .collect();
        valid.reverse();
        let dropped = self.dropped.filter(|(last, _)| *last < from);
        (valid, dropped.map_or(0, |(_, count)| count))
    }
}

/// The latched samples of several topics, by their numbers, with a common bound.
#[derive(Debug, Default)]
pub struct LatchedTopics {
    topics: Vec<LatchedTopic>,
    bytes: usize,
}

impl LatchedTopics {
    /// Keeps a sample of a topic, as `LatchedTopic::keep`. Beyond 64 MiB, the topic that takes
    /// the most loses its oldest samples.
    pub fn keep(&mut self, topic: usize, sample: LatchedSample, depth: LatchRule, horizon: i64) {
        let topics = self.topics.len().max(topic + 1);
        self.topics.resize_with(topics, LatchedTopic::default);
        let before = self.topics[topic].bytes;
        self.topics[topic].keep(sample, depth, horizon);
        self.bytes = self.bytes - before + self.topics[topic].bytes;
        while self.bytes > ALL_BYTES_MAX {
            let Some(largest) = self.topics.iter_mut().max_by_key(|topic| topic.bytes) else {
                return;
            };
            let before = largest.bytes;
            largest.drop_oldest();
            self.bytes -= before - largest.bytes;
        }
    }

    /// Returns the valid samples of a topic, as `LatchedTopic::valid_at`.
    pub fn valid_at(&self, topic: usize, from: i64) -> (Vec<LatchedSample>, u64) {
        self.topics.get(topic).map_or((Vec::new(), 0), |topic| topic.valid_at(from))
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
    use super::*;
    use crate::transport::Guid;

    fn sample(writer: u8, at_ns: i64, bytes: usize) -> LatchedSample {
        let meta = SampleMeta::new(at_ns, Guid([writer; 16]), 1);
        LatchedSample { meta, cdr: vec![0; bytes].into() }
    }

    fn stamps(samples: &[LatchedSample]) -> Vec<i64> {
        samples.iter().map(|kept| kept.meta.at_ns).collect()
    }

    #[test]
    fn the_newest_samples_of_each_writer_are_valid() {
        let keep = |topic: &mut LatchedTopic, depth| {
            for (writer, at_ns) in [(1, 10), (2, 20), (1, 30), (1, 40), (2, 50)] {
                topic.keep(sample(writer, at_ns, 1), Some(depth), 25);
            }
        };
        let mut topic = LatchedTopic::default();
        keep(&mut topic, 1);
        // Before the horizon, replaced samples are gone; after it, they may still be asked for.
        assert_eq!(stamps(&topic.valid_at(35).0), [20, 30]);
        assert_eq!(stamps(&topic.valid_at(60).0), [40, 50]);
        assert_eq!(topic.valid_at(5), (Vec::new(), 0));
        // Only samples that are still valid are missed.
        for (dropped, missed) in [(10, 0), (20, 0), (30, 0), (40, 1), (50, 2)] {
            assert_eq!(topic.samples[0].meta.at_ns, dropped);
            topic.drop_oldest();
            assert_eq!(topic.valid_at(60).1, missed, "after {dropped}");
        }
        let mut topic = LatchedTopic::default();
        keep(&mut topic, 2);
        assert_eq!(stamps(&topic.valid_at(60).0), [20, 30, 40, 50]);
    }

    #[test]
    fn without_writers_all_samples_are_valid_up_to_a_bound_that_is_counted() {
        let mut topic = LatchedTopic::default();
        for at_ns in 0..1003 {
            topic.keep(sample(1, at_ns, 1), None, i64::MAX);
        }
        let (valid, dropped) = topic.valid_at(1001);
        assert_eq!((valid.len(), valid[0].meta.at_ns, dropped), (998, 3, 3));
        topic.keep(sample(1, 2000, BYTES_MAX), None, i64::MAX);
        assert_eq!(stamps(&topic.valid_at(i64::MAX).0), [2000]);
        topic.keep(sample(1, 2001, BYTES_MAX + 1), None, i64::MAX);
        assert_eq!(topic.valid_at(i64::MAX), (Vec::new(), 1005));
    }

    #[test]
    fn topics_have_a_common_bound() {
        let mut topics = LatchedTopics::default();
        for topic in 0..5 {
            topics.keep(topic, sample(1, topic as i64, BYTES_MAX - topic), None, i64::MAX);
        }
        let kept = (0..5).map(|topic| topics.valid_at(topic, 9)).map(|(kept, n)| (kept.len(), n));
        assert_eq!(kept.collect::<Vec<_>>(), [(0, 1), (1, 0), (1, 0), (1, 0), (1, 0)]);
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
